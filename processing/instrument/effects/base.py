"""Effects of an instrument, and families that declare what several of them have in common (see `Effect`)."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import numpy as np

from processing.arrays import Array
from processing.effect import Effect, Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import Belongs, InstrumentModel, Retarder
from processing.instrument.nominal import shift_nominal


class InstrumentEffect(Effect, ABC):
    """One thing that an instrument model can lack.

    `belongs_to` says which captures share its values; an instrument file may declare another (`belongs_to` there).
    """

    belongs_to: ClassVar[Belongs] = "wavelength"
    #: Its parameters where they are the same in every instrument and at every place.
    fixed_parameters: ClassVar[tuple[Parameter, ...]] = ()
    #: What of the product stands as it was at one moment of the capture, and which; None: nothing depends on time.
    reference: ClassVar[str | None] = None

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        """Places of the effect: element, axis or channel names; ("",) for the whole; () for nowhere."""
        return ("",)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        """The parameters at a place."""
        return self.fixed_parameters

    @abstractmethod
    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        """Add the effect of `values`, one for each parameter, to the changes."""

    def log_price(self, model: InstrumentModel, conditions: Conditions, place: str) -> float:
        """Log odds by which it is rarer at this place than an effect of the list."""
        return 0.0

    def undo(self, signal: Array, conditions: Conditions, place: str, values: Array) -> tuple[Array, Array]:
        """Signal (N, channels, ...), counts over full scale, without a pointwise effect, exactly, and its slope."""
        raise NotImplementedError(f"{self.kind} at {place!r} is not pointwise")

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        """Values of the train ("element.field") that it shifts and does nothing else."""
        return ()


class OpticsEffect(InstrumentEffect):
    """Changes the polarization elements or the detector channels; a known surface shows it too."""

    of_optics = True


class NominalShift(OpticsEffect):
    """Adds its value to one field of elements (`processing.instrument.nominal.FIELDS`), and does nothing else."""

    field: ClassVar[str]

    def elements(self, model: InstrumentModel, place: str) -> Sequence[str]:
        """Names of the elements whose field it shifts."""
        return (place,)

    def shifts(self, model: InstrumentModel, place: str) -> tuple[str, ...]:
        return tuple(f"{name}.{self.field}" for name in self.elements(model, place))

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        for name in self.shifts(model, place):
            shift_nominal(changes, model, name, values[0])


class SourceEffect(InstrumentEffect):
    """Changes the light of the source, by the same share in the whole image."""

    of_source = True
    is_level = True


class CountsEffect(InstrumentEffect):
    """Undone in the counts; it does not change the rows of W."""

    belongs_to: ClassVar[Belongs] = "detector"

    def acts_on_counts(self, place: str) -> bool:
        return True


class PointwiseEffect(CountsEffect):
    """Undone in each pixel by itself; what `apply` adds is a series about the last point of `undo`."""

    def is_pointwise(self, place: str) -> bool:
        return True


class ImageShift(CountsEffect):
    """Moves the image (`Changes.shift_px`); undone by moving the frames back."""

    def moves_image(self, place: str) -> bool:
        return True


class OfOneCapture(InstrumentEffect):
    """Would have other values in another capture of the same instrument."""

    belongs_to: ClassVar[Belongs] = "capture"
    of_one_capture = True


class OfTurningAxis(InstrumentEffect):
    """Acts on an axis that turns an element."""

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return moving_axes(model, conditions)


class ValuePerState(OfOneCapture):
    """Parameter k acts on state k alone."""

    per_state = True


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
    part = next(e for e in model.elements() if e.name == element)
    t = np.deg2rad(part.ratio * conditions.angles_deg[part.axis or ""])
    return np.cos(t), np.sin(t), np.cos(2 * t), np.sin(2 * t)
