"""A motion axis: angles in degrees with one documented zero, limits, and motions that end in bounded time."""

import contextlib
import logging
import math
import threading
from abc import ABC, abstractmethod

from drivers.agreed_reading import AgreeingReadings
from drivers.axis_types import NO_LIMIT_DEG, AxisConfig, AxisIdentity, Limits, Position
from drivers.clock import REAL, Clock
from drivers.errors import (
    CommandRejected,
    DeviceError,
    LimitError,
    MotionFailed,
    MotionStopped,
    NotHomedError,
    ReplyError,
    ReplyTimeout,
)
from drivers.serial_link import LineRegistry

__all__ = ["AxisConfig", "AxisIdentity", "Limits", "Motion", "MotionAxis", "Position"]

log = logging.getLogger(__name__)

# A motion may take this many times its computed duration, plus the margin of the axis.
SLACK = 1.5
# Status words can lag behind the start and the end of a motion, and a servo settles: idle off the target
# counts only when it lasts this long.
SETTLE_S = 0.3
# A look at the position while moving, for the detection of a stall.
PROGRESS_EVERY_S = 0.2


class Motion:
    """A motion under way, made by `MotionAxis.start_move` or `MotionAxis.home`.

    Attributes
    ----------
    target_deg : target in user degrees; None for homing.
    expected_s, allowed_s : duration computed from distance, speed and acceleration, and the deadline.
    start : where a move begins, as read before it; None for homing.
    """

    def __init__(self, axis: "MotionAxis", target_deg: float | None, expected_s: float, allowed_s: float) -> None:
        self.axis = axis
        self.target_deg = target_deg
        self.start: Position | None = None
        self.expected_s = expected_s
        self.allowed_s = allowed_s
        self._start_s = axis.clock.now_s()
        self._stops_before = axis._stops
        self._result: Position | None = None
        self._failure: MotionFailed | None = None
        self._last: Position | None = None
        self._progress_s = self._start_s
        self._next_progress_look_s = self._start_s + PROGRESS_EVERY_S
        self._idle_since_s: float | None = None

    def done(self) -> bool:
        """Look once: True if the motion has ended at its target. Raises MotionFailed: as `wait`."""
        if self._result is not None:
            return True
        if self._failure is not None:
            raise self._failure
        try:
            self._look()
        except MotionFailed as failure:
            self._failure = failure
            raise
        except DeviceError as error:
            self._failure = self._stop_and_describe(str(error))
            raise self._failure from error
        return self._result is not None

    def wait(self) -> Position:
        """Wait until the axis is idle and return the position read back after that.

        Raises MotionFailed: stall, silence, a fault of the controller, an end position off the target, or the deadline.
        The axis has been sent a stop by then. `MotionStopped` if `stop()` ended it.
        """
        while not self.done():
            self.axis.clock.sleep_s(self.axis.config.poll_s)
        if self._result is None:
            raise RuntimeError("a motion that is done has a result")
        return self._result

    def _look(self) -> None:
        axis = self.axis
        now_s = axis.clock.now_s()
        if axis.is_moving():
            self._idle_since_s = None
            if now_s - self._start_s > self.allowed_s:
                raise self._stop_and_describe("still moving at the deadline")
            if axis._reads_while_moving and now_s > self._next_progress_look_s:
                self._look_for_progress()
            return
        axis.check_fault()
        self._last = axis.read_position()
        if not self._last.confirmed:
            if now_s - self._start_s > self.allowed_s:
                raise self._stop_and_describe("says both that it moves and that it is idle, at the deadline")
            return
        if self.target_deg is None:
            short = None if axis.is_homed() else "the axis is idle but has no reference"
        else:
            off_deg = self._last.deg - self.target_deg
            short = f"the axis came to rest off its target by {off_deg:+.4f} {axis.config.unit}"
            if abs(off_deg) <= axis.config.tolerance_deg:
                short = None
        if short is None:
            self._result = self._last
            axis._do_note_rest(self._last.counts)
        elif axis._stops != self._stops_before:
            raise self._make_error(MotionStopped, "stopped on request", what_to_do="Start a new move when it is safe")
        elif self._idle_since_s is None:
            self._idle_since_s = now_s
        elif now_s - self._idle_since_s > SETTLE_S:
            raise self._stop_and_describe(short)

    def _look_for_progress(self) -> None:
        position = self.axis.read_position()
        now_s = self.axis.clock.now_s()
        self._next_progress_look_s = now_s + PROGRESS_EVERY_S
        stall_s = self.axis.config.stall_s
        if self._last is None or position.counts != self._last.counts:
            self._last, self._progress_s = position, now_s
        elif self.target_deg is not None and now_s - self._progress_s > stall_s:
            raise self._stop_and_describe(f"stalled: it says it moves but made no progress for {stall_s:.2f} s")

    def _make_error(self, kind: type[MotionFailed], why: str, **more: str) -> MotionFailed:
        elapsed_s = self.axis.clock.now_s() - self._start_s
        last_deg = None if self._last is None else self._last.deg
        more["unit"] = self.axis.config.unit
        return kind(self.axis.name, self.target_deg, last_deg, elapsed_s, allowed_s=self.allowed_s, why=why, **more)

    def _stop_and_describe(self, reason: str) -> MotionFailed:
        """Stop the axis, then say what happened; a stop that fails as well is part of the message."""
        try:
            self.axis.stop()
        except DeviceError as error:
            reason = f"{reason}; and the stop failed too ({error})"
        return self._make_error(MotionFailed, reason)


class MotionAxis(ABC):
    """One rotary axis. Public methods check; the controller's own work is in the `_do_...` hooks.

    Opening an axis reads its identity, limits and speed and never moves it.

    Attributes
    ----------
    can_stop_a_move : bool
        False where the hardware runs a started move to its end (Thorlabs Elliptec).
    clock : Clock
        What motions and their deadlines are counted by.
    may_move_on_connect : bool
        True where opening the device can move it. No driver here does.
    """

    can_stop_a_move: bool = True
    may_move_on_connect: bool = False
    _reads_while_moving: bool = True
    #: Set by a driver whose controller has a port.
    _lines: LineRegistry | None = None

    def __init__(self, name: str, config: AxisConfig, clock: Clock = REAL) -> None:
        self.name = name
        self.config = config
        self.clock = clock
        self._stops = 0
        self._closed = False
        self._start_lock = threading.Lock()
        self._readings = AgreeingReadings(clock)
        # Set by the driver's open(), from the controller's report.
        self.counts_per_deg: float = 1.0
        self.speed_deg_s: float = math.nan
        self.acceleration_deg_s2: float = math.nan
        self._home_speed_deg_s: float = math.nan
        self._device_min_deg: float | None = None
        self._device_max_deg: float | None = None

    def _to_user_deg(self, device_deg: float) -> float:
        return self.config.direction * (device_deg - self.config.zero_deg)

    def _to_device_deg(self, user_deg: float) -> float:
        return self.config.direction * user_deg + self.config.zero_deg

    @property
    def controller_zero_deg(self) -> float:
        """User angle at which the controller shows zero, where most stages end their homing."""
        return self._to_user_deg(0.0)

    @property
    def limits(self) -> Limits:
        """The tighter of the controller's and the rig file's limits, in user degrees."""
        ends = [None if end is None else self._to_user_deg(end) for end in (self._device_min_deg, self._device_max_deg)]
        low, high = ends if self.config.direction == 1 else ends[::-1]
        host_low, host_high = self.config.limits_deg or (None, None)
        lows = [end for end in (low, host_low) if end is not None]
        highs = [end for end in (high, host_high) if end is not None]
        return Limits(max(lows) if lows else None, min(highs) if highs else None)

    def check(self, target_deg: float) -> None:
        """Refuse a target outside the limits; writes nothing to the hardware.

        Raises
        ------
        LimitError
            Outside the limits, not a number, or 1e6 degrees and more, which no controller counts.
        """
        limits = self.limits
        if abs(target_deg) < NO_LIMIT_DEG and target_deg in limits:
            return
        raise LimitError(
            f"axis {self.name}, move to {target_deg:g} {self.config.unit}",
            f"the limits are {limits} {self.config.unit}",
            "Nothing was moved. Change the plan, or limits_deg in the rig file if they are wrong",
        )

    def move_time_s(self, distance_deg: float) -> float:
        """Duration of a move over `distance_deg`, from speed and acceleration (trapezoid), in seconds."""
        distance, v, a = abs(distance_deg), self.speed_deg_s, self.acceleration_deg_s2
        if distance < v * v / a:
            return 2 * math.sqrt(distance / a)
        return distance / v + v / a

    def read_position(self) -> Position:
        """Read the position; at rest, readings in a row must agree.

        Most protocols have no checksum, so a changed digit looks like a position; Zaber's has eight bits.

        Raises
        ------
        ReplyError
            Readings at rest contradict each other.
        """
        counts, confirmed = self._read_confirmed()
        return Position(self._to_user_deg(counts / self.counts_per_deg), counts, confirmed, self.config.unit)

    def _read_confirmed(self) -> tuple[int | float, bool]:
        """Return the counts, and False if they are those of an axis in motion."""
        tolerance = self.config.tolerance_deg * abs(self.counts_per_deg)
        return self._readings.read(
            f"axis {self.name}, read position", self._do_read_counts, self._do_is_moving, tolerance
        )

    def is_homed(self) -> bool:
        """True if the controller has a reference position."""
        return self._do_is_homed()

    def is_moving(self) -> bool:
        """True while the controller says that the axis moves or homes."""
        return self._do_is_moving()

    def check_fault(self) -> None:
        """Raise a DeviceError if the controller reports a fault; a mere warning is none."""
        self._do_check_fault()

    def warnings(self) -> list[str]:
        """Warning flags in words; an empty list if there are none. Faults are errors, not warnings."""
        return self._do_warnings()

    def describe(self) -> AxisIdentity:
        """Model, serial number and firmware as read when the axis was opened."""
        return self._identity

    def _identify(self, *, model: str, serial_number: str, firmware: str, address: str) -> None:
        """Store the identity that a driver's open() has read, for `describe`."""
        kind: str = self.config.kind  # type: ignore[attr-defined]  # of every section of a rig file
        self._identity = AxisIdentity(kind, model, serial_number, firmware, self.config.port, address)

    def start_move(self, target_deg: float) -> Motion:
        """Start a move to an absolute user angle in degrees and return at once.

        Raises
        ------
        LimitError, NotHomedError, CommandRejected
            Target outside the limits, no reference, already moving or refused by the controller.
        """
        self.check(target_deg)
        with self._start_lock:
            self._require_idle(f"move to {target_deg:g} {self.config.unit}")
            if not self.is_homed():
                raise NotHomedError(
                    f"axis {self.name}, move to {target_deg:g} {self.config.unit}",
                    "the controller has no reference position",
                    "Look whether the way is free, then home the axis (acquire home)",
                )
            start = self.read_position()
            expected_s = self.move_time_s(target_deg - start.deg)
            motion = Motion(self, target_deg, expected_s, SLACK * expected_s + self.config.margin_s)
            motion._last = motion.start = start
            self._begin(motion, self._to_device_deg(target_deg) * self.counts_per_deg)
        return motion

    def home(self) -> Motion:
        """Start homing and return at once. This turns the axis to its reference switch.

        Raises
        ------
        CommandRejected
            Already moving or refused by the controller.
        """
        with self._start_lock:
            self._require_idle("home")
            ends = (self._device_min_deg, self._device_max_deg)
            span_deg = 360.0 if None in ends else max(360.0, ends[1] - ends[0])  # type: ignore[operator]
            speed = self._home_speed_deg_s if math.isfinite(self._home_speed_deg_s) else self.speed_deg_s / 4
            # Twice the span: some stages look for a limit first and then come back to the index.
            expected_s = 2 * span_deg / speed
            allowed_s = self.config.home_allowed_s or SLACK * expected_s + self.config.margin_s
            motion = Motion(self, None, expected_s, allowed_s)
            self._begin(motion, None)
        return motion

    def _begin(self, motion: Motion, counts: float | None) -> None:
        try:
            if counts is None:
                self._do_start_home()
            else:
                self._do_start_move(counts)
        except (ReplyError, ReplyTimeout) as error:
            # Whether the command arrived is open. It is not repeated: the state and the position after idle decide.
            log.warning("axis %s: unclear reply to the start of a motion, its end decides: %s", self.name, error)
        if self._stops != motion._stops_before:
            # A stop from another thread overtook the command on the line: it holds for this motion as well.
            self._do_stop()

    def _require_idle(self, request: str) -> None:
        if self.is_moving():
            raise CommandRejected(
                f"axis {self.name}, {request}", "the axis is still moving", "Wait for its motion or stop it first"
            )

    def stop(self) -> None:
        """Send a stop at once, also while another thread waits for a motion; does not wait for rest.

        Where `can_stop_a_move` is False the hardware ends a started move by itself.
        """
        self._stops += 1
        self._do_stop()

    def close(self) -> None:
        """Release the axis; the last axis on a line closes the line. Moves and stops nothing."""
        if not self._closed:
            self._closed = True
            with contextlib.suppress(DeviceError):
                self._do_close()

    @abstractmethod
    def _do_read_counts(self) -> int | float:
        """Ask the controller for its position, in its own unit."""

    @abstractmethod
    def _do_is_homed(self) -> bool: ...

    @abstractmethod
    def _do_is_moving(self) -> bool: ...

    @abstractmethod
    def _do_start_move(self, counts: float) -> None:
        """Start an absolute move; the driver rounds to its unit."""

    @abstractmethod
    def _do_start_home(self) -> None: ...

    @abstractmethod
    def _do_stop(self) -> None:
        """Write the stop without waiting for the line's lock or for a reply."""

    def _do_note_rest(self, counts: int | float) -> None:  # noqa: B027 - for drivers that watch the resting position
        """Take the position at which a motion has ended."""

    @abstractmethod
    def _do_check_fault(self) -> None:
        """Raise a DeviceError if the controller reports a fault (not a mere warning)."""

    @abstractmethod
    def _do_warnings(self) -> list[str]: ...

    def _do_close(self) -> None:
        """Give the port back."""
        if self._lines is not None:
            self._lines.release(self.config.port)
