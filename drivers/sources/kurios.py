"""Thorlabs KURIOS tunable filters: any wavelength of their range, in a band that a rig file chooses, before a lamp.

115200 8N1, commands that end in CR, answers ``WL=550.000`` and the prompt ``>`` without an echo. A KURIOS-VB1 blocks
light in the band BLACK; other heads make dark with a shutter.

Documents: user guide of the KURIOS-VB1, rev. G of 2019, pages 17 to 22 (baud rate, prompt, CMD_NOT_DEFINED, ``*idn?``,
``SP?``, ``OH?``, bands); Thorlabs' serial example (github.com/Thorlabs/Light_Control_and_Manipulation_Examples,
C#/KURIOS): ``ST?`` (0 initialization, 1 warm-up, 2 ready), ``OM=1`` (manual), ``WL``, ``BW``. Unverified: everything on
hardware.
"""

import re
from typing import Literal

from pydantic import Field

from drivers.errors import DeviceError, WrongDevice
from drivers.prompt_line import PromptLine
from drivers.serial_link import LineRegistry, SerialLink, agreed
from drivers.shuttered_source import ShutteredConfig, ShutteredSource, open_with_shutter
from drivers.source import LightSource
from drivers.sources import sc10

BAUDRATE = 115200
BLACK = 1
BANDS = {"wide": 2, "medium": 4, "narrow": 8}
READY, MANUAL = 2, 1
# A filter reports its setting to three digits.
_SAME_NM = 0.01
_NUMBER = r"-?\d+(?:\.\d+)?"


class Config(ShutteredConfig):
    """KURIOS in a rig file; light is shut off by the band BLACK, or by a shutter beside the filter."""

    kind: Literal["kurios"] = "kurios"
    band: Literal["wide", "medium", "narrow"] = Field(default="wide", description="bandwidth mode")
    shutter: sc10.Config | None = Field(default=None, description="SC10 shutter, where the filter has no band BLACK")
    settle_s: float = Field(default=0.3, ge=0, description="time that the liquid crystals take after a change")


class TunableFilter(ShutteredSource):
    """A filter between lamp and sample."""

    selects_wavelength = True

    def __init__(self, config: Config, link: SerialLink, shutter: LightSource | None, lines: LineRegistry) -> None:
        self.config: Config = config
        self._link, self._shutter, self._lines = link, shutter, lines
        self._name = f"tunable filter on {config.port}"
        self._line = PromptLine(link, self._name, config.reply_s, echo=False)
        # A late answer to the question of another program has no echo to know it by.
        self._model = agreed(lambda: self._line.ask("*idn?"))
        if "KURIOS" not in self._model.upper():
            raise WrongDevice(
                f"identify the {self._name}",
                f"it answers {self._model!r}, which is no KURIOS",
                "Correct `source` in the rig file",
            )
        bands = int(self._value("OH")) & 0xFF
        if not bands & BANDS[config.band]:
            raise WrongDevice(f"{self._name}, band {config.band}", "it has none", "Correct `band` in the rig file")
        if shutter is None and not bands & BLACK:
            raise WrongDevice(f"{self._name}, dark", "it has no band BLACK", "Add a `shutter` to the rig file")
        limits = re.compile(rf"WLmax=({_NUMBER}) WLmin=({_NUMBER})")
        match = limits.fullmatch(self._line.ask("SP?", limits))
        self._range_nm = (float(match[2]), float(match[1])) if match else (0.0, 0.0)

    def _value(self, keyword: str) -> float:
        form = re.compile(rf"{keyword}=({_NUMBER})")
        return float(self._line.ask(f"{keyword}?", form).partition("=")[2])

    def _set(self, keyword: str, value: float) -> None:
        """Set a value where it is another one, wait for the liquid crystals, and read it back."""
        if abs(self._value(keyword) - value) <= _SAME_NM:
            return
        self._line.tell(f"{keyword}={value:g}")
        self._link.clock.sleep_s(self.config.settle_s)
        echo = self._value(keyword)
        if abs(echo - value) > _SAME_NM:
            raise DeviceError(f"{self._name}, {keyword}={value:g}", f"it reads back {echo:g}", "Is it in manual mode?")

    def _require_ready(self) -> None:
        if self._value("ST") != READY:
            raise DeviceError(f"{self._name}, state", "it warms up", "Wait until its display shows a wavelength")

    def select(self, wavelength_nm: float) -> None:
        """Tune to a wavelength of the filter's range; a filter that is black stays so."""
        low, high = self._range_nm
        if not low <= wavelength_nm <= high:
            raise DeviceError(
                f"{self._name}, select {wavelength_nm:g} nm", f"its range is {low:g} to {high:g} nm", "Correct the plan"
            )
        self._require_ready()
        self._set("OM", MANUAL)
        self._set("WL", wavelength_nm)

    def set_light(self, on: bool) -> None:
        """Open or close the shutter, or change between the band of the rig file and BLACK."""
        self._require_ready()
        if self._shutter is None:
            self._set("BW", BANDS[self.config.band] if on else BLACK)
            return
        if on:
            self._set("BW", BANDS[self.config.band])
        self._shutter.set_light(on)

    def is_on(self) -> bool:
        """True if the shutter is open, or the band is not BLACK."""
        open_ = self._shutter is None or self._shutter.is_on()
        return open_ and self._value("BW") != BLACK

    def _facts(self) -> dict[str, str]:
        return {"band": self.config.band}


def open(config: Config, lines: LineRegistry) -> TunableFilter:
    """Open the filter, and the shutter where there is one; reads their identity and changes nothing."""
    return open_with_shutter(TunableFilter, config, lines, BAUDRATE)
