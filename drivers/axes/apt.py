"""Thorlabs APT controllers over their binary protocol: K10CR1, K10CR2, KDC101, KBD101, KST101, racks BSC20x and BBD20x.

Documents: Thorlabs' "Motion Controllers Host-Controller Communications Protocol", issue 28 of September 2021: addresses
and routing (page 36), counts per degree and units of speed and acceleration (pages 39 and 41), bits of the status
(pages 126 and 127). The K10CR2 is newer. Further facts: public drivers (pylablib, qmi, thorlabs-apt-protocol, PnPQ) and
their issues. A plain serial port is enough on Linux. States are read, the messages at the end of a motion are not
relied on: they go missing on real units (PnPQ#104). The units in the bays of a rack share its port.
Unverified on hardware: everything of the KBD101, the KST101 and the racks.
"""

import logging
import struct
from dataclasses import dataclass
from functools import partial
from typing import Literal

from pydantic import Field

from drivers.apt_frames import BAY, RACK, REPLY_NAMES, UNIT, apt_framer, long_message, short_message
from drivers.clock import Clock
from drivers.errors import CommandRejected, ReplyError, WrongDevice
from drivers.motion import AxisConfig, MotionAxis
from drivers.serial_link import ControllerLine, LineRegistry, Transcript, agreed
from drivers.unmarked_replies import ask

log = logging.getLogger(__name__)

MOVING_BITS = 0b1111_0000 | 1 << 9  # moving and jogging either way, homing
HOMING, HOMED = 1 << 9, 1 << 10
MOTION_ERROR, CURRENT_LIMIT, ERROR, ENABLED = 1 << 14, 1 << 24, 1 << 30, 1 << 31
PRM1_Z8_STAGE = 6


@dataclass(frozen=True, slots=True)
class StageScale:
    """Counts per degree, per degree/s and per degree/s^2."""

    position: float
    velocity: float
    acceleration: float


def _servo(counts_per_deg: float, sample_s: float) -> StageScale:
    """Scale of a stage on a servo that samples so often; a brushless one does every 102.4 us."""
    return StageScale(counts_per_deg, counts_per_deg * 65536 * sample_s, counts_per_deg * 65536 * sample_s**2)


def _stepper(turns_of_the_motor: float) -> StageScale:
    """Scale of a stage on a stepper drive of the second generation: 409600 microsteps a turn of its motor."""
    per_deg = 409_600 * turns_of_the_motor / 360
    return StageScale(per_deg, per_deg * 53.68, per_deg * 53.68 * 204.94e-6)


K10CR1 = _stepper(120)
PRM1_Z8 = _servo(1919.6418578623391, 2048 / 6e6)
STAGES = {
    "K10CR1": K10CR1,
    "PRM1-Z8": PRM1_Z8,
    "HDR50": _stepper(66),
    "NR360": _stepper(66),
    "DDR05": _servo(2_000_000 / 360, 102.4e-6),
    "DDR25": _servo(1_440_000 / 360, 102.4e-6),
    "DDR100": _servo(3_276_800 / 360, 102.4e-6),
}


class Config(AxisConfig):
    """An APT axis in a rig file. A unit or a rack has a USB port of its own; `serial_number` tells which one it is."""

    kind: Literal["apt"] = "apt"
    serial_number: int | None = Field(default=None, description="serial number; another device at this port is refused")
    bay: int | None = Field(default=None, ge=1, le=10, description="bay of a rack (BSC20x, BBD20x), from 1")
    stage: Literal["K10CR1", "PRM1-Z8", "HDR50", "NR360", "DDR05", "DDR25", "DDR100"] | None = Field(
        default=None, description="stage, where the controller does not tell it (KBD101, KST101, racks) or is not known"
    )
    home_speed_deg_s: float | None = Field(
        default=None, gt=0, description="sets the homing speed, which a unit forgets at power-off"
    )

    def place(self) -> str:
        return "" if self.bay is None else f"bay {self.bay}"


class APTLine(ControllerLine):
    """The port of one APT unit or of a rack."""

    def __init__(self, config: Config, clock: Clock, transcript: Transcript | None) -> None:
        super().__init__(config, clock, transcript, apt_framer, baudrate=115_200, reply_s=0.5)
        # The vendor's order of opening: a unit that is not reset so can stay silent.
        self.link.set_rts(True)
        clock.sleep_s(0.05)
        self.link.purge(0.0)
        clock.sleep_s(0.05)
        self.link.set_rts(False)

    def ask(self, request: bytes, reply_id: int) -> bytes:
        """Send a request and return the data of the reply with this id; in a rack, of the unit that was asked.

        Raises ReplyTimeout, ReplyError.
        """

        def data_of(frame: bytes) -> bytes | None:
            # All data but the hardware information start with the channel, which is 1.
            is_reply = len(frame) == 6 or reply_id == 0x0006 or frame[6:8] == b"\x01\x00"
            # A single unit may give another source than its own.
            is_reply = is_reply and (request[4] & 0x7F == UNIT or frame[5] == request[4] & 0x7F)
            data = frame[2:4] if len(frame) == 6 else frame[6:]
            return data if is_reply and int.from_bytes(frame[:2], "little") == reply_id else None

        title = f"APT {self.link.port}, {REPLY_NAMES.get(reply_id, hex(reply_id))}"
        advice = "Is it an APT unit, and the only program on it? A frozen unit needs its power switched off and on"
        return ask(self.link, request, data_of, self.reply_s, request=title, what_to_check=advice)


class APTAxis(MotionAxis):
    """The motor of one APT unit, channel 1; in a rack of the unit in a bay."""

    def __init__(self, name: str, config: Config, line: APTLine, lines: LineRegistry) -> None:
        super().__init__(name, config, lines.clock)
        self.config: Config = config
        self._line, self._lines = line, lines
        self._destination = UNIT if config.bay is None else BAY + config.bay - 1
        # Periodic messages of an earlier program would only disturb; this moves nothing.
        self._tell(0x0012)
        information = short_message(0x0005, to=UNIT if config.bay is None else RACK)
        info = agreed(lambda: line.ask(information, 0x0006))
        serial_number = int.from_bytes(info[0:4], "little")
        model = info[4:12].split(b"\0")[0].decode("ascii", "replace").strip()
        if config.serial_number not in (None, serial_number):
            raise WrongDevice(
                f"axis {name}, find APT unit {config.serial_number} on {config.port}",
                f"there is {model} with serial number {serial_number}",
                "Correct port or serial_number in the rig file; /dev/serial/by-id names ports by serial number",
            )
        if config.bay is not None:
            bay = config.bay - 1
            # The bay itself, and 1 where it holds a unit.
            if agreed(lambda: line.ask(short_message(0x0060, bay, to=RACK), 0x0061)) != bytes((bay, 1)):
                label = f"axis {name}, bay {config.bay} of {model} on {config.port}"
                raise WrongDevice(label, "it is empty", "Correct `bay` in the rig file")
        self._unknown = ""
        self._scale = self._find_scale(model, int.from_bytes(info[76:78], "little"))
        self.counts_per_deg = self._scale.position
        parameters = agreed(lambda: self._ask(0x0414, 0x0415))
        minimum, acceleration, velocity = struct.unpack_from("<3i", parameters, 2)
        if velocity <= 0 or acceleration <= 0:
            raise ReplyError(
                f"axis {name}, velocity parameters",
                f"velocity {velocity}, acceleration {acceleration}, minimum {minimum}",
                "Load the stage's settings with the vendor's software",
            )
        self.speed_deg_s = velocity / self._scale.velocity
        self.acceleration_deg_s2 = acceleration / self._scale.acceleration
        self._home_speed_deg_s = self._read_home_parameters()[2] / self._scale.velocity or self.speed_deg_s
        self._identify(
            model=model,
            serial_number=str(serial_number),
            firmware=".".join(str(part) for part in reversed(info[14:17])),
            address=f"{self._destination:#04x}",
        )

    def _tell(self, message_id: int, first: int = 0, second: int = 0) -> None:
        self._line.link.write(short_message(message_id, first, second, self._destination))

    def _ask(self, request_id: int, reply_id: int) -> bytes:
        return self._line.ask(short_message(request_id, 1, to=self._destination), reply_id)

    def _find_scale(self, model: str, stage: int) -> StageScale:
        if self.config.stage is not None:
            return STAGES[self.config.stage]
        if model.startswith("K10CR"):
            if model not in ("K10CR1", "K10CR2"):
                self._unknown = f"model {model} is not known here, treated as K10CR1"
            return K10CR1
        if model.startswith(("KDC101", "TDC001")) and stage == PRM1_Z8_STAGE:
            return PRM1_Z8
        raise WrongDevice(
            f"axis {self.name}, find the counts per degree",
            f"controller {model} with stage id {stage} is not known",
            f"Set `stage` in the rig file to one that counts alike: {', '.join(STAGES)}",
        )

    def _read_home_parameters(self) -> tuple[int, int, int, int]:
        """Return direction, limit switch, velocity and offset of homing."""
        data = agreed(lambda: self._ask(0x0441, 0x0442))
        direction, switch, velocity, offset = struct.unpack_from("<HHii", data, 2)
        return direction, switch, velocity, offset

    def _status_bits(self) -> int:
        return int.from_bytes(self._ask(0x0429, 0x042A)[2:6], "little")

    def _do_read_counts(self) -> int:
        return int.from_bytes(self._ask(0x0411, 0x0412)[2:6], "little", signed=True)

    def _do_is_homed(self) -> bool:
        # One flipped bit must not make a reference.
        return bool(self._status_bits() & self._status_bits() & HOMED)

    def _do_is_moving(self) -> bool:
        return bool((self._status_bits() | self._status_bits()) & MOVING_BITS)

    def _enable(self) -> None:
        if not self._status_bits() & ENABLED:
            self._tell(0x0210, 1, 1)

    def _do_start_move(self, counts: float) -> None:
        self._enable()
        self._line.link.write(long_message(0x0453, struct.pack("<Hi", 1, round(counts)), self._destination))

    def _do_start_home(self) -> None:
        """Start homing and wait until the unit says that it homes; the old `homed` bit may still stand till then."""
        direction, switch, velocity, offset = self._read_home_parameters()
        if self.config.home_speed_deg_s is not None:
            velocity = round(self.config.home_speed_deg_s * self._scale.velocity)
            parameters = struct.pack("<HHHii", 1, direction, switch, velocity, offset)
            self._line.link.write(long_message(0x0440, parameters, self._destination))
        if velocity <= 0:
            raise CommandRejected(
                f"axis {self.name}, home",
                f"the unit's homing speed is {velocity}: it would stand still",
                "Set home_speed_deg_s in the rig file; the unit forgets its homing parameters at power-off",
            )
        log.info(
            "axis %s homes: direction %d, switch %d, speed %.3f deg/s, offset %.3f deg",
            self.name, direction, switch, velocity / self._scale.velocity, offset / self._scale.position,
        )  # fmt: skip
        self._enable()
        self._tell(0x0443, 1)
        give_up_s = self.clock.now_s() + 0.3
        while self.clock.now_s() < give_up_s:
            bits = self._status_bits()
            if bits & HOMING or not bits & HOMED:
                return
            self.clock.sleep_s(0.01)

    def _do_stop(self) -> None:
        self._tell(0x0465, 1, 2)

    def _do_check_fault(self) -> None:
        bits = self._status_bits() & self._status_bits()
        names = {MOTION_ERROR: "motion error (position error too large)", ERROR: "error"}
        faults = [word for bit, word in names.items() if bits & bit]
        if faults:
            raise CommandRejected(f"axis {self.name}, state", f"fault {', '.join(faults)}", "Is the stage blocked?")

    def _do_warnings(self) -> list[str]:
        words = [self._unknown] if self._unknown else []
        if self._status_bits() & CURRENT_LIMIT:
            words.append("motor current limit reached")
        return words


def open(name: str, config: Config, lines: LineRegistry) -> APTAxis:
    """Open one unit; reads its identity, homing parameters and speed and moves nothing."""
    with lines.taken(config.port, APTLine, partial(APTLine, config, lines.clock)) as line:
        return APTAxis(name, config, line, lines)
