"""Newport Oriel Cornerstone monochromators (130, 260 and their B versions), with the shutter that is built in.

Lines that end in CR LF, over RS-232 (9600 8N1, where the instrument repeats a statement before it answers) or as a
serial port on USB (no echo). `INFO?` model, `WAVE?` nm, `GOWAVE 500`, `SHUTTER?` C or O, `SHUTTER O`, and `ERROR?`
for the last error. A move holds up the answers until it ends.

Sources: user manuals MCS260 (pages 49 to 51) and MCS260B (pages 45, 46, 62), the public drivers oriel-cornerstone-260
and two for the CS260. Gratings, filters and slits stay as they are set. Unverified on hardware: everything; that a
query waits for the end of a move.
"""

import re
from typing import Literal

from pydantic import Field

from drivers.errors import CommandRejected, DeviceError, WrongDevice
from drivers.serial_link import LineRegistry, SerialLink, agreed, line_framer
from drivers.source import PortSource, SourceConfig
from drivers.unmarked_replies import ask, text_of

ERRORS = {1: "command not understood", 2: "bad parameter", 3: "destination not allowed", 8: "cannot home the drive"}
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
_CODE = re.compile(r"\d\d?")
_SHUTTER = re.compile(r"[CO]")
# Not an echo, which ends in a question mark.
_INFO = re.compile(r"(?=.*[a-zA-Z]).+[^?]")


class Config(SourceConfig):
    """Cornerstone in a rig file."""

    kind: Literal["cornerstone"] = "cornerstone"
    range_nm: tuple[float, float] = Field(description="wavelengths that its gratings are used for, nm")
    baudrate: int = Field(default=9600, description="bits a second, as the instrument is set")
    tolerance_nm: float = Field(default=0.1, gt=0, description="largest allowed distance from the wavelength, nm")
    move_s: float = Field(default=30.0, gt=0, description="longest time for the gratings and the shutter to move")


class Monochromator(PortSource):
    """A monochromator behind a lamp."""

    selects_wavelength = True

    def __init__(self, config: Config, link: SerialLink, lines: LineRegistry) -> None:
        self.config: Config = config
        self._link, self._lines = link, lines
        self._name = f"monochromator on {config.port}"
        self._model = agreed(lambda: self._ask("INFO?", _INFO))
        if not re.search(r"cornerstone|oriel|CS\d{3}|\b74\d{3}", self._model, re.IGNORECASE):
            raise WrongDevice(
                f"identify the {self._name}", f"{self._model!r} is no Cornerstone", "Correct `source` in the rig file"
            )

    def _ask(self, query: str, form: re.Pattern[str], reply_s: float | None = None) -> str:
        return ask(
            self._link,
            f"{query}\r\n".encode("ascii"),
            text_of(form),
            reply_s or self.config.reply_s,
            request=f"{self._name}, {query}",
            what_to_check="Check power, cable and baud rate",
        )

    def _tell(self, command: str) -> None:
        """Send a command once, and ask for the error that it may have left."""
        with self._link.lock:
            self._ask("ERROR?", _CODE)
            self._link.write(f"{command}\r\n".encode("ascii"))
            code = int(self._ask("ERROR?", _CODE, self.config.move_s))
        if code:
            words = f"error {code}: {ERRORS.get(code, 'see the manual')}"
            raise CommandRejected(f"{self._name}, {command}", words, "Correct the plan, or look at the instrument")

    def select(self, wavelength_nm: float) -> None:
        """Go to a wavelength and read it back; the shutter stays as it is."""
        request, (low, high) = f"{self._name}, select {wavelength_nm:g} nm", self.config.range_nm
        if not low <= wavelength_nm <= high:
            raise DeviceError(request, f"its range is {low:g} to {high:g} nm", "Correct the plan or `range_nm`")
        self._tell(f"GOWAVE {wavelength_nm:.3f}")
        # A late answer to another question is a number as well.
        reading_nm = agreed(lambda: float(self._ask("WAVE?", _NUMBER, self.config.move_s)))
        if abs(reading_nm - wavelength_nm) > self.config.tolerance_nm:
            raise DeviceError(request, f"it stands at {reading_nm:g} nm", "Look whether its drive is blocked")

    def set_light(self, on: bool) -> None:
        """Open or close the shutter and read it back."""
        self._tell(f"SHUTTER {'O' if on else 'C'}")
        if self.is_on() != on:
            raise DeviceError(f"{self._name}, {'open' if on else 'close'}", "its shutter did not follow", "Look at it")

    def is_on(self) -> bool:
        """True if the shutter is open."""
        # One changed letter must not make dark of light.
        answers = [self._ask("SHUTTER?", _SHUTTER) for _ in range(2)]
        if answers[0] != answers[1]:
            raise DeviceError(f"{self._name}, SHUTTER?", "two readings differ", "Check the cable")
        return answers[0] == "O"


def open(config: Config, lines: LineRegistry) -> Monochromator:
    """Open the monochromator; reads its identity and changes nothing."""
    with lines.link(config, config.baudrate, line_framer) as link:
        return Monochromator(config, link, lines)
