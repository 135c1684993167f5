"""The likeliest values of a train of which few may be far off: azimuths and retardances by tens of degrees.

Each value has a Cauchy prior, which few far values cost less than many small ones. The minimum is found by
least squares with the weights of the last step (Holland and Welsch, Commun. Stat. A 6, 813, 1977).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from processing.arrays import Array, BoolArray
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.causes import LEAST_DIFFERENCE
from processing.diagnosis.search.fit import minimize
from processing.diagnosis.search.linearization import directions_of
from processing.diagnosis.search.range_of import NEARLY_ZERO
from processing.diagnosis.search.rules import BENT, FAR, FAR_OFF, LIMIT, ROUNDS
from processing.diagnosis.search.space import Space

#: [degree] Between the angles at which a fit may start, for each of those that are far at once.
APART_DEG = 7.5
#: [1] Factor by which far values, or a mistake of wiring, have to reduce the residual.
MUCH = 5.0
#: [starts] With one angle far off, and again with two.
STARTS = 6


@dataclass(frozen=True)
class Train:
    """Values (K,) of a train, the log of their probability, and the unit of chi-square there.

    `rivals` : other values that are not much less likely.
    """

    space: Space
    values: Array
    score: float
    unit: float
    rivals: tuple[Train, ...] = ()

    @property
    def far(self) -> Mapping[Candidate, Array]:
        """All values, if one is beyond the plausible; else none."""
        return self.space.split(self.values) if self._is_far.any() else {}

    @property
    def is_settled(self) -> bool:
        """Whether no other values need to be looked for."""
        return self.unit <= BENT and not self._is_far.any()

    @property
    def far_values(self) -> Array:
        """The far values (K,), all others zero."""
        return np.where(self._is_far, self.values, 0.0)

    @property
    def without_each(self) -> list[Array]:
        """The values (K,) without each far one: two may do what one of them does."""
        return [np.where(np.arange(self.values.size) == k, 0.0, self.values) for k in np.flatnonzero(self._is_far)]

    @property
    def text(self) -> str:
        """The far values in words."""
        pairs = [(c, i) for c, part in self.space.pairs for i in range(part.start, part.stop) if self._is_far[i]]
        return ", ".join(f"{c.short} {self.values[i]:.3g} {c.parameters[0].unit}" for c, i in pairs)

    @property
    def _is_far(self) -> BoolArray:
        return np.asarray(np.abs(self.values) > FAR * self.space.joined("typical"))


def likeliest_train(problem: InstrumentProblem, *, pairs: bool = True) -> Train:
    """The likeliest values of all that the effects of the train shift, from the declared ones and from far ones.

    With `pairs` two angles may be far where neither explains much alone.
    """
    space = Space(tuple(c for c in problem.pool() if c.shifts(problem.model)))
    directions, start = directions_of(problem), np.zeros(space.size)
    declared, free = _train_at(problem, space, start, directions), minimize(problem, space, start, expansions=0)
    trials = [declared, *(_reweighted(problem, space, x, directions) for x in (start, free.values))]
    best = max(trials, key=lambda train: train.score)
    for at_once, is_second in ((1, False), (1, True), (2, False)):
        if best.is_settled or (at_once == 2 and (not pairs or best.unit < declared.unit / MUCH or free.rms < FAR_OFF)):
            break
        starts = _far_starts(problem, space, best.far_values if is_second else start, at_once)
        trials += [_reweighted(problem, space, x, directions) for x in (*starts, *best.without_each)]
        best = max(trials, key=lambda train: train.score)
    # Far values take up some of any structure.
    trials = [train for train in trials if not train.far or train.unit < declared.unit / MUCH]
    best = max(trials, key=lambda train: train.score)
    close = [train for train in trials if train.score > best.score - LEAST_DIFFERENCE]
    chosen = [best]
    for train in sorted(close, key=lambda train: -train.score):
        between = (_train_at(problem, space, (train.values + t.values) / 2, directions) for t in chosen)
        # Values on one line that all fit are one solution: the posterior has the whole line.
        if all(0.5 * directions * np.log(middle.unit / best.unit) > LEAST_DIFFERENCE for middle in between):
            chosen.append(train)
    return replace(best, rivals=tuple(chosen[1:]))


def _far_starts(problem: InstrumentProblem, space: Space, values: Array, at_once: int) -> Iterator[Array]:
    """Values (K,) with one angle changed or two, the two best of each choice, those that explain most first."""
    lower, upper, chosen = space.joined("lower"), space.joined("upper"), []
    single = [part.start for c, part in space.pairs if c.size == 1 and c.parameters[0].unit == "degree"]
    for angles in map(list, combinations(single, at_once)):
        steps = [np.arange(lower[k], upper[k] + 1, APART_DEG * at_once) for k in angles]
        trials = np.repeat(values[None], np.prod([len(each) for each in steps]), axis=0)
        trials[:, angles] = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, at_once)
        chi2 = [problem.sums(space, x, derivatives=False).chi2(problem.noise_known) for x in trials]
        chosen += [(chi2[i], trials[i]) for i in np.argsort(chi2)[:2]]
    yield from (x for _, x in sorted(chosen, key=lambda trial: trial[0])[:STARTS])


def _reweighted(problem: InstrumentProblem, space: Space, values: Array, directions: float) -> Train:
    """The likeliest values (K,) near some, the best of the steps."""
    typical = space.joined("typical")
    train = _train_at(problem, space, values, directions)
    best = train
    for _ in range(ROUNDS):
        weak = 2 * train.unit / (typical**2 + train.values**2)
        fit = minimize(problem, space, train.values, weak=weak, expansions=0)
        train = _train_at(problem, space, fit.values, directions)
        best = max(best, train, key=lambda each: each.score)
    return best


def _train_at(problem: InstrumentProblem, space: Space, values: Array, directions: float) -> Train:
    sums = problem.sums(space, values, derivatives=False)
    unit = max(sums.chi2(problem.noise_known) / directions, NEARLY_ZERO)
    if problem.noise_known:
        # Two trains leave different parts of the noise over, which is no reason to prefer one.
        scatter = LIMIT * float(np.sqrt(2 * max(float(sums.freedom.sum()), 1.0) * problem.spread))
        unit = 1 + max(unit - scatter / directions, 0.0)
    cost = float(np.log1p((values / space.joined("typical")) ** 2).sum())
    return Train(space, values, -0.5 * directions * float(np.log(unit)) - cost, unit)
