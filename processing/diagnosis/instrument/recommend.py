"""Which further capture would tell apart what these captures cannot."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.slopes import step_values
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.range_of import least_apart
from processing.diagnosis.search.rules import APART, LEAST_NOISE, STEP
from processing.diagnosis.search.space import Space
from processing.polarization import mueller

#: Samples that a lab has at hand, in the order of the trouble they make.
SAMPLES: dict[str, NDArray[np.float64]] = {
    "air (Omega = 180 degrees, nothing at the centre)": np.eye(4),
    "a linear polarizer at 0 degrees in the sample's place": mueller.polarizer(0.0),
    "a linear polarizer at 45 degrees in the sample's place": mueller.polarizer(np.pi / 4),
    "a mirror": mueller.IDEAL_MIRROR,
    "a depolarizing white target (integrating sphere)": mueller.IDEAL_DEPOLARIZER,
}

#: Matrix W (L, 16) of a capture in which a candidate acts, and its changes (parameters, L, 16) for typical sizes.
Slopes = Callable[[Candidate], tuple[Array, Array]]


def recommended(
    problem: InstrumentProblem,
    space: Space,
    fit: Fit,
    sets: Sequence[Sequence[Candidate]],
    *,
    unseen: Sequence[Candidate],
) -> str:
    """Next capture: one that separates each indistinguishable set, else one that shows the unseen effects."""
    unseen = [c for c in unseen if not (c.acts_on_counts or c.effect.varies_over_image)]
    slopes = cache(partial(_slopes, problem, space, fit))
    return " ".join(dict.fromkeys(_capture(problem, slopes, rivals, unseen=unseen) for rivals in sets or ((),)))


def _capture(
    problem: InstrumentProblem, slopes: Slopes, rivals: Sequence[Candidate], *, unseen: Sequence[Candidate]
) -> str:
    """One sentence: the capture that separates the rivals, or shows the unseen, or that none of the usual does."""
    rows_side = [c for c in rivals if not c.acts_on_counts]
    best, power = _best_sample(problem, slopes, rows_side, unseen=unseen)
    listed = [c for c in rows_side if not c.price]
    if power < APART and 1 < len(listed) < len(rows_side):
        # A sentence can be an exact double of an effect; what separates the effects still helps.
        best, power = _best_sample(problem, slopes, listed, unseen=unseen)
    if any(c.acts_on_counts for c in rivals):
        return (
            "A series of exposure times on an unpolarized, evenly lit target tells detector effects from optics; "
            "dark frames tell an offset."
        )
    if best and power >= APART:
        return f"Capture {best} with the same states."
    if any(c.effect.per_state for c in rivals):
        return "Repeat the capture: what comes back is the mechanics, what does not is the source; or record a monitor."
    if rivals:
        return (
            "No usual sample separates them with these states; another state table, or a second detector channel, may."
        )
    return "None needed." if not unseen else f"Capture {best or next(iter(SAMPLES))} to see what is unobservable here."


def _best_sample(
    problem: InstrumentProblem, slopes: Slopes, rivals: Sequence[Candidate], *, unseen: Sequence[Candidate]
) -> tuple[str, float]:
    """The sample not captured yet that tells the most, and how much."""
    have = [c.sample for c in problem.captures]
    best, power = "", 0.0
    for name, sample in SAMPLES.items():
        if any(h is not None and np.allclose(h / np.abs(h).max(), sample.reshape(16) / sample.max()) for h in have):
            continue
        value = _power(slopes, sample.reshape(16), rivals=rivals, unseen=unseen)
        # A simpler sample is preferred unless another one tells clearly more.
        if value > power + APART / 2:
            best, power = name, value
    return best, power


def _power(slopes: Slopes, sample: Array, *, rivals: Sequence[Candidate], unseen: Sequence[Candidate]) -> float:
    signatures = [_signature(*slopes(c), sample) for c in rivals or unseen]
    is_visible = [bool(np.linalg.norm(each) >= LEAST_NOISE) for each in signatures]
    if not rivals:
        return float(np.mean(is_visible)) if is_visible else 0.0
    return least_apart(signatures) if all(is_visible) or len(rivals) == 1 else 0.0


def _signature(w: Array, dw: Array, sample: Array) -> Array:
    """Change (L, parameters) of the relative signal of a sample, the throughput projected out."""
    signal, changes = w @ sample, (dw @ sample).T
    square = signal @ signal
    if square == 0:
        return np.zeros_like(changes)
    return np.asarray((changes - np.outer(signal, signal @ changes) / square) / np.sqrt(square))


def _slopes(problem: InstrumentProblem, space: Space, fit: Fit, candidate: Candidate) -> tuple[Array, Array]:
    """W and its changes by a candidate at the values of a fit; see `Slopes`."""
    capture = next(k for k, w in enumerate(problem.wavelengths_nm) if candidate.acts(k, w))
    joint = Space((*space.candidates, candidate)) if candidate not in space.candidates else space
    values = np.concatenate([fit.values, np.zeros(joint.size - space.size)])
    part = joint.slices[joint.candidates.index(candidate)]

    def matrix(at: Array) -> Array:
        return problem.captures[capture].matrix_of(problem.models[capture], problem.changes(capture, joint, at))

    w = matrix(values)
    return w, np.array([matrix(moved) - w for moved, _ in step_values(candidate, part, values)]) / STEP
