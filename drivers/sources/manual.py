"""A light source without a cable: the operator switches it when asked to."""

from collections.abc import Callable
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.errors import DeviceError
from drivers.serial_link import LineRegistry
from drivers.source import LightSource

Ask = Callable[[str], bool]


class Config(BaseModel):
    """A source switched by hand, in a rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["manual"] = "manual"
    wavelengths_nm: tuple[float, ...] = Field(default=(), description="what can be put in; empty: anything")


class ManualSource(LightSource):
    """Asks the operator to change what has to change, and believes the answer.

    Attributes
    ----------
    ask : shows a question and returns True for yes; None without an operator.
    yes : True takes every answer as yes without asking (`--yes`).
    """

    selects_wavelength = True

    def __init__(self, config: Config, ask: Ask | None = None, *, yes: bool = False) -> None:
        self.config = config
        self.ask = ask
        self.yes = yes
        self._wavelength_nm: float | None = None
        # Its state is unknown yet; lamps usually are on.
        self._on = True

    def select(self, wavelength_nm: float) -> None:
        """Ask for another wavelength; not asked again while it is the same."""
        wavelengths_nm = self.config.wavelengths_nm
        if wavelengths_nm and wavelength_nm not in wavelengths_nm:
            raise DeviceError(
                f"manual source, select {wavelength_nm:g} nm",
                f"the rig file lists {', '.join(f'{nm:g}' for nm in wavelengths_nm)} nm",
                "Correct wavelengths_nm in the rig file or the plan",
            )
        if wavelength_nm != self._wavelength_nm:
            self._confirm(f"Switch the source to {wavelength_nm:g} nm. Done?")
            self._wavelength_nm = wavelength_nm

    def set_light(self, on: bool) -> None:
        """Ask to uncover or cover the source; not asked again while it is the same."""
        if on != self._on:
            self._confirm("Uncover the source. Done?" if on else "Cover the source. Done?")
            self._on = on

    def is_on(self) -> bool:
        """The state that the operator confirmed last; True before any question."""
        return self._on

    def describe(self) -> dict[str, str]:
        """Kind, and that nothing of it can be read."""
        return {"kind": "manual", "model": "switched by the operator", "port": "none"}

    def close(self) -> None:
        """Nothing to release."""

    def _confirm(self, question: str) -> None:
        if self.yes:
            return
        if self.ask is None:
            raise DeviceError(
                f"manual source, {question!r}", "nobody can be asked", "Use a terminal, or --yes if it is done"
            )
        if not self.ask(question):
            raise DeviceError(f"manual source, {question!r}", "the operator said no", "Start again when it is done")


def open(config: Config, lines: LineRegistry, ask: Ask | None = None, *, yes: bool = False) -> ManualSource:
    """Make the source; asks nothing yet. `lines` is unused: every kind of source is opened with the same arguments."""
    return ManualSource(config, ask, yes=yes)
