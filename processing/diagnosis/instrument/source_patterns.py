"""A source that beats or jumps: no effect of the list, but its values over the states follow one wave, or one jump."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.linalg import block_diag
from scipy.special import betaincc

from processing.arrays import Array
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import Cause
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.range_of import range_of
from processing.diagnosis.search.rules import ONE_WAVE, SURE
from processing.instrument.effects.base import SourceEffect, ValuePerState

#: [frequencies] Of a wave over n states, for each state.
FREQUENCIES = 8
#: [frequencies] Between two of them, where a wave is looked at closely.
CLOSELY = 9
#: [values, fixed] Of the largest pattern, beside a drift: a wave, or a jump and a bend.
VALUES = 2
#: [of the largest] Singular values of a pattern beside a drift below which it is a drift itself.
BESIDE_DRIFT = 1e-6


def waves(cycles: Array, n: int) -> Array:
    """Cosine and sine over n states of each frequency (F,) in cycles a state, (F, n, 2)."""
    turns = 2 * np.pi * np.outer(cycles, np.arange(n))
    return np.stack([np.cos(turns), np.sin(turns)], axis=2)


def jumps(n: int) -> Iterator[Array]:
    """A jump beside the bend of a drift, (n, 2), at every state."""
    k = np.arange(n)
    bend = (k / n) ** 2
    for first in range(2, n - 1):
        yield np.column_stack([(k >= first) - 1 + first / n, bend - bend.mean()])


def beat_explains_as_well(problem: InstrumentProblem, found: Posterior, cause: Cause) -> bool:
    """Whether in a cause's place a source that follows one wave, in each of its captures, fits better or as well.

    What a turning plate passes is a wave over the states too, of once or twice a turn; a beat has a frequency of its
    own. Where no such turn explains what the wave does, a wave that fits as well is enough: no name is sure beside it.
    Values for each state that take part are asked themselves (`patterned`).
    """
    sets, best = found.sets, found.samples.best
    labels = [found.label(g) for g in range(len(found.members))]
    source = [
        g for g, c in enumerate(labels) if isinstance(c.effect, SourceEffect) and isinstance(c.effect, ValuePerState)
    ]
    if not source or np.any(best.tau[source] > 0):
        return False
    own = labels.index(cause.candidates[0])
    given = sets.given_others(sets.without(best, own))
    beats, turns, cost = 0.0, 0.0, 0.0
    for g in source:
        curvature, gradient = given[g]
        beating, turning, last = [], [], 0
        for m in found.members[g]:
            candidate = found.space.candidates[m]
            part = slice(last, last := last + candidate.size)
            asked = curvature[part, part], gradient[part]
            beating.append(_best(*asked))
            held = partial(_held, curvature=asked[0], gradient=asked[1])
            turning.append(max(_turns(problem, candidate), key=held, default=np.zeros((candidate.size, 2))))
            cost += 2 * ONE_WAVE
        # All captures at once: what they share beside the waves must not be counted for each of them.
        beats += _held(block_diag(*beating), curvature, gradient)
        turns += _held(block_diag(*turning), curvature, gradient)
    odds = 2 * np.log(SURE / (1 - SURE)) if beats - turns > cost else 0.0
    return bool(beats - cost > _explained(*given[own]) - odds)


def _turns(problem: InstrumentProblem, candidate: Candidate) -> Iterator[Array]:
    """Cosine and sine (n, 2) of once and twice the turn of every element, over the states of a candidate's capture."""
    capture = problem.captures[candidate.capture or 0]
    for element in problem.model.elements():
        if element.axis is not None:
            angles = np.deg2rad(element.ratio * capture.conditions.angles_deg[element.axis])
            for periods in (1, 2):
                yield np.stack([np.cos(periods * angles), np.sin(periods * angles)], axis=1)


def _held(wave: Array, curvature: Array, gradient: Array) -> float:
    """Chi-square that values along a wave (N, 2), or one in each capture (N, 2 captures), explain."""
    return _explained(wave.T @ curvature @ wave, wave.T @ gradient)


def _best(curvature: Array, gradient: Array) -> Array:
    """The wave (N, 2) that explains most of values with a curvature (N, N) and a gradient (N,)."""
    held = partial(_held, curvature=curvature, gradient=gradient)
    cycles, step = _cycles(gradient.size)
    near = cycles[int(np.argmax([held(wave) for wave in waves(cycles, gradient.size)]))]
    closely = near + step * np.linspace(-1, 1, 2 * CLOSELY + 1)
    return max(waves(closely, gradient.size), key=held)


def _cycles(n: int) -> tuple[Array, float]:
    """Frequencies in cycles a state, and the step between two of them."""
    return np.linspace(0.5 / n, 0.5, FREQUENCIES * n, retstep=True)


def _explained(curvature: Array, gradient: Array) -> float:
    """Chi-square that values explain where nothing draws them to zero."""
    return float(gradient @ np.linalg.pinv(curvature, hermitian=True) @ gradient)


@dataclass(frozen=True)
class Patterned:
    """Chi-square that values explain, as far as one pattern holds it, beyond noise, and what noise alone explains.

    `directions` is in how many random values would have it alike; `tried` how many patterns there are.
    """

    held: float
    beyond_noise: float
    noise: float
    directions: float
    tried: int


def chance_of_pattern(seen: Sequence[Patterned]) -> float:
    """Greatest chance that one pattern in each capture holds as much of random values (patterns resemble each other).

    The share that `VALUES` of D directions hold is distributed as a beta variable. A capture counts by what it tells.
    """
    beyond = np.array([max(one.beyond_noise, 0.0) for one in seen])
    weight = beyond / beyond.sum()
    captures = 1 / float(weight @ weight)
    rest = captures * float(weight @ [max(one.directions - VALUES, 1.0) for one in seen])
    share = min(sum(one.held for one in seen) / float(beyond.sum()), 1.0)
    tried: float = float(weight @ [one.tried for one in seen]) ** captures
    return min(1.0, tried * float(betaincc(VALUES * captures / 2, rest / 2, share)))


def patterned(values: Array, information: Array, covariance: Array) -> Patterned:
    """What of values (N,) one sine over the states explains too, or a jump and a bend, beside an even drift.

    `information` (N, N) is the curvature of the chi-square: patterns that the unknown sample takes up do not count.
    `covariance` (N, N) is that of the values, which shrink to their prior, and their noise with them.
    """
    n = values.size
    power, vector = np.linalg.eigh(information)
    root = (vector * np.sqrt(np.maximum(power, 0.0))).T
    # All about their means: gains that all grow by one factor are taken up by the throughput, so that one constant for
    # all is seen as these values themselves, with the other sign, and would be a pattern of any values. An even drift
    # is in the list: values that are there anyway take it up, and it is no pattern of theirs.
    drift = root @ (np.arange(n) / n - (n - 1) / (2 * n))
    drift /= max(float(np.linalg.norm(drift)), 1e-300)
    seen = root @ (values - values.mean())
    seen -= drift * (drift @ seen)
    kept = np.clip(np.linalg.eigvalsh(root @ covariance @ root.T), 0.0, 1.0)
    noise = float(kept @ kept)
    held = 0.0
    for pattern in (*waves(_cycles(n)[0], n), *jumps(n)):
        beside = root @ pattern
        beside -= np.outer(drift, drift @ beside)
        along = range_of(beside, BESIDE_DRIFT).T @ seen
        held = max(held, float(along @ along))
    # One direction is that of the mean, one that of the drift.
    directions = float(power.clip(0).sum() ** 2 / np.sum(power.clip(0) ** 2)) - 2
    return Patterned(held, float(seen @ seen) - noise, noise, directions, n)
