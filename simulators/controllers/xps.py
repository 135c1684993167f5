"""Newport XPS with single-axis groups: functions over TCP, answered in order on each connection.

A move or a homing holds up its own connection until it ends; other connections are answered meanwhile.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drivers.axes.xps import Config
from simulators.clock import FastClock
from simulators.serial.emulator import EmulatedAxis, Emulator
from simulators.serial.reply_faults import FaultSchedule
from simulators.serial.serve_options import ServeOptions

WRONG_FORMAT, OUT_OF_RANGE, NO_GROUP, NOT_ALLOWED, UNKNOWN, ABORTED = -2, -17, -19, -22, -3, -27
# The controller's servo cycle; gathering takes a sample in each, or in each n-th.
CYCLE_S = 125e-6
END = ",EndOfAPI"
_CALL = re.compile(r"\s*(\w+)\((.*)\)")


class XpsError(Exception):
    """The function fails; `code` is the first field of the answer."""

    def __init__(self, code: int) -> None:
        super().__init__(code)
        self.code = code


@dataclass
class PositionCompare:
    """A pulse at each of the angles low, low + step, ... high that the axis passes; `pulses_deg` has those so far."""

    low_deg: float = 0.0
    high_deg: float = 0.0
    step_deg: float = 0.0
    on: bool = False
    pulses_deg: list[float] = field(default_factory=list)
    _seen_deg: float = math.nan

    def look(self, here_deg: float) -> None:
        """Record the pulses since the last look; the axis turned one way only in between."""
        there_deg, self._seen_deg = self._seen_deg, here_deg
        if not self.on or math.isnan(there_deg):
            return
        count = round((self.high_deg - self.low_deg) / self.step_deg) + 1
        crossed_deg = [self.low_deg + k * self.step_deg for k in range(count)]
        low, high = sorted((there_deg, here_deg))
        # A mark at the position of the last look has given its pulse.
        crossed_deg = [deg for deg in crossed_deg if low <= deg <= high and deg != there_deg]
        self.pulses_deg += crossed_deg if here_deg >= there_deg else crossed_deg[::-1]


@dataclass
class Gathering:
    """Positions and velocities taken in the servo's cycle; `types` are the quantities, by axis and name."""

    types: list[tuple[EmulatedAxis, str]] = field(default_factory=list)
    samples: list[tuple[float, ...]] = field(default_factory=list)
    target_count: int = 0
    every_s: float = 0.0
    start_s: float = 0.0

    def look(self, now_s: float) -> None:
        """Take the samples that are due; no motion began since the last look."""
        while len(self.samples) < self.target_count:
            due_s = self.start_s + len(self.samples) * self.every_s
            if due_s > now_s:
                return
            self.samples.append(tuple(axis.at(due_s)[name == "CurrentVelocity"] for axis, name in self.types))


@dataclass
class AxisGroup:
    """A group with one positioner, `name`.Pos."""

    name: str
    axis: EmulatedAxis
    initialized: bool = False
    enabled: bool = True
    came_by: int = 11
    aborted: bool = False
    jogs: bool = False
    jog: tuple[float, float] = (0.0, 0.0)
    compare: PositionCompare = field(default_factory=PositionCompare)

    def status(self) -> int:
        """Status code of GroupStatusGet."""
        if self.jogs:
            return 47
        if self.axis.is_moving():
            return 43 if self.axis.homing else 44
        if not self.initialized:
            return 0
        if not self.axis.homed:
            return 42
        return self.came_by if self.enabled else 20


class XPSEmulator(Emulator):
    """A controller; `true_deg(i)` belongs to the i-th group. `connect` begins a conversation on one connection."""

    pieces = (
        *(b"GroupStatusGet(Group1,int *)", b"GroupMoveAbsolute(Group1.Pos,", b"GroupKill(Group2)", b")", b"("),
        *(b"GroupInitialize(Group1)", b"GroupHomeSearch(Group1)", b"GroupMoveAbort(Group1)", b"double *,"),
    )

    def __init__(self, groups: Sequence[AxisGroup], clock: FastClock, faults: FaultSchedule | None = None) -> None:
        super().__init__([group.axis for group in groups], clock, faults)
        self.groups = {group.name: group for group in groups}
        self.gathering = Gathering()

    def connect(self) -> "XPSConversation":
        """Begin a conversation."""
        return XPSConversation(self)

    def _do_receive(self, data: bytes) -> None:
        raise RuntimeError("an XPS is talked to over a connection")

    def _do_make_foreign(self, reply: bytes) -> bytes:
        return f"0,XPS-C8 Firmware V2.6.x{END}".encode()


class XPSConversation(Emulator):
    """One connection to a controller."""

    def __init__(self, controller: XPSEmulator) -> None:
        super().__init__(controller.axes, controller.clock, controller.faults)
        # Connections share the axes.
        self._lock = controller._lock
        self._controller = controller
        self._buffer = ""
        self._waits_for: AxisGroup | None = None

    def _do_receive(self, data: bytes) -> None:
        self._buffer = (self._buffer + data.decode("latin-1"))[-4096:]
        self._work()

    def _work(self) -> None:
        while self._waits_for is None and (end := self._buffer.find(")")) >= 0:
            text, self._buffer = self._buffer[: end + 1], self._buffer[end + 1 :]
            self._apply_faults()
            self._controller.gathering.look(self.clock.now_s())
            try:
                answer = self._run(text)
            except XpsError as failure:
                self._reply(f"{failure.code},{text.strip()}{END}".encode("latin-1"))
                continue
            if answer is not None:
                self._reply(f"0,{answer}{END}".encode("latin-1"))

    def _run(self, text: str) -> str | None:
        call = _CALL.fullmatch(text)
        if call is None:
            raise XpsError(WRONG_FORMAT)
        name, words = call[1], [word.strip() for word in call[2].split(",")]
        if name == "FirmwareVersionGet":
            return "XPS-C8 Firmware V2.6.x"
        if name == "ErrorStringGet":
            return f"Error {words[0]}"
        if name == "Login":
            return ""
        if name == "ObjectsListGet":
            groups = self._controller.groups
            return f"{';'.join(groups)};;{';'.join(f'{group}.Pos' for group in groups)}"
        if name.startswith("Gathering"):
            return self._gather(name.removeprefix("Gathering"), words)
        functions: dict[str, Callable[[AxisGroup, list[str]], str | None]] = {
            "GroupStatusGet": lambda group, _: str(group.status()),
            "GroupPositionCurrentGet": lambda group, _: f"{group.axis.position_deg():.9g}",
            "GroupVelocityCurrentGet": lambda group, _: f"{group.axis.velocity_deg_s():.9g}",
            "PositionerUserTravelLimitsGet": lambda group, _: _limits(group.axis),
            "PositionerSGammaParametersGet": lambda group, _: (
                f"{group.axis.speed_deg_s:.9g},{group.axis.acceleration_deg_s2:.9g},0.02,0.02"
            ),
            "GroupInitialize": self._initialize,
            "GroupHomeSearch": self._home,
            "GroupMoveAbsolute": self._move,
            "GroupMoveRelative": lambda group, words: self._move(group, words, group.axis.position_deg()),
            "GroupMoveAbort": self._abort,
            "GroupKill": self._kill,
            "GroupMotionEnable": lambda group, _: self._enable(group, True),
            "GroupMotionDisable": lambda group, _: self._enable(group, False),
            "GroupJogModeEnable": lambda group, _: self._switch_jog(group, True),
            "GroupJogModeDisable": lambda group, _: self._switch_jog(group, False),
            "GroupJogParametersSet": self._jog,
            "GroupJogParametersGet": lambda group, _: f"{group.jog[0]:.9g},{group.jog[1]:.9g}",
            "GroupJogCurrentGet": lambda group, _: f"{group.axis.velocity_deg_s():.9g},{group.jog[1]:.9g}",
            "PositionerPositionCompareSet": self._set_compare,
            "PositionerPositionCompareGet": lambda group, _: _compare(group.compare),
            "PositionerPositionCompareEnable": lambda group, _: self._switch_compare(group, True),
            "PositionerPositionCompareDisable": lambda group, _: self._switch_compare(group, False),
        }
        if name not in functions:
            raise XpsError(UNKNOWN)
        group = self._controller.groups.get(words[0].partition(".")[0])
        if group is None:
            raise XpsError(NO_GROUP)
        return functions[name](group, words[1:])

    def _initialize(self, group: AxisGroup, _: list[str]) -> str:
        if group.status() != 0:
            raise XpsError(NOT_ALLOWED)
        group.initialized = group.enabled = True
        return ""

    def _home(self, group: AxisGroup, _: list[str]) -> None:
        if group.status() != 42:
            raise XpsError(NOT_ALLOWED)
        group.axis.home()
        group.came_by, group.aborted, self._waits_for = 11, False, group

    def _move(self, group: AxisGroup, words: list[str], from_deg: float = 0.0) -> None:
        if not 10 <= group.status() <= 18:
            raise XpsError(NOT_ALLOWED)
        target_deg = from_deg + _numbers(words, 1)[0]
        if not group.axis.within(target_deg):
            raise XpsError(OUT_OF_RANGE)
        group.axis.move_to(target_deg)
        group.came_by, group.aborted, self._waits_for = 12, False, group

    def _abort(self, group: AxisGroup, _: list[str]) -> str:
        if group.status() != 44:
            raise XpsError(NOT_ALLOWED)
        group.axis.stop()
        group.aborted = True
        return ""

    def _kill(self, group: AxisGroup, _: list[str]) -> str:
        group.aborted = group.axis.is_moving()
        group.axis.lose_reference()
        group.initialized = group.jogs = False
        return ""

    def _enable(self, group: AxisGroup, on: bool) -> str:
        if group.status() not in ((20,) if on else range(10, 19)):
            raise XpsError(NOT_ALLOWED)
        group.enabled, group.came_by = on, 10
        return ""

    def _switch_jog(self, group: AxisGroup, on: bool) -> str:
        allowed = 10 <= group.status() <= 18 if on else group.jogs and not group.axis.is_moving()
        if not allowed:
            raise XpsError(NOT_ALLOWED)
        group.jogs, group.jog, group.came_by = on, (0.0, group.axis.acceleration_deg_s2), 15
        return ""

    def _jog(self, group: AxisGroup, words: list[str]) -> str:
        velocity_deg_s, acceleration_deg_s2 = _numbers(words, 2)
        if not group.jogs:
            raise XpsError(NOT_ALLOWED)
        if abs(velocity_deg_s) > group.axis.speed_deg_s or not 0 < acceleration_deg_s2 <= 1e6:
            raise XpsError(OUT_OF_RANGE)
        group.jog = (velocity_deg_s, acceleration_deg_s2)
        if velocity_deg_s:
            group.axis.run(velocity_deg_s)
        else:
            group.axis.stop()
        return ""

    def _gather(self, name: str, words: list[str]) -> str:
        gathering, now_s = self._controller.gathering, self.clock.now_s()
        if name == "ConfigurationSet":
            self._controller.gathering = Gathering([self._parse_quantity(word) for word in words])
        elif name == "ConfigurationGet":
            names = {group.axis: group.name for group in self._controller.groups.values()}
            return ";".join(f"{names[axis]}.Pos.{quantity}" for axis, quantity in gathering.types)
        elif name == "Run":
            if not gathering.types:
                raise XpsError(NOT_ALLOWED)
            samples, divisor = _numbers(words, 2)
            if samples < 1 or divisor < 1:
                raise XpsError(OUT_OF_RANGE)
            self._controller.gathering = Gathering(gathering.types, [], int(samples), divisor * CYCLE_S, now_s)
        elif name in ("Stop", "StopAndSave"):
            gathering.target_count = len(gathering.samples)
        elif name == "Reset":
            gathering.target_count, gathering.samples = 0, []
        elif name == "CurrentNumberGet":
            return f"{len(gathering.samples)},{1_000_000 // max(1, len(gathering.types))}"
        elif name in ("DataGet", "DataMultipleLinesGet"):
            first, count = (*_numbers(words[:1], 1), 1) if name == "DataGet" else _numbers(words[:2], 2)
            lines = gathering.samples[int(first) : int(first + count)]
            if first < 0 or len(lines) < count:
                raise XpsError(OUT_OF_RANGE)
            return "".join(f"{';'.join(f'{value:.9g}' for value in line)}\n" for line in lines)
        else:
            raise XpsError(UNKNOWN)
        return ""

    def _parse_quantity(self, word: str) -> tuple[EmulatedAxis, str]:
        """Axis and quantity of ``Group1.Pos.CurrentPosition``."""
        group, _, quantity = word.partition(".Pos.")
        if group not in self._controller.groups or quantity not in ("CurrentPosition", "CurrentVelocity"):
            raise XpsError(WRONG_FORMAT)
        return self._controller.groups[group].axis, quantity

    def _set_compare(self, group: AxisGroup, words: list[str]) -> str:
        low_deg, high_deg, step_deg = _numbers(words, 3)
        if group.compare.on or not 10 <= group.status() <= 18:
            raise XpsError(NOT_ALLOWED)
        if not (step_deg > 0 and low_deg < high_deg and group.axis.within(low_deg) and group.axis.within(high_deg)):
            raise XpsError(OUT_OF_RANGE)
        group.compare = PositionCompare(low_deg, high_deg, step_deg)
        return ""

    def _switch_compare(self, group: AxisGroup, on: bool) -> str:
        if on and group.compare.step_deg == 0:
            raise XpsError(NOT_ALLOWED)
        group.compare.look(group.axis.position_deg())
        group.compare.on = on
        return ""

    def _do_advance(self) -> None:
        self._controller.gathering.look(self.clock.now_s())
        for member in self._controller.groups.values():
            member.compare.look(member.axis.position_deg())
        group = self._waits_for
        if group is not None and not group.axis.is_moving():
            self._waits_for = None
            self._reply(f"{ABORTED if group.aborted else 0},{END}".encode())
            self._work()

    def _do_next_event_s(self) -> float | None:
        return None if self._waits_for is None else self._waits_for.axis.end_s()

    def _do_make_foreign(self, reply: bytes) -> bytes:
        return self._controller._do_make_foreign(reply)


def _numbers(words: list[str], count: int) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        raise XpsError(WRONG_FORMAT) from None
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise XpsError(WRONG_FORMAT)
    return numbers


def _limits(axis: EmulatedAxis) -> str:
    low = -1e7 if axis.min_deg is None else axis.min_deg
    high = 1e7 if axis.max_deg is None else axis.max_deg
    return f"{low:g},{high:g}"


def _compare(compare: PositionCompare) -> str:
    return f"{compare.low_deg:.9g},{compare.high_deg:.9g},{compare.step_deg:.9g},{int(compare.on)}"


def make(options: ServeOptions) -> XPSEmulator:
    """Two groups, Group1 and Group2, not initialized, with travel from -170 to 170 degrees."""
    low, high = options.limits_deg or (-170.0, 170.0)
    groups = [
        AxisGroup(f"Group{k + 1}", options.axis(low, high, 12.0 * (k + 1)), options.homed)
        for k in range(options.axes or 2)
    ]
    return XPSEmulator(groups, options.clock, options.faults)


def axis_configs(emulator: XPSEmulator, port: str) -> list[Config]:
    """Rig entries for every group."""
    return [Config(port=port, group=name) for name in emulator.groups]


SERVES = {"xps": make}
