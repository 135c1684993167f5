"""What all emulated controllers share: an axis that moves in time, and replies that faults can spoil."""

import heapq
import itertools
import math
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

from simulators.clock import FastClock, TrapezoidMotion
from simulators.serial.reply_faults import FaultSchedule


class EmulatedAxis:
    """A motor with a trapezoid in time, a reported position and a true one.

    Parameters
    ----------
    clock : FastClock
    speed_deg_s, acceleration_deg_s2 : float
        Of moves and homing.
    min_deg, max_deg : float or None
        Travel in reported degrees; None on a rotary stage without limits.
    homed : bool
        Whether it has a reference at the start.
    start_deg : float
        Mechanical angle at the start, counted from the home switch. An axis without a reference reports zero there.
    true_angle : callable, optional
        Turns the mechanical angle into the true one, both in degrees: a wobble, an eccentricity or a zero error
        that the controller does not know.
    """

    def __init__(
        self,
        clock: FastClock,
        speed_deg_s: float = 300.0,
        acceleration_deg_s2: float = 1500.0,
        *,
        min_deg: float | None = None,
        max_deg: float | None = None,
        homed: bool = False,
        start_deg: float = 0.0,
        true_angle: Callable[[float], float] | None = None,
    ) -> None:
        self.clock = clock
        self.speed_deg_s = speed_deg_s
        self.acceleration_deg_s2 = acceleration_deg_s2
        self.min_deg = min_deg
        self.max_deg = max_deg
        self._homed = homed
        self.homing = False
        self.true_angle = true_angle
        self.slip_deg = 0.0
        self.stuck = False
        self.speed_factor = 1.0
        # Reported angle = mechanical angle - origin.
        self._origin_deg = 0.0 if homed else start_deg
        self._motion = TrapezoidMotion(start_deg, start_deg, 1.0, 1.0)

    def position_deg(self) -> float:
        """Angle that the controller reports now."""
        self.is_moving()
        return self._motion.position(self.clock.now_s()) - self._origin_deg

    def mechanical_deg(self) -> float:
        """Angle of the shaft now, counted from the home switch."""
        return self._motion.position(self.clock.now_s())

    def true_deg(self) -> float:
        """True angle of the optic now, which no reply on the wire tells."""
        mechanical_deg = self.mechanical_deg()
        on_shaft_deg = mechanical_deg if self.true_angle is None else self.true_angle(mechanical_deg)
        return on_shaft_deg + self.slip_deg

    @property
    def homed(self) -> bool:
        """True if the axis has a reference."""
        self.is_moving()
        return self._homed

    def is_moving(self) -> bool:
        """True until the motion has ended; ends homing as a side effect."""
        moving = self.clock.now_s() < self._motion.start_s + self._motion.duration_s
        if not moving and self.homing:
            self._end_homing()
        return moving

    def end_s(self) -> float:
        """Simulated time at which the present motion ends."""
        return self._motion.start_s + self._motion.duration_s

    def velocity_deg_s(self) -> float:
        """Present velocity with its sign."""
        return self._motion.velocity(self.clock.now_s())

    def at(self, then_s: float) -> tuple[float, float]:
        """Reported angle and velocity at a simulated time that lies in the present motion or after it."""
        return self._motion.position(then_s) - self._origin_deg, self._motion.velocity(then_s)

    def within(self, target_deg: float) -> bool:
        """True if a reported angle is inside the travel, to a millionth of a degree."""
        low = -math.inf if self.min_deg is None else self.min_deg - 1e-6
        high = math.inf if self.max_deg is None else self.max_deg + 1e-6
        return low <= target_deg <= high

    def move_to(self, target_deg: float) -> None:
        """Start towards a reported angle; the caller has checked the limits."""
        self._start(target_deg + self._origin_deg)

    def run(self, velocity_deg_s: float) -> None:
        """Turn until a stop, or to the end of the travel, at a signed velocity."""
        far_deg = 1e6 if velocity_deg_s > 0 else -1e6
        end = self.max_deg if velocity_deg_s > 0 else self.min_deg
        self._start((far_deg if end is None else end) + self._origin_deg, abs(velocity_deg_s))

    def home(self, speed_deg_s: float | None = None) -> None:
        """Turn to the home switch, at the speed of moves unless another is given; the reference is there at the end."""
        start_deg = self._motion.position(self.clock.now_s())
        self._homed = False
        # A rotary stage meets its switch once a turn.
        turns = math.floor(start_deg / 360.0 + 1e-9) if self.min_deg is None else 0
        self._start(360.0 * turns, speed_deg_s)
        self.homing = True

    def stop(self) -> None:
        """Brake with the acceleration of the axis; homing ends without a reference."""
        now_s = self.clock.now_s()
        if now_s >= self.end_s():
            return
        velocity = self._motion.velocity(now_s)
        start_deg = self._motion.position(now_s)
        self.homing = False
        if self.stuck or velocity == 0.0 or self.clock.instant:
            self._motion = TrapezoidMotion(start_deg, start_deg, 1.0, 1.0, now_s)
            return
        braking_deg = velocity * abs(velocity) / (2 * self.acceleration_deg_s2)
        # The second half of a triangle that would peak here: it starts at this velocity and ends at rest.
        ramp_s = abs(velocity) / self.acceleration_deg_s2
        self._motion = TrapezoidMotion(
            start_deg - braking_deg, start_deg + braking_deg, math.inf, self.acceleration_deg_s2, now_s - ramp_s
        )

    def set_stuck(self, stuck: bool) -> None:
        """Block the motor, also in mid-move: it says that it moves and goes nowhere."""
        self.stuck = stuck
        if stuck and self.is_moving():
            self._start(0.0)

    def call_position(self, position_deg: float) -> None:
        """Give the resting position another name."""
        self._origin_deg = self._motion.target - position_deg

    def lose_reference(self) -> None:
        """Forget the home position, as after a power cut; the optic stays where it is."""
        self.stop()
        self._homed = False
        self._origin_deg = self._motion.position(math.inf)

    def _start(self, mechanical_deg: float, speed_deg_s: float | None = None) -> None:
        now_s = self.clock.now_s()
        start_deg = self._motion.position(now_s)
        homing, self.homing = self.homing and self.stuck, False
        speed = (self.speed_deg_s if speed_deg_s is None else speed_deg_s) * self.speed_factor
        acceleration = self.acceleration_deg_s2 * self.speed_factor
        if self.stuck:
            self.homing = homing
            # Starts, and will not arrive: the controller sees a motion that goes nowhere.
            self._motion = TrapezoidMotion(start_deg, start_deg + 1e-9, 1e-15, math.inf, now_s)
        elif self.clock.instant:
            self._motion = TrapezoidMotion(start_deg, mechanical_deg, math.inf, math.inf, now_s)
        else:
            self._motion = TrapezoidMotion(start_deg, mechanical_deg, speed, acceleration, now_s)

    def _end_homing(self) -> None:
        self.homing = False
        self._homed = True
        self._origin_deg = self._motion.target


class Emulator(ABC):
    """A controller on a serial line: takes bytes, holds axes, puts replies into a queue with due times.

    Parameters
    ----------
    axes : sequence of EmulatedAxis
    faults : FaultSchedule, optional

    Attributes
    ----------
    pieces : sequence of bytes
        Pieces of real commands: with them the noise of the conformance tests gets past the first letter.
    tells_limits : bool
        False where the controller does not tell the limits of its travel.
    foreign : bytes
        A reply to another question, or of another device.
    """

    pieces: Sequence[bytes] = ()
    foreign: bytes = b""
    tells_limits: bool = True

    def __init__(self, axes: Sequence[EmulatedAxis], clock: FastClock, faults: FaultSchedule | None = None) -> None:
        self.axes = list(axes)
        self.clock = clock
        self.faults = faults or FaultSchedule()
        self._queue: list[tuple[float, int, bytes]] = []
        self._order = itertools.count()
        # A bench reads true angles from another thread than the one that serves the port.
        self._lock = threading.RLock()

    def true_deg(self, axis: int = 0) -> float:
        """True angle of the axis with this index, in degrees."""
        with self._lock:
            return self.axes[axis].true_deg()

    def light_at(self, wavelength_nm: float) -> float:
        """Relative light, 0 to 1, that it lets through or gives at a wavelength; 1 if it is no light source."""
        return 1.0

    def receive(self, data: bytes) -> None:
        """Take bytes from the host, in any portions."""
        with self._lock:
            self._do_receive(data)

    def take_output(self) -> bytes:
        """Return the bytes that are due for the host now."""
        with self._lock:
            self._do_advance()
            due = b""
            while self._queue and self._queue[0][0] <= self.clock.base.now_s():
                due += heapq.heappop(self._queue)[2]
            return due

    def next_output_s(self) -> float | None:
        """Seconds of `clock.base` until more output can be due; None if only input can cause some."""
        with self._lock:
            times = [self._queue[0][0] - self.clock.base.now_s()] if self._queue else []
            event_s = self._do_next_event_s()
            if event_s is not None:
                times.append((event_s - self.clock.now_s()) / self.clock.speed)
            return min(times) if times else None

    def _apply_faults(self) -> None:
        """Count a command and let the faults that are due act on the axes; drivers of replies ask `_reply`."""
        active = self.faults.count_command(self.clock.now_s())
        for axis in self.axes:
            axis.set_stuck("stuck" in active)
            axis.speed_factor = active["slow"].size() if "slow" in active else 1.0
            if "not_homed" in active:
                axis.lose_reference()
            if "slip" in active:
                axis.slip_deg += active["slip"].size()

    def _reply(self, data: bytes) -> None:
        """Queue a reply, as far as the active faults let it through."""
        active = self.faults.active
        if "silent" in active:
            return
        if "foreign" in active:
            data = self._do_make_foreign(data)
        if "garbled" in active:
            data = self.faults.garble(data)
        delay_s = active["late"].size() if "late" in active else 0.0
        heapq.heappush(self._queue, (self.clock.base.now_s() + delay_s, next(self._order), data))

    @abstractmethod
    def _do_receive(self, data: bytes) -> None:
        """Split bytes into commands, call `_apply_faults` for each, and `_reply`."""

    def _do_make_foreign(self, reply: bytes) -> bytes:
        """Make of a reply one that belongs to another device or request."""
        return self.foreign

    def _do_advance(self) -> None:  # noqa: B027 - most protocols have nothing to do here
        """Send what became due with time."""

    def _do_next_event_s(self) -> float | None:
        """Simulated time of the next such message."""
        return None
