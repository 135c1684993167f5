"""Thorlabs DC4100 and DC4104 four-channel LED drivers: one LED for each wavelength, brightness in percent.

Text protocol on USB serial, 115200 8N1, no flow control: a command ends in CR LF, a query answers with one line, a
setting answers nothing. Channels count from 0 on the wire and from 1 on the front. `N?` name, `S?` serial number,
`V?` firmware, `WL? i` nm, `O? i` and `O i 1` output, `BP? i` and `BP i 40` percent, `M?` and `M 1` mode (0 current,
1 brightness, 2 external), `R?` status as a decimal number, `E?` last error as text, code, colon, text.

Sources: the commands are not in the manual; Micro-Manager's DC4100 adapter, written at Thorlabs, and public drivers of
three other projects agree on them. Status bits: DC4100 manual, rev. 2.2 of 2022, page 28. Not yet tried on a real
box: the exact text of `E?`, and the number format of `BP?`, which the adapter reads as a floating point number.
"""

import re
from functools import partial
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.errors import CommandRejected, DeviceError, ReplyError, WrongDevice
from drivers.serial_link import LineRegistry, SerialLink, agreed, line_framer
from drivers.source import PortSource, SourceConfig, check_wavelengths
from drivers.unmarked_replies import ask, text_of

BAUDRATE = 115200
MODELS = ("DC4100", "DC4104")
BRIGHTNESS_MODE = 1
SUPPLY_FAILS, TOO_HOT = 1 << 1, 1 << 3
# LEDs carry a nominal wavelength that can be some nm off the measured one.
_NEAR_NM = 15.0
_LINE = re.compile(r".*")
_NUMBER = re.compile(r"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?")


def missing_led(channel: int) -> int:
    """Status bit that says that no LED is connected to a channel (from 0)."""
    return 1 << (5 + 2 * channel)


def open_led(channel: int) -> int:
    """Status bit that says that the LED of a channel (from 0) is broken or unplugged."""
    return 1 << (13 + 2 * channel)


class Config(SourceConfig):
    """DC4100 in a rig file."""

    kind: Literal["dc4100"] = "dc4100"
    channels: dict[float, Annotated[int, Field(ge=1, le=4)]] = Field(
        default={}, description="wavelength in nm to channel 1 to 4; empty: as the LEDs say themselves"
    )
    percent: dict[float, Annotated[float, Field(ge=0, le=100)]] = Field(
        default={}, description="brightness by wavelength in nm, set when that is selected"
    )

    @model_validator(mode="after")
    def _one_led_for_each_wavelength(self) -> Self:
        # Without `channels` the wavelengths are read from the box later.
        check_wavelengths(self.channels, "channel", self.percent if self.channels else ())
        return self


class Dc4100(PortSource):
    """A DC4100 or DC4104. At most one LED is on after a call of `select` or `set_light`."""

    selects_wavelength = True
    has_level = True

    def __init__(self, config: Config, link: SerialLink, lines: LineRegistry) -> None:
        self.config: Config = config
        self._link, self._lines = link, lines
        self._model, self._serial_number, self._firmware = (
            agreed(partial(self._ask, query)) for query in ("N?", "S?", "V?")
        )
        if self._model not in MODELS:
            raise WrongDevice(
                f"identify the LED driver on {config.port}",
                f"it answers {self._model!r}, which is none of {', '.join(MODELS)}",
                "Correct `source` in the rig file",
            )
        status = self._status()
        self._present = [channel for channel in range(4) if not status & missing_led(channel)]
        self._nominal_nm = {channel: self._number(f"WL? {channel}") for channel in self._present}
        on = [channel for channel in self._present if self._output(channel)]
        self._selected = on[0] if len(on) == 1 else None

    # --- light -------------------------------------------------------------------------------------------

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """What `select` offers, in nm."""
        if self.config.channels:
            return tuple(self.config.channels)
        return tuple(self._nominal_nm[channel] for channel in self._present)

    def select(self, wavelength_nm: float) -> None:
        """Choose the LED of a wavelength, and its brightness where the rig file gives one.

        If light was on, the old LED goes off and then the new one on.
        """
        channel = self._channel_of(wavelength_nm)
        on = self.is_on()
        self._selected = channel
        for unselected in self._present:
            if unselected != channel:
                self._switch(unselected, False)
        if wavelength_nm in self.config.percent:
            self.set_level(self.config.percent[wavelength_nm])
        if on:
            self._switch(channel, True)

    def set_light(self, on: bool) -> None:
        """Switch the selected LED and wait until the box agrees; off switches every LED off."""
        if not on:
            for channel in self._present:
                self._switch(channel, False)
            return
        if self._selected is None:
            if len(self._present) != 1:
                raise DeviceError(
                    f"LED driver on {self.config.port}, light on",
                    "no wavelength was selected",
                    f"Select one of {', '.join(f'{nm:g}' for nm in self.wavelengths_nm)} nm first",
                )
            self._selected = self._present[0]
        self._switch(self._selected, True)

    def is_on(self) -> bool:
        """True if any LED is on: light of another wavelength is light as well."""
        return any(self._output(channel) for channel in self._present)

    def set_level(self, percent: float) -> float:
        """Set the brightness of the selected LED, in brightness mode; a change of mode shuts the light off first."""
        request = f"LED driver on {self.config.port}, level {percent:g} %"
        if not 0 <= percent <= 100:
            raise CommandRejected(request, "the range is 0 to 100 %", "Correct the level")
        if self._selected is None:
            raise DeviceError(request, "no wavelength was selected", "Select one first")
        if self._digit("M?", "012") != BRIGHTNESS_MODE:
            self.set_light(False)
            self._tell(f"M {BRIGHTNESS_MODE}")
            if self._digit("M?", "012") != BRIGHTNESS_MODE:
                raise self._rejection(request, "it does not change to brightness mode")
        self._tell(f"BP {self._selected} {percent:g}")
        reading = self._number(f"BP? {self._selected}")
        # The box may round to whole percents.
        if abs(reading - percent) > 0.5:
            raise self._rejection(request, f"it reads back {reading:g} %")
        return reading

    def describe(self) -> dict[str, str]:
        """Kind, model, serial number, firmware, port, and the LEDs by channel with their nominal wavelengths."""
        leds = ", ".join(f"{channel + 1}: {nm:g} nm" for channel, nm in self._nominal_nm.items())
        return {
            "kind": self.config.kind,
            "model": self._model,
            "serial_number": self._serial_number,
            "firmware": self._firmware,
            "port": self.config.port,
            "leds": leds,
        }

    # --- channels ----------------------------------------------------------------------------------------

    def _channel_of(self, wavelength_nm: float) -> int:
        if self.config.channels:
            channel = self.config.channels.get(wavelength_nm, 0) - 1
            if channel in self._present:
                return channel
        else:
            near = [c for c in self._present if abs(self._nominal_nm[c] - wavelength_nm) <= _NEAR_NM]
            if len(near) == 1:
                return near[0]
        raise DeviceError(
            f"LED driver on {self.config.port}, select {wavelength_nm:g} nm",
            f"its LEDs are {self.describe()['leds'] or 'none'}",
            "Plug the LED in, or give `channels` in the rig file",
        )

    def _switch(self, channel: int, on: bool) -> None:
        request = f"LED driver on {self.config.port}, LED {channel + 1} {'on' if on else 'off'}"
        if self._output(channel) == on:
            return
        # Sent once: what became of it is read and not assumed.
        self._tell(f"O {channel} {int(on)}")
        if self._output(channel) != on:
            raise self._rejection(request, "its output did not follow", channel)

    def _output(self, channel: int) -> bool:
        return self._digit(f"O? {channel}", "01") == 1

    def _status(self) -> int:
        return int(self._number("R?"))

    def _rejection(self, request: str, came_back: str, channel: int | None = None) -> CommandRejected:
        status = self._status()
        reasons = {SUPPLY_FAILS: "its supply is out of range", TOO_HOT: "it is too hot and has shut off all LEDs"}
        if channel is not None:
            reasons[missing_led(channel)] = reasons[open_led(channel)] = "no LED is connected there"
        remarks = [text for bit, text in reasons.items() if status & bit]
        error = re.search(r"(-?\d+)\s*:?\s*(.*)", self._ask("E?"))
        if error is not None and int(error[1]) != 0:
            remarks.append(f"error {error[1]} {error[2]}".strip())
        return CommandRejected(request, "; ".join([came_back, *remarks]), "Look at the box and its LEDs")

    # --- wire --------------------------------------------------------------------------------------------

    def _digit(self, query: str, allowed: str) -> int:
        """Ask until two answers in a row agree: there is no checksum, and one changed bit makes a 1 of a 0."""
        answers = [self._ask(query)]
        for _ in range(3):
            answers.append(self._ask(query))
            if answers[-1] == answers[-2] and answers[-1] in allowed and answers[-1]:
                return int(answers[-1])
            self._link.purge()
        raise self._reply_error(query, " ".join(answers))

    def _number(self, query: str) -> float:
        return float(agreed(lambda: self._ask(query, _NUMBER)))

    def _ask(self, query: str, form: re.Pattern[str] = _LINE) -> str:
        """One query; without a reply of the form it is repeated once, after the line has been quiet."""
        return ask(
            self._link,
            query.encode("ascii") + b"\r\n",
            text_of(form),
            self.config.reply_s,
            request=f"LED driver on {self.config.port}, {query}",
            what_to_check="Check power and cable, and that the port is that of the LED driver",
        )

    def _tell(self, command: str) -> None:
        with self._link.lock:
            self._link.write(command.encode("ascii") + b"\r\n")

    def _reply_error(self, query: str, answer: str) -> ReplyError:
        return ReplyError(
            f"LED driver on {self.config.port}, {query}", f"no sense in {answer!r}", "Check cable and grounding"
        )


def open(config: Config, lines: LineRegistry) -> Dc4100:
    """Open the LED driver; reads its identity and its LEDs, and changes nothing."""
    with lines.link(config, BAUDRATE, line_framer) as link:
        return Dc4100(config, link, lines)
