"""Effects of an instrument, and the families that the diagnosis asks for.

An effect derives from every family that it belongs to; what belongs to none changes the rows of W and nothing else.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np

from processing.arrays import Array
from processing.effect import Effect, Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import Belongs, InstrumentModel, Retarder


class InstrumentEffect(Effect, ABC):
    """One thing that an instrument model can lack.

    `belongs_to` says which captures share its values; an instrument file may declare another (`belongs_to` there).
    """

    belongs_to: ClassVar[Belongs] = "wavelength"
    #: What of the product stands as it was at one moment of the capture, and which; None: nothing depends on time.
    reference: ClassVar[str | None] = None

    @abstractmethod
    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """Where it can act in this instrument: element, axis or channel names; ("",) for the whole; () for nowhere."""

    @abstractmethod
    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """The parameters at a place."""

    @abstractmethod
    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Add the effect of `values`, one for each parameter, to the changes."""

    def starts(self) -> tuple[Array, ...]:
        """Values far from zero from which a fit starts as well."""
        return ()

    def log_price(self, model: InstrumentModel, conditions: Conditions, place: str) -> float:
        """Log odds by which it is rarer at this place than an effect of the list."""
        return 0.0

    def moves_image(self, place: str) -> bool:
        """Whether it moves the image at this place, which is undone by moving the frames back."""
        return False

    def reaches_around(self, place: str) -> bool:
        """Whether it mixes a pixel with those around it at this place: the image is moved, or blurred."""
        return self.moves_image(place)

    def acts_on_counts(self, place: str) -> bool:
        """Whether it changes the counts at this place: the image is moved, or the response is bent or shifted."""
        return False

    def is_pointwise(self, place: str) -> bool:
        """Whether it changes every count by itself at this place, so that `undo` gives the counts of the light."""
        return False

    def undo(self, signal: Array, conditions: Conditions, place: str, values: Array) -> tuple[Array, Array]:
        """Signal (N, channels, ...), counts over full scale, without a pointwise effect, exactly, and its slope."""
        raise NotImplementedError(f"{self.kind} at {place!r} is not pointwise")

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        """Values of the train ("element.field") that it shifts and does nothing else."""
        return ()


class OpticsEffect(InstrumentEffect):
    """Changes the polarization elements or the detector channels; a known surface shows it too."""


class ChannelLevels(OpticsEffect):
    """Changes how bright the channels are against each other, and nothing of their polarization."""


class LevelEffect(InstrumentEffect):
    """Changes all channels of a state by one factor: a source whose level is free (`free_source`) takes it up."""


class SourceEffect(LevelEffect):
    """Changes the light of the source, by the same share in the whole image."""


class FieldEffect(InstrumentEffect):
    """Varies over the image, so that every part of it has a W of its own."""


class CountsEffect(InstrumentEffect):
    """Undone in the counts; it does not change the rows of W."""

    belongs_to: ClassVar[Belongs] = "detector"

    def acts_on_counts(self, place: str) -> bool:
        return True


class PointwiseEffect(CountsEffect):
    """Undone in each pixel by itself; what `apply` adds is a series about the last point of `undo`."""

    def is_pointwise(self, place: str) -> bool:
        return True


class ResponseCurve(PointwiseEffect):
    """The curve from light to counts: a detector has one, whichever of these describes it."""


class ImageShift(CountsEffect):
    """Moves the image (`Changes.shift_px`); undone by moving the frames back."""

    def moves_image(self, place: str) -> bool:
        return True


class OfOneCapture(InstrumentEffect):
    """Would have other values in another capture of the same instrument."""

    belongs_to: ClassVar[Belongs] = "capture"


class Switch(OfOneCapture):
    """On or off: its parameter is not fitted."""


class FromAState(OfOneCapture):
    """An axis stands wrong from one state on; the state is part of the place."""

    @abstractmethod
    def axis(self, place: str) -> str:
        """The axis."""

    @abstractmethod
    def first_state(self, place: str) -> int:
        """The state from which on it acts."""


class GeneralEffect(InstrumentEffect):
    """General enough to describe, without a cause, what no other effect explains."""

    describes: ClassVar[str]


class ValuePerState(GeneralEffect, OfOneCapture):
    """Parameter k acts on state k alone (which also makes its derivative cheap)."""


class FromFileOnly(InstrumentEffect):
    """Holds where an instrument file names it, and is not looked for: an unknown sample would take it up."""


def turned_by(model: InstrumentModel, axis: str) -> Mapping[str, float]:
    """Ratio of each element that the axis turns."""
    return {e.name: e.ratio for e in model.elements() if e.axis == axis}


def moving_axes(model: InstrumentModel, conditions: Conditions) -> tuple[str, ...]:
    """Axes that turn an element and take at least three different angles."""
    return tuple(a for a in model.axes if np.unique(np.round(conditions.angles_deg[a], 3)).size >= 3)


def retarders(model: InstrumentModel, train: Literal["generator", "analyzer"]) -> tuple[str, ...]:
    """Names of the retarders of a train."""
    return tuple(e.name for e in getattr(model, train) if isinstance(e, Retarder))


def turns(model: InstrumentModel, conditions: Conditions, element: str) -> tuple[Array, ...]:
    """cos and sin of once, then of twice the angle through which the element turned, each (N,)."""
    found = next(e for e in model.elements() if e.name == element)
    t = np.deg2rad(found.ratio * conditions.angles_deg[found.axis or ""])
    return np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)
