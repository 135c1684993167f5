"""Standard uncertainties that an instrument file states of its values, as independent directions of one each."""

from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from processing.arrays import Array
from processing.instrument.elements import number
from processing.instrument.model import InstrumentModel


class ValueDirection(NamedTuple):
    """One independent direction: values that move together by one standard uncertainty.

    Attributes
    ----------
    label : the value, or the values that are correlated.
    u : of the value, in its unit; NaN for several.
    moved : the model with it.
    """

    label: str
    u: float
    moved: InstrumentModel


def value_directions(model: InstrumentModel) -> Iterator[ValueDirection]:
    """Directions of a model at one wavelength; none where its file states no uncertainty.

    Correlated values move together. What `systematic` holds, because `diagnose` fitted it, is left out here.
    """
    fitted = model.calibrate if model.systematic else ()
    stated = {name: number(u) for name, u in model.stderr.items() if number(u) > 0 and name not in fitted}
    together = [[name for name in c.between if name in stated] for c in model.correlations]
    if model.measured is not None:
        for measured in model.measured.errors():
            yield ValueDirection("measured W", model.measured.u, model.model_copy(update={"measured": measured}))
    for name, u in stated.items():
        if not any(name in group for group in together):
            yield ValueDirection(name, u, _moved(model, {name: u}))
    for correlation, names in zip(model.correlations, together, strict=True):
        part = [correlation.between.index(name) for name in names]
        sigma = np.array([stated[name] for name in names])
        sizes, directions = np.linalg.eigh(sigma[:, None] * correlation.matrix[np.ix_(part, part)] * sigma)
        for size, direction in zip(sizes, directions.T, strict=True):
            if size > 0:
                shift = dict(zip(names, (np.sqrt(size) * direction).tolist(), strict=True))
                yield ValueDirection(" & ".join(names), np.nan, _moved(model, shift))


def align_inputs(inputs: Sequence[tuple[str, ...]], moves: Sequence[Array]) -> tuple[tuple[str, ...], list[Array]]:
    """Effect of the inputs of all instruments on each of several results; zero for the inputs of other instruments.

    Parameters
    ----------
    inputs : of each result; those of one name are one, see `InstrumentModel.identity`.
    moves : (D, ...) of each, by its own inputs.
    """
    if all(labels == inputs[0] for labels in inputs):
        return inputs[0], list(moves)
    every = tuple(dict.fromkeys(name for labels in inputs for name in labels))
    aligned = []
    for subset, moved in zip(inputs, moves, strict=True):
        aligned.append(np.zeros((len(every), *moved.shape[1:])))
        aligned[-1][[every.index(name) for name in subset]] = moved
    return every, aligned


def _moved(model: InstrumentModel, shifts: Mapping[str, float]) -> InstrumentModel:
    values: dict[str, dict[str, float]] = {}
    for name, shift in shifts.items():
        place, _, field = name.rpartition(".")
        values.setdefault(place, {})[field] = number(model.value_of(name) or 0.0) + shift
    return model.with_values(values)
