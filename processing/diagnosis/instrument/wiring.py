"""Mistakes of wiring and of tables, tried before anything continuous: no small change of a value mends them.

Each is a model of its own with nothing to fit: an axis that turns the other way, two axes in each other's place, an
element a quarter turn off, angles told in other units, states that are one off, a mosaic that is turned.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.rules import DECISIVE, WIRING
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel

#: Ratios of two gears that are taken for one another in rotating-retarder polarimeters.
GEARS = {"5 instead of 4.91": 5 / 4.91, "4.91 instead of 5": 4.91 / 5}


@dataclass(frozen=True)
class Wiring:
    """One mistake: what it is, what to change in the instrument or states file, and the problem without it."""

    what: str
    change: str
    problem: InstrumentProblem

    @property
    def told(self) -> str:
        """A sentence."""
        return f"{self.what}: {self.change}"


def miswired(problem: InstrumentProblem) -> Wiring | None:
    """The mistake without which far less is left over; None if there is none."""
    if problem.nominal():
        # Nominal values are far off by declaration.
        return None
    nothing = Space(())
    start = _left(problem, nothing)
    best, least = None, start / WIRING
    for wiring in _mistakes(problem):
        left = _left(wiring.problem, nothing)
        if left < least and start - left > DECISIVE:
            best, least = wiring, left
    return best


def _left(problem: InstrumentProblem, nothing: Space) -> float:
    """Chi-square that is left; its own scatter is no reason to believe in a mistake."""
    sums = problem.sums(nothing, np.zeros(0), derivatives=False)
    excess, freedom = float(sums.excess.sum()), float(sums.freedom.sum())
    if not problem.noise_known:
        return excess + freedom
    return max(excess, 0.0) + 4 * float(np.sqrt(2 * max(freedom, 1.0) * problem.spread))


def _mistakes(problem: InstrumentProblem) -> Iterator[Wiring]:
    model = problem.model
    axes = model.axes
    for group in ((a,) for a in axes):
        yield _scaled(problem, group, -1.0, f"axis {group[0]!r} turns the other way")
    if len(axes) == 2:
        yield _scaled(problem, axes, -1.0, "both axes turn the other way")
        swap = dict(zip(axes, reversed(axes), strict=True))
        elements = {e.name: {"axis": swap[e.axis]} for e in model.elements() if e.axis in swap}
        change = f"in the instrument file give each element the other axis ({axes[0]} and {axes[1]})"
        yield Wiring("the two axes are in each other's place", change, _with_values(problem, elements))
    for axis in axes:
        yield _scaled(problem, (axis,), 0.5, f"angles of {axis!r} are told in half degrees")
        yield _scaled(problem, (axis,), 2.0, f"angles of {axis!r} are told in units of two degrees")
        for name, factor in GEARS.items():
            yield _scaled(problem, (axis,), factor, f"axis {axis!r} was driven with a ratio of {name}")
    for element in model.elements():
        azimuth = float(element.azimuth_deg)  # type: ignore[arg-type]
        moved = _with_values(problem, {element.name: {"azimuth_deg": azimuth + 90.0}})
        change = f"in the instrument file, element {element.name!r}: azimuth_deg: {azimuth + 90:g}"
        yield Wiring(f"{element.name!r} is a quarter turn off (its axes confused)", change, moved)
    for step, where in ((1, "late"), (-1, "early")):
        change = "shift the angle columns of states.csv by one row"
        yield Wiring(f"the states are one {where}", change, _with_states(problem, lambda v, s=step: np.roll(v, s)))
    yield Wiring("the states are in reverse order", "turn states.csv over", _with_states(problem, lambda v: v[::-1]))
    if model.mosaic is not None:
        yield from _turned_mosaics(problem)


def _scaled(problem: InstrumentProblem, axes: tuple[str, ...], factor: float, what: str) -> Wiring:
    elements = {e.name: {"ratio": e.ratio * factor} for e in problem.model.elements() if e.axis in axes}
    lines = ", ".join(f"{name!r}: ratio: {update['ratio']:g}" for name, update in elements.items())
    return Wiring(what, f"in the instrument file, {lines}", _with_values(problem, elements))


def _turned_mosaics(problem: InstrumentProblem) -> Iterator[Wiring]:
    model = problem.model
    layout = np.array(model.mosaic)
    by_name = {c.name: c for c in model.channels}
    for what, turned in (
        ("turned by 90 degrees", np.rot90(layout)),
        ("turned by 180 degrees", np.rot90(layout, 2)),
        ("turned by 270 degrees", np.rot90(layout, 3)),
        ("mirrored left and right", layout[:, ::-1]),
        ("mirrored up and down", layout[::-1]),
    ):
        now = {str(a): str(b) for a, b in zip(layout.reshape(-1), turned.reshape(-1), strict=True)}
        # The pixels that were read as channel a show what channel b shows.
        channels = tuple(by_name[now[c.name]].model_copy(update={"name": c.name}) for c in model.channels)
        new = _changed(problem, lambda m, c=channels: m.model_copy(update={"channels": c}))  # type: ignore[misc]
        yield Wiring(f"the image is {what}", f"in the instrument file, mosaic: {turned.tolist()}", new)


def _changed(problem: InstrumentProblem, change: Callable[[InstrumentModel], InstrumentModel]) -> InstrumentProblem:
    out = copy.copy(problem)
    out.models = tuple(change(m) for m in problem.models)
    out.model = out.models[0]
    out.forget_linearizations()
    return out


def _with_values(problem: InstrumentProblem, updates: Mapping[str, Mapping[str, Any]]) -> InstrumentProblem:
    return _changed(problem, lambda model: model.with_values(updates))


def _with_states(problem: InstrumentProblem, move: Any) -> InstrumentProblem:
    def moved(data: CaptureData) -> CaptureData:
        angles: dict[str, Array] = {k: np.asarray(move(v)) for k, v in data.conditions.angles_deg.items()}
        return replace(data, conditions=replace(data.conditions, angles_deg=angles))

    out = copy.copy(problem)
    out.captures, out.still = tuple(map(moved, problem.captures)), tuple(map(moved, problem.still))
    out.forget_linearizations()
    return out
