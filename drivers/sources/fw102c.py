"""Thorlabs FW102C and FW212C filter wheels: filters choose the wavelength; an opaque position or a shutter makes dark.

115200 8N1, commands in lower case: `*idn?` model and firmware, `pos?`, `pos=3` which is answered when the wheel
stands there, `pcount?` 6 or 12. The line is that of `drivers.prompt_line`.

Sources: manual of the FW102C, rev. H of 2014, page 11; ISIS' EPICS driver; public Python drivers (hispec, whose
comments show echo, answer and prompt; python-microscopy). Unverified: text of `*idn?`, and what a wheel that is
blocked answers.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.errors import DeviceError, WrongDevice
from drivers.prompt_line import PromptLine
from drivers.serial_link import LineRegistry, SerialLink
from drivers.shuttered_source import ShutteredConfig, ShutteredSource, open_with_shutter
from drivers.source import LightSource, check_wavelengths
from drivers.sources import sc10

BAUDRATE = 115200
MODELS = ("FW102C", "FW212C")
Position = Annotated[int, Field(ge=1, le=12)]


class Config(ShutteredConfig):
    """FW102C in a rig file; light is shut off by an opaque filter (`dark_position`) or by a shutter beside it."""

    kind: Literal["fw102c"] = "fw102c"
    positions: dict[float, Position] = Field(min_length=1, description="wavelength in nm to position on the wheel")
    dark_position: Position | None = Field(default=None, description="position of an opaque filter")
    shutter: sc10.Config | None = Field(default=None, description="SC10 shutter beside the wheel")
    turn_s: float = Field(default=8.0, gt=0, description="longest time for the wheel to turn")

    @model_validator(mode="after")
    def _one_way_to_make_dark(self) -> Self:
        if (self.dark_position is None) == (self.shutter is None):
            raise ValueError("give dark_position or shutter, one of them: light must be shut off for dark states")
        if self.dark_position in self.positions.values():
            raise ValueError(f"dark_position {self.dark_position} is that of a wavelength as well")
        check_wavelengths(self.positions, "position")
        return self


class FilterWheel(ShutteredSource):
    """A wheel with a filter for each wavelength."""

    selects_wavelength = True

    def __init__(self, config: Config, link: SerialLink, shutter: LightSource | None, lines: LineRegistry) -> None:
        self.config: Config = config
        self._shutter, self._lines = shutter, lines
        self._name = f"filter wheel on {config.port}"
        self._line = PromptLine(link, self._name, config.reply_s)
        self._model = self._line.ask("*idn?")
        if not any(model in self._model.upper() for model in MODELS):
            raise WrongDevice(
                f"identify the {self._name}",
                f"it answers {self._model!r}, which is none of {', '.join(MODELS)}",
                "Correct `source` in the rig file",
            )
        count = self._line.ask_number("pcount?")
        highest = max(*config.positions.values(), config.dark_position or 1)
        if highest > count:
            raise WrongDevice(
                f"{self._name}, position {highest}", f"the wheel has {count}", "Correct `positions` in the rig file"
            )
        position = self._line.ask_number("pos?")
        self._selected = position if position in config.positions.values() else None

    def select(self, wavelength_nm: float) -> None:
        """Turn to the filter of a wavelength; a wheel that stands dark turns there when light is wanted."""
        if wavelength_nm not in self.config.positions:
            listing = ", ".join(f"{nm:g}" for nm in self.config.positions)
            raise DeviceError(
                f"{self._name}, select {wavelength_nm:g} nm", f"its filters are {listing} nm", "Correct `positions`"
            )
        dark = self.config.dark_position is not None and not self.is_on()
        self._selected = self.config.positions[wavelength_nm]
        if not dark:
            self._turn(self._selected)

    def set_light(self, on: bool) -> None:
        """Open or close the shutter, or turn to the selected filter or the opaque one."""
        if self._selected is None and on:
            raise DeviceError(f"{self._name}, light on", "no wavelength was selected", "Select one first")
        if self._shutter is not None:
            self._shutter.set_light(on)
        elif on and self._selected is not None:
            self._turn(self._selected)
        elif self.config.dark_position is not None:
            self._turn(self.config.dark_position)

    def is_on(self) -> bool:
        """True if the shutter is open, or no opaque filter stands in the beam."""
        if self._shutter is not None:
            return self._shutter.is_on()
        return self._line.ask_number("pos?") != self.config.dark_position

    def _facts(self) -> dict[str, str]:
        filters = ", ".join(f"{position}: {nm:g} nm" for nm, position in self.config.positions.items())
        return {"filters": filters}

    def _turn(self, position: int) -> None:
        if self._line.ask_number("pos?") == position:
            return
        # Answered when the wheel stands there; what became of it is read and not assumed.
        self._line.tell(f"pos={position}", self.config.turn_s)
        reading = self._line.ask_number("pos?")
        if reading != position:
            raise DeviceError(
                f"{self._name}, turn to position {position}",
                f"it stands at {reading} after {self.config.turn_s:g} s",
                "Look whether the wheel is blocked",
            )


def open(config: Config, lines: LineRegistry) -> FilterWheel:
    """Open the wheel, and the shutter where there is one; reads their identity and changes nothing."""
    return open_with_shutter(FilterWheel, config, lines, BAUDRATE)
