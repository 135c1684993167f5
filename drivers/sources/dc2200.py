"""Thorlabs DC2200 LED driver: one LED on each of two terminals, brightness in percent of the LED's limit, over USB.

SCPI as USB Test and Measurement Class, ``/dev/usbtmc0`` on Linux: `*IDN?`, `SOURce1:MODe CB` (constant brightness),
`SOURce1:CBRightness:BRIGhtness:AMPLitude 40`, `OUTPut1:STATe ON`, the same with a question mark to read,
`SYSTem:ERRor?` number and text.

Sources: Thorlabs' own PyVISA example for the DC2200, a public C++ and a public MATLAB driver (mode and brightness with
their queries), the manual of 2020, page 43 (error query, LED head). Unverified: `OUTPut1:STATe?` (SCPI's own form), the
word that `MODe?` answers, and USBTMC as a whole, which no emulator here speaks.
"""

import re
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.errors import CommandRejected, DeviceError, ReplyError, ReplyTimeout, WrongDevice
from drivers.message_device import MessageDevice
from drivers.serial_link import LineRegistry, agreed
from drivers.source import PortSource, SourceConfig, check_wavelengths

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?")
_STATE = re.compile(r"0|1|ON|OFF", re.IGNORECASE)
_ERROR = re.compile(r"([+-]?\d+),.*")
_IDENTITY = re.compile(r"[^,]+,[^,]+,[^,]+,[^,]+")
_MODE = re.compile(r"\w+")


class Config(SourceConfig):
    """DC2200 in a rig file."""

    kind: Literal["dc2200"] = "dc2200"
    port: str = Field(description="device file, such as /dev/usbtmc0")
    terminals: dict[float, Literal[1, 2]] = Field(min_length=1, description="wavelength in nm to terminal of its LED")
    percent: dict[float, Annotated[float, Field(ge=0, le=100)]] = Field(
        default={}, description="brightness by wavelength in nm, set when that is selected"
    )

    @model_validator(mode="after")
    def _one_led_for_each_wavelength(self) -> Self:
        check_wavelengths(self.terminals, "terminal", self.percent)
        return self


class Dc2200(PortSource):
    """A DC2200 in constant-brightness mode; at most one LED is on after a call of `select` or `set_light`."""

    selects_wavelength = True
    has_level = True

    def __init__(self, config: Config, device: MessageDevice, lines: LineRegistry) -> None:
        self.config: Config = config
        self._device, self._lines = device, lines
        self._name = f"LED driver on {config.port}"
        identity = agreed(lambda: self._ask("*IDN?", _IDENTITY))
        maker, self._model, self._serial_number, self._firmware = identity.split(",")
        if "DC2200" not in self._model.upper():
            raise WrongDevice(
                f"identify the {self._name}", f"{maker} {self._model} answers", "Correct `source` in the rig file"
            )
        self._used = sorted(set(config.terminals.values()))
        self._selected = self._used[0] if len(self._used) == 1 else None

    def select(self, wavelength_nm: float) -> None:
        """Choose the LED of a wavelength, and its brightness where the rig file gives one."""
        if wavelength_nm not in self.config.terminals:
            listing = ", ".join(f"{nm:g}" for nm in self.config.terminals)
            raise DeviceError(
                f"{self._name}, select {wavelength_nm:g} nm", f"its LEDs are {listing} nm", "Correct `terminals`"
            )
        on = self.is_on()
        self._selected = self.config.terminals[wavelength_nm]
        for terminal in self._used:
            if terminal != self._selected:
                self._switch(terminal, False)
        if wavelength_nm in self.config.percent:
            self.set_level(self.config.percent[wavelength_nm])
        if on:
            self._switch(self._selected, True)

    def set_light(self, on: bool) -> None:
        """Switch the selected LED and wait until the box agrees; off switches both off."""
        if not on:
            for terminal in self._used:
                self._switch(terminal, False)
            return
        if self._selected is None:
            raise DeviceError(f"{self._name}, light on", "no wavelength was selected", "Select one first")
        self._switch(self._selected, True)

    def is_on(self) -> bool:
        """True if any LED is on: light of another wavelength is light as well."""
        return any(self._output(terminal) for terminal in self._used)

    def set_level(self, percent: float) -> float:
        """Set the brightness of the selected LED; a change of mode shuts it off first."""
        request = f"{self._name}, level {percent:g} %"
        if not 0 <= percent <= 100:
            raise CommandRejected(request, "the range is 0 to 100 %", "Correct the level")
        if self._selected is None:
            raise DeviceError(request, "no wavelength was selected", "Select one first")
        source = f"SOURce{self._selected}"
        if self._ask(f"{source}:MODe?", _MODE).upper() != "CB":
            self._switch(self._selected, False)
            self._tell(f"{source}:MODe CB", request)
        self._tell(f"{source}:CBRightness:BRIGhtness:AMPLitude {percent:g}", request)
        reading = float(self._ask(f"{source}:CBRightness:BRIGhtness:AMPLitude?", _NUMBER))
        # The box may round to tenths of a percent.
        if abs(reading - percent) > 0.1:
            raise CommandRejected(request, f"it reads back {reading:g} %", "Look at the box and its LED")
        return reading

    def describe(self) -> dict[str, str]:
        """Kind, model, serial number, firmware and port."""
        return {
            "kind": self.config.kind,
            "model": self._model.strip(),
            "serial_number": self._serial_number.strip(),
            "firmware": self._firmware.strip(),
            "port": self.config.port,
        }

    def _switch(self, terminal: int, on: bool) -> None:
        request = f"{self._name}, LED {terminal} {'on' if on else 'off'}"
        if self._output(terminal) == on:
            return
        # Sent once: what became of it is read and not assumed.
        self._tell(f"OUTPut{terminal}:STATe {'ON' if on else 'OFF'}", request)
        if self._output(terminal) != on:
            raise CommandRejected(request, "its output did not follow", "Look at the box and its LED")

    def _output(self, terminal: int) -> bool:
        # One changed character must not make light of darkness.
        answers = [self._ask(f"OUTPut{terminal}:STATe?", _STATE).upper() in ("1", "ON") for _ in range(2)]
        if answers[0] != answers[1]:
            raise ReplyError(f"{self._name}, LED {terminal}", "two readings differ", "Check the cable")
        return answers[0]

    def _tell(self, command: str, request: str) -> None:
        with self._device.lock:
            self._device.write(command)
            code = int(self._ask("SYSTem:ERRor?", _ERROR).partition(",")[0])
        if code != 0:
            raise CommandRejected(request, f"error {code}", "The manual lists the errors")

    def _ask(self, query: str, form: re.Pattern[str]) -> str:
        """One query; without an answer of its form it is repeated once.

        An error is read once and would be lost with a garbled answer; the settings are read back as well.
        """
        answers: list[str] = []
        with self._device.lock:
            for _ in range(2):
                self._device.drop_input()
                self._device.write(query)
                # A late answer of the query before may come first.
                for _ in range(2):
                    answer = self._device.read(self.config.reply_s)
                    if answer is None:
                        break
                    if form.fullmatch(answer):
                        return answer
                    answers.append(answer)
        request = f"{self._name}, {query}"
        if answers:
            raise ReplyError(request, f"no sense in {answers}", "Check the cable")
        raise ReplyTimeout(request, f"no reply in {self.config.reply_s:g} s, twice", "Check power and cable")


def open(config: Config, lines: LineRegistry) -> Dc2200:
    """Open the LED driver; reads its identity and changes nothing."""
    with lines.taken(
        config.port, MessageDevice, lambda _: MessageDevice(config.port, lines.clock, config.held_by)
    ) as device:
        return Dc2200(config, device, lines)
