"""Thorlabs SC10 beam shutter controller: shutter for dark states, interlock input for the door.

Text protocol, 9600 8N1, as `drivers.prompt_line` has it. `ens` toggles the enable state, `ens?` reads it, `closed?`
reads the blade, `interlock?` is 1 while the interlock circuit is open (Thorlabs' SC10 user guide, rev. K of 2017, pages
12 and 13; not yet tried on the real box).
"""

from typing import Literal

from pydantic import Field

from drivers.errors import CommandRejected, DeviceError, WrongDevice
from drivers.prompt_line import PromptLine, prompt_framer
from drivers.serial_link import LineRegistry, SerialLink
from drivers.source import PortSource, SourceConfig

BAUDRATE = 9600


class Config(SourceConfig):
    """SC10 in a rig file."""

    kind: Literal["sc10"] = "sc10"
    blade_s: float = Field(default=1.0, gt=0, description="longest time for the blade to open or close")


class Shutter(PortSource):
    """SC10 in manual mode: light is on while the shutter is enabled."""

    def __init__(self, config: Config, link: SerialLink, lines: LineRegistry) -> None:
        self.config: Config = config
        self._link, self._lines = link, lines
        self._line = PromptLine(link, f"shutter on {config.port}", config.reply_s)
        self._model = self._line.ask("id?")
        if "SC10" not in self._model.upper():
            raise WrongDevice(
                f"identify the shutter on {config.port}",
                f"it answers {self._model!r}, which is no SC10",
                "Correct `source` in the rig file",
            )

    def set_light(self, on: bool) -> None:
        """Open or close the blade and wait until `closed?` agrees."""
        request = f"shutter on {self.config.port}, {'open' if on else 'close'}"
        if on and self.interlock_open():
            raise CommandRejected(request, "its interlock is open", "Close the door or the interlock circuit")
        if self._line.ask("mode?") != "1":
            self._line.tell("mode=1")
        # `ens` toggles: it is sent only after a fresh reading and never repeated.
        if self._flag("ens?") != on:
            self._line.tell("ens")
        deadline_s = self._link.clock.now_s() + self.config.blade_s
        while self._flag("closed?") == on:
            if self._link.clock.now_s() > deadline_s:
                state = "closed" if on else "open"
                raise DeviceError(request, f"the blade is still {state} after {self.config.blade_s:g} s", "Look at it")
            self._link.clock.sleep_s(0.005)

    def is_on(self) -> bool:
        """True if the blade is open."""
        return not self._flag("closed?")

    def interlock_open(self) -> bool:
        """True if the interlock circuit is open."""
        return self._flag("interlock?")

    def _flag(self, query: str) -> bool:
        return self._line.ask_number(query) != 0


def open(config: Config, lines: LineRegistry) -> Shutter:
    """Open the shutter; sends one `id?` and changes nothing."""
    with lines.link(config, BAUDRATE, prompt_framer) as link:
        return Shutter(config, link, lines)
