"""Observers of a run: progress bar, live page, campaign log, and those of the rig."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.motion import Position
from processing.instrument.states import StateTable

#: Names of the channels over the super-pixel, row by row from the top left.
Mosaic = tuple[tuple[str, ...], ...]


@dataclass(frozen=True)
class StateReport:
    """Report of one state whose frames are being written."""

    state: int
    role: str
    positions: dict[str, Position]
    exposure_s: float
    saturated_fraction: float
    near_black_fraction: float
    monitor: float
    pixels: NDArray[np.uint16]


class Observer:
    """Hears what happens; every method may be left as it is. It must return at once and never raise."""

    def campaign_progress(self, number: int, total: int, name: str) -> None:
        """A campaign comes to its capture `number`, counted from 0."""

    def run_started(self, title: str, table: StateTable, pending: int, mosaic: Mosaic | None) -> None:
        """A capture begins with so many states to take; `mosaic` lays out the analyzers of a polarization camera."""

    def activity(self, text: str) -> None:
        """The present activity of the rig, in a few words."""

    def exposing(self, state: int, retake: int) -> None:
        """The next exposure belongs to this state; `retake` counts its tries from 0."""

    def state_done(self, report: StateReport) -> None:
        """A state was handed to the writer."""

    def warning(self, text: str) -> None:
        """Something that a person should know; also kept in the capture."""

    def run_ended(self, status: str, details: dict[str, Any]) -> None:
        """The capture is sealed or given up."""
