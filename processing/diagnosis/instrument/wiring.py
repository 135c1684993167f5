"""Mistakes of wiring and of tables, tried before anything continuous: no small change of a value mends them.

Each is a model of its own with nothing to fit: an axis that turns the other way, two axes in each other's place, an
element a quarter turn off, angles told in other units, states that are one off, a mosaic that is turned.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.instrument.initial_values import best_of_starts
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.train import MUCH, Train, likeliest_train
from processing.diagnosis.search.causes import LEAST_DIFFERENCE
from processing.diagnosis.search.linearization import directions_of
from processing.diagnosis.search.rules import LIMIT, NEEDED, TAKES_PART
from processing.diagnosis.search.space import Space
from processing.effect import EffectError
from processing.instrument.model import InstrumentModel

#: [log odds] Against one mistake: one bench in twenty has one, and there are twenty.
MISTAKE = 6.0
#: [1, fixed] Ratios of two gears that are taken for one another in rotating-retarder polarimeters.
GEARS = {"5 instead of 4.91": 5 / 4.91, "4.91 instead of 5": 4.91 / 5}


@dataclass(frozen=True)
class Wiring:
    """One mistake: what it is, what to change in the instrument or states file, and the problem without it."""

    mistake: str
    change: str
    problem: InstrumentProblem

    @property
    def message(self) -> str:
        """A sentence."""
        return f"{self.mistake}: {self.change}"


@dataclass(frozen=True)
class Arrangement:
    """The likeliest way in which the train is put together.

    Attributes
    ----------
    message : what to change before anything else, and what it may be instead; None if that is nothing.
    others : mistakes, and other values of the train, that are not much less likely, in words.
    problem : the problem without the mistake; train : its likeliest values.
    """

    message: str | None
    others: tuple[str, ...]
    problem: InstrumentProblem
    train: Train | None

    @property
    def is_open(self) -> bool:
        """Whether the captures do not tell it from something else."""
        return bool(self.others)

    @property
    def branch(self) -> str | None:
        """What the captures do not tell from it, in a sentence, if it is no mistake."""
        others = "; or ".join(self.others) if self.message is None else ""
        return f"what fits as well, or nearly: {others}" if others else None


def likeliest_arrangement(problem: InstrumentProblem, declared: InstrumentModel | None = None) -> Arrangement:
    """The likeliest of no mistake and each one that takes most of the residual away, with values of the train.

    A plate that is far off does what a mistake does, and the reverse. So each mistake has its likeliest values.

    Parameters
    ----------
    declared : the instrument at all the wavelengths of its file.
    """
    if problem.nominal():
        return Arrangement(None, (), problem, None)
    # Parts of the states, each with a sample of its own, may have as many unknowns as intensities.
    whole = problem.undivided() if problem.holds_out_states else problem
    nothing, none = Space(()), np.zeros(0)
    start = _chi2(whole, nothing, none)
    mistakes = [w for w in _possible(whole, declared) if _chi2(w.problem, nothing, none) < start / MUCH]
    problems = [whole, *(w.problem for w in mistakes)]
    trains = [likeliest_train(each, pairs=each is whole) for each in problems]
    scores = np.array([train.score - MISTAKE * (k > 0) for k, train in enumerate(trains)])
    order = [int(k) for k in np.argsort(-scores, kind="stable")]
    best, *close = (k for k in order if scores[k] > scores.max() - LEAST_DIFFERENCE)
    texts = [f"no mistake, but far values: {trains[0].text}" if trains[0].text else "none of these mistakes"]
    texts += [w.message for w in mistakes]
    which = _one_of([texts[k] for k in (best, *close)], problem)
    others = (*(texts[k] for k in close), *(train.text or "no far value" for train in trains[best].rivals))
    weights = np.exp(scores[[best, *close]] - scores.max())
    is_mistake = best > 0 or 1 - weights[0] / weights.sum() > TAKES_PART
    arranged = problems[best]
    if problem.holds_out_states:
        arranged = InstrumentProblem(arranged.models, arranged.still, folds=problem.folds)
    return Arrangement(which if is_mistake else None, others, arranged, trains[best])


def _one_of(texts: Sequence[str], problem: InstrumentProblem) -> str:
    """What is certain, or what the captures do not tell apart."""
    look = "look which is right" if problem.has_known_sample else "look which is right, or take air as well"
    return texts[0] if len(texts) == 1 else f"one of these ({look}): {'; or '.join(texts)}"


def find_train_miswiring(
    problem: InstrumentProblem, declared: InstrumentModel | None = None
) -> tuple[str, InstrumentProblem] | None:
    """The mistake where the train has nominal values, none of which fit: each is judged by the best of them.

    Returns it in words, with those that fit as well, and the problem without it.
    """
    base = Space(problem.nominal())

    def chi2(tried: InstrumentProblem) -> float:
        whole = tried.undivided()
        return _chi2(whole, base, best_of_starts(whole, base).values)

    start, mistakes = chi2(problem), [(chi2(w.problem), w) for w in _possible(problem, declared)]
    found = [each for each in mistakes if each[0] < start / MUCH and start - each[0] > 2 * NEEDED]
    if not found:
        return None
    (least, best), *others = sorted(found, key=lambda each: each[0])
    close = 2 * LEAST_DIFFERENCE / directions_of(problem)
    texts = [best.message, *(w.message for left, w in others if np.log(left / least) < close)]
    return _one_of(texts, problem), best.problem


def _chi2(problem: InstrumentProblem, space: Space, values: Array) -> float:
    """Chi-square that is left; its own scatter is no reason to believe in a mistake."""
    sums = problem.sums(space, values, derivatives=False)
    excess, freedom = float(sums.excess.sum()), float(sums.freedom.sum())
    if not problem.noise_known:
        return excess + freedom
    return max(excess, 0.0) + LIMIT * float(np.sqrt(2 * max(freedom, 1.0) * problem.spread))


def _possible(problem: InstrumentProblem, declared: InstrumentModel | None) -> Iterator[Wiring]:
    """The mistakes after whose correction every effect of the instrument file still has a place in the train."""
    for mistake in (*_mistakes(problem), *_other_wavelengths(problem, declared)):
        try:
            for k in range(len(problem.captures)):
                mistake.problem.changes(k, Space(()), np.zeros(0))
        except EffectError:
            continue
        yield mistake


def _mistakes(problem: InstrumentProblem) -> Iterator[Wiring]:
    model = problem.model
    axes = model.axes
    for axis in axes:
        yield _scale_angles(problem, (axis,), -1.0, f"axis {axis!r} turns the other way")
    if len(axes) == 2:
        yield _scale_angles(problem, axes, -1.0, "both axes turn the other way")
        swap = dict(zip(axes, reversed(axes), strict=True))
        elements = {e.name: {"axis": swap[e.axis]} for e in model.elements() if e.axis in swap}
        change = f"in the instrument file give each element the other axis ({axes[0]} and {axes[1]})"
        yield Wiring("the two axes are in each other's place", change, _with_values(problem, elements))
    groups: list[tuple[str, ...]] = [*((a,) for a in axes), tuple(axes)]
    for group in dict.fromkeys(groups):
        names = " and ".join(repr(a) for a in group)
        yield _scale_angles(problem, group, 0.5, f"angles of {names} are told in half degrees")
        yield _scale_angles(problem, group, 2.0, f"angles of {names} are told in units of two degrees")
    for axis in axes:
        for name, factor in GEARS.items():
            yield _scale_angles(problem, (axis,), factor, f"axis {axis!r} was driven with a ratio of {name}")
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


def _other_wavelengths(problem: InstrumentProblem, declared: InstrumentModel | None) -> Iterator[Wiring]:
    """The light is of another wavelength than the captures say, of those that the instrument file has."""
    wavelengths = set(problem.wavelengths_nm)
    for wavelength in (declared.wavelengths_nm or ()) if declared is not None and len(wavelengths) == 1 else ():
        if wavelength not in wavelengths:
            at = declared.nominal_at(wavelength)  # type: ignore[union-attr]
            text = f"the light is of {wavelength:g} nm, not of {wavelengths.copy().pop():g}"
            change = f"in the capture (or the states file), wavelength_nm: {wavelength:g}"
            yield Wiring(text, change, _change(problem, lambda _, m=at: m))  # type: ignore[misc]


def _scale_angles(problem: InstrumentProblem, axes: tuple[str, ...], factor: float, text: str) -> Wiring:
    elements = {e.name: {"ratio": e.ratio * factor} for e in problem.model.elements() if e.axis in axes}
    lines = ", ".join(f"{name!r}: ratio: {update['ratio']:g}" for name, update in elements.items())
    return Wiring(text, f"in the instrument file, {lines}", _with_values(problem, elements))


def _turned_mosaics(problem: InstrumentProblem) -> Iterator[Wiring]:
    model = problem.model
    layout = np.array(model.mosaic)
    by_name = {c.name: c for c in model.channels}
    for turn, turned in (
        ("turned by 90 degrees", np.rot90(layout)),
        ("turned by 180 degrees", np.rot90(layout, 2)),
        ("turned by 270 degrees", np.rot90(layout, 3)),
        ("mirrored left and right", layout[:, ::-1]),
        ("mirrored up and down", layout[::-1]),
    ):
        now = {str(a): str(b) for a, b in zip(layout.reshape(-1), turned.reshape(-1), strict=True)}
        # The pixels that were read as channel a show what channel b shows.
        channels = tuple(by_name[now[c.name]].model_copy(update={"name": c.name}) for c in model.channels)
        new = _change(problem, lambda m, c=channels: m.model_copy(update={"channels": c}))  # type: ignore[misc]
        yield Wiring(f"the image is {turn}", f"in the instrument file, mosaic: {turned.tolist()}", new)


def _change(problem: InstrumentProblem, change: Callable[[InstrumentModel], InstrumentModel]) -> InstrumentProblem:
    return problem.with_models([change(m) for m in problem.models])


def _with_values(problem: InstrumentProblem, updates: Mapping[str, Mapping[str, Any]]) -> InstrumentProblem:
    return _change(problem, lambda model: model.with_values(updates))


def _with_states(problem: InstrumentProblem, move: Any) -> InstrumentProblem:
    def moved(data: CaptureData) -> CaptureData:
        angles: dict[str, Array] = {k: np.asarray(move(v)) for k, v in data.conditions.angles_deg.items()}
        return replace(data, conditions=replace(data.conditions, angles_deg=angles))

    rewired = copy.copy(problem)
    rewired.captures, rewired.still = tuple(map(moved, problem.captures)), tuple(map(moved, problem.still))
    rewired.forget_linearizations()
    return rewired
