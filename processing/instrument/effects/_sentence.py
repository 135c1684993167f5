"""A sentence of the grammar as an effect; the place is its text."""

from collections.abc import Sequence

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument import grammar
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import OpticsEffect
from processing.instrument.model import InstrumentModel


class SentenceEffect(OpticsEffect):
    """An effect that a sentence of the grammar describes, because the list has no name for it."""

    def places(self, model: InstrumentModel, conditions: Conditions) -> Sequence[str]:
        return tuple(s.text for s in grammar.sentences(model, conditions) if s.of_one_capture == self.of_one_capture)

    def parameters(self, model: InstrumentModel, conditions: Conditions, place: str) -> tuple[Parameter, ...]:
        return grammar.parse_sentence(place).parameters(conditions)

    def apply(self, changes: Changes, model: InstrumentModel, place: str, values: Array) -> None:
        grammar.parse_sentence(place).apply(changes, model, values)

    def moves_image(self, place: str) -> bool:
        return grammar.parse_sentence(place).quantities[0].startswith("shift")

    def reaches_around(self, place: str) -> bool:
        return self.moves_image(place) or grammar.parse_sentence(place).quantities == ("blur",)

    def acts_on_counts(self, place: str) -> bool:
        return grammar.parse_sentence(place).site == "image" or self.is_pointwise(place)

    def is_pointwise(self, place: str) -> bool:
        return grammar.parse_sentence(place).quantities == ("offset",)

    def undo(self, signal: Array, conditions: Conditions, place: str, values: Array) -> tuple[Array, Array]:
        offset = values @ grammar.course(grammar.parse_sentence(place).course, conditions)
        return signal - offset.reshape(-1, *(1,) * (signal.ndim - 1)), np.ones_like(signal)

    def log_price(self, model: InstrumentModel, conditions: Conditions, place: str) -> float:
        return grammar.parse_sentence(place).price(conditions)
