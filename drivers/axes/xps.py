"""Newport XPS-C8, -Q8, -D with rotation stages in single-axis groups, over TCP (port 5001).

Facts: Newport's own Python library, as newportxps and pyepics carry it (calls, ``code,values,EndOfAPI``), EPICS' and
BLISS' drivers (status codes; a move or homing holds up its connection until it ends, so every axis has a second one
for them, and a third for stops: nobody waits for their answers, which must not be taken for another question's).
A group is homed after GroupInitialize and GroupHomeSearch; GroupKill ends a homing. Position compare: the same library
and Newport's note "High speed position compare output".
Unverified on hardware: everything; that no Login is asked; the text behind an error code; in which states position
compare is refused. The unit must be degrees, which is not asked.
"""

import contextlib
import re
from functools import partial
from typing import ClassVar, Literal

from pydantic import Field

from drivers.axis_types import stage_limit
from drivers.clock import Clock
from drivers.errors import CommandRejected, LimitError, NotHomedError, ReplyError, ReplyTimeout, WrongDevice
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import ControllerLine, LineRegistry, SerialLink, Transcript, agreed, framer_of
from drivers.unmarked_replies import ask, text_of

END = b",EndOfAPI"
framer = framer_of(END)
READY = range(10, 19)
DISABLED = range(20, 39)
NOT_REFERENCED = 42
HOMING = 43
MOVING = range(43, 49)
ERRORS = {-17: "parameter out of range", -19: "no such group", -22: "not allowed in this state", -27: "aborted"}
NOT_ALLOWED, ABORTED = -22, -27
# GroupInitialize starts the motor's control loop; a refusal of a move comes at once.
INITIALIZE_S = 20.0
REFUSAL_S = 0.1
# Of a step, so that 0.1 + 0.2 is three of them.
STEPS_ROUNDING = 1e-6
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_ERROR = r"-\d+,.*"


class Config(AxisConfig):
    """A single-axis group of an XPS in a rig file; `port` is ``socket://ADDRESS:5001``."""

    identified_by: ClassVar[str] = "group"

    kind: Literal["xps"] = "xps"
    group: str = Field(pattern=r"^\w+$", description="name of the group")
    positioner: str = Field(default="Pos", pattern=r"^\w+$", description="name of its positioner")

    def place(self) -> str:
        return f"positioner {self.group}.{self.positioner}"


class XPSLine(ControllerLine):
    """The connection for questions, shared by the axes of one controller."""

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, framer, baudrate=9600, reply_s=1.0)

    def ask(self, call: str, form: str) -> str:
        """Ask a question; returns the values of the answer, in the given form.

        Raises CommandRejected, ReplyTimeout, ReplyError.
        """
        label = f"XPS {self.link.port}, {call}"
        parse = text_of(re.compile(rf"0,{form}|{_ERROR}"))
        answer = ask(
            self.link,
            call.encode("ascii"),
            parse,
            self.reply_s,
            request=label,
            what_to_check="Check power, cable and address",
        )
        return _values(answer, label)

    def command(self, call: str, reply_s: float | None = None) -> None:
        """Call a function without values, once; raises CommandRejected or ReplyTimeout."""
        label = f"XPS {self.link.port}, {call}"
        with self.link.lock:
            self.link.purge(0.0)
            self.link.write(call.encode("ascii"))
            frame = self.link.read_frame(self.link.clock.now_s() + (reply_s or self.reply_s))
        if frame is None:
            raise ReplyTimeout(label, f"nothing within {reply_s or self.reply_s} s", "Check power, cable and address")
        _values(frame.decode("ascii", "replace"), label)


def _values(answer: str, request: str) -> str:
    code, _, values = answer.partition(",")
    if not re.fullmatch(r"-?\d+", code):
        raise ReplyError(request, f"no code in {answer!r}", "Is it an XPS, and the port 5001?")
    if int(code) == 0:
        return values
    words = f"error {code}: {ERRORS.get(int(code), 'see the manual')}"
    if int(code) == NOT_ALLOWED:
        raise NotHomedError(request, words, "Home the axis (acquire home)")
    raise CommandRejected(request, words, "Look at the state of the group in the controller's web page")


class XPSAxis(MotionAxis):
    """One group with one positioner."""

    def __init__(
        self, name: str, config: Config, line: XPSLine, lines: LineRegistry, *, moving: SerialLink, stopping: SerialLink
    ) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines, self._moving, self._stopping = line, lines, moving, stopping
        self._homing = False
        # Motions whose answer has not come, which it may do after the next one was asked for.
        self._unanswered = 0
        positioner = f"{config.group}.{config.positioner}"
        self._positioner = positioner
        self._require_group(f"axis {name} on {config.port}")
        firmware = agreed(lambda: line.ask("FirmwareVersionGet(char *)", r"[^,]+"))
        if "XPS" not in firmware.upper():
            raise WrongDevice(f"axis {name} on {config.port}", f"{firmware!r} answers", "Correct `port`")
        speed = agreed(lambda: self._ask("PositionerSGammaParametersGet", 4))
        self.speed_deg_s, self.acceleration_deg_s2 = speed[:2]
        if min(speed[:2]) <= 0:
            raise ReplyError(f"axis {name}, speed", f"{speed[:2]}", "Set the parameters of the stage")
        limits = agreed(lambda: self._ask("PositionerUserTravelLimitsGet", 2))
        self._device_min_deg, self._device_max_deg = map(stage_limit, limits)
        self._identify(
            model=firmware.partition(" ")[0],
            serial_number="not told by the protocol",
            firmware=firmware,
            address=positioner,
        )

    def _require_group(self, request: str) -> None:
        try:
            self._status()
        except CommandRejected as error:
            raise WrongDevice(
                f"{request}, group {self.config.group}", error.came_back, "Correct `group` in the rig file"
            ) from error

    def _ask(self, function: str, values: int) -> tuple[float, ...]:
        placeholders = ",".join(["double *"] * values)
        answer = self._line.ask(f"{function}({self._positioner},{placeholders})", ",".join([_NUMBER] * values))
        return tuple(float(value) for value in answer.split(","))

    def _status(self) -> int:
        return int(self._line.ask(f"GroupStatusGet({self.config.group},int *)", r"\d{1,3}"))

    def output_pulses(self, first_deg: float, last_deg: float, step_deg: float) -> None:
        """Put out a pulse at every step between two angles, whenever the axis passes one, until `output_no_pulses`.

        This is the controller's position compare output (connector PCO): it triggers a camera in mid-move. Captures do
        not use it, since their axes stand still while a frame is exposed.

        Parameters
        ----------
        first_deg, last_deg : user angles of the outermost pulses.
        step_deg : distance of two pulses; first and last are whole steps apart.

        Raises
        ------
        LimitError
            An end outside the limits of the axis, or not whole steps between them.
        CommandRejected, NotHomedError, ReplyError
            The controller refuses, or reads back something else.
        """
        for end_deg in (first_deg, last_deg):
            self.check(end_deg)
        steps = (last_deg - first_deg) / step_deg if step_deg > 0 else 0.0
        if steps < 1 or abs(steps - round(steps)) > STEPS_ROUNDING:
            raise LimitError(
                f"axis {self.name}, pulses from {first_deg:g} to {last_deg:g} deg",
                f"steps of {step_deg:g} deg do not fit",
                "Choose ends that are whole steps apart, the lower one first",
            )
        low_deg, high_deg = sorted(self._to_device_deg(end_deg) for end_deg in (first_deg, last_deg))
        window = (low_deg, high_deg, step_deg)
        self._line.command(
            f"PositionerPositionCompareSet({self._positioner},{','.join(f'{value:.6f}' for value in window)})"
        )
        # The encoder's resolution rounds them.
        readback, _ = self._read_compare()
        if any(abs(echo - value) > self.config.tolerance_deg for echo, value in zip(readback, window, strict=True)):
            raise ReplyError(f"axis {self.name}, pulses {window}", f"it reads back {readback}", "Choose another step")
        self._line.command(f"PositionerPositionCompareEnable({self._positioner})")

    def output_no_pulses(self) -> None:
        """Switch the position compare output off; raises as the controller refuses."""
        self._line.command(f"PositionerPositionCompareDisable({self._positioner})")

    def puts_out_pulses(self) -> bool:
        """True while the position compare output is on."""
        return self._read_compare()[1]

    def _read_compare(self) -> tuple[tuple[float, ...], bool]:
        call = f"PositionerPositionCompareGet({self._positioner},double *,double *,double *,bool *)"
        *ends, on = self._line.ask(call, ",".join([_NUMBER] * 3 + ["[01]"])).split(",")
        return tuple(float(value) for value in ends), on == "1"

    def _do_read_counts(self) -> float:
        return self._ask("GroupPositionCurrentGet", 1)[0]

    def _do_is_homed(self) -> bool:
        # One garbled digit must not make a reference.
        return all(s in READY or s in DISABLED or (s in MOVING and s != HOMING) for s in self._read_status_twice())

    def _do_is_moving(self) -> bool:
        return any(status in MOVING for status in self._read_status_twice())

    def _read_status_twice(self) -> tuple[int, int]:
        return self._status(), self._status()

    def _start(self, call: str) -> None:
        """Start a motion on its own connection, whose answer comes at its end unless it is refused."""
        self._moving.write(call.encode("ascii"))
        self._unanswered += 1
        answer = self._answer_to_last_motion(self.clock.now_s() + REFUSAL_S)
        if answer is not None:
            _values(answer, f"axis {self.name}, {call}")

    def _answer_to_last_motion(self, deadline_s: float) -> str | None:
        """Read answers, which come in the order of the motions: None while that to the last one has not come."""
        while (frame := self._moving.read_frame(deadline_s)) is not None:
            self._unanswered = max(0, self._unanswered - 1)
            if self._unanswered == 0:
                return frame.decode("ascii", "replace")
        return None

    def _do_start_move(self, counts: float) -> None:
        self._homing = False
        if self._status() in DISABLED:
            self._line.command(f"GroupMotionEnable({self.config.group})")
        self._start(f"GroupMoveAbsolute({self._positioner},{counts:.6f})")

    def _do_start_home(self) -> None:
        """Initialize and home; a group that has a reference must be killed first, as the controller wants it."""
        group = self.config.group
        if self._status() in (*READY, *DISABLED):
            self._line.command(f"GroupKill({group})")
        if self._status() != NOT_REFERENCED:
            self._line.command(f"GroupInitialize({group})", INITIALIZE_S)
        self._homing = True
        self._start(f"GroupHomeSearch({group})")

    def _do_note_rest(self, counts: float) -> None:
        self._homing = False

    def _do_stop(self) -> None:
        # A homing cannot be aborted, only killed.
        call = "GroupKill" if self._homing else "GroupMoveAbort"
        self._stopping.write(f"{call}({self.config.group})".encode("ascii"))

    def _do_check_fault(self) -> None:
        answer = self._answer_to_last_motion(0.0)
        code = "0" if answer is None else answer.partition(",")[0]
        if code not in ("0", str(ABORTED)):
            words = ERRORS.get(int(code), "see the manual") if re.fullmatch(r"-\d+", code) else "garbled"
            raise CommandRejected(f"axis {self.name}, motion", f"error {code}: {words}", "Remove the cause")

    def _do_warnings(self) -> list[str]:
        status = self._status()
        return [f"motor off (status {status})"] if status in DISABLED else []

    def _do_close(self) -> None:
        self._moving.close()
        self._stopping.close()
        super()._do_close()


def open(name: str, config: Config, lines: LineRegistry) -> XPSAxis:
    """Open one axis; reads identity, limits and speed and moves nothing."""
    make = partial(XPSLine, config, lines.clock)
    with lines.taken(config.port, XPSLine, make) as line, contextlib.ExitStack() as cleanup:
        links: list[SerialLink] = []
        for _ in range(2):
            links.append(SerialLink(config.port, 9600, framer, clock=lines.clock))
            cleanup.callback(links[-1].close)
        axis = XPSAxis(name, config, line, lines, moving=links[0], stopping=links[1])
        cleanup.pop_all()
        return axis
