"""The likeliest values of a train of which few may be far off: azimuths and retardances by tens of degrees.

Each value has a Cauchy prior of its typical size. One far value costs less there than many small ones. The maximum is
found by least squares, whose weights come from the last step (Holland and Welsch, Commun. Stat. A 6, 813, 1977).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
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
from processing.diagnosis.search.rules import BENT, FAR_OFF, LIMIT, LITTLE, ROUNDS
from processing.diagnosis.search.space import Space

#: [degree] Between the angles at which a fit may start, for each of those that are far at once.
APART_DEG = 7.5
#: [1] Factor by which far values, or a mistake of wiring, have to reduce the residual.
MUCH = 5.0
#: [starts] With one angle far off, and again with two.
STARTS = 6


@dataclass(frozen=True)
class Train:
    """Values of a train.

    Attributes
    ----------
    values : (K,) of `space`, in the units of its parameters.
    score : log of their probability, a constant left out; unit : of chi-square there.
    rivals : other values that are not much less likely, and do not lie on a line of solutions with these.
    """

    space: Space
    values: Array
    score: float
    unit: float
    rivals: tuple[Train, ...] = ()

    @property
    def is_far(self) -> BoolArray:
        """Whether values (K,) are beyond the plausible."""
        return self.space.is_far(self.values)

    @property
    def far(self) -> Mapping[Candidate, Array]:
        """All values by candidate, if one is beyond the plausible; else none."""
        return self.space.split(self.values) if self.is_far.any() else {}

    @property
    def text(self) -> str:
        """The far values in words."""
        pairs = [(c, i) for c, part in self.space.pairs for i in range(part.start, part.stop) if self.is_far[i]]
        return ", ".join(f"{c.short} {self.values[i]:.3g} {c.parameters[0].unit}" for c, i in pairs)


def likeliest_train(problem: InstrumentProblem, *, pairs: bool = True) -> Train:
    """The likeliest values of all that the effects of the train shift, from the declared ones and from far ones.

    With `pairs` two angles may be far where neither explains much alone.
    """
    fits = _Fits(problem)
    declared, trials = fits.at(np.zeros(fits.space.size)), fits.trials(pairs)
    # Far values take up some of any structure.
    believed = [declared, *(t for t in trials if not t.is_far.any() or t.unit < declared.unit / MUCH)]
    best, *others = sorted(believed, key=lambda train: -train.score)
    return replace(best, rivals=fits.separate(best, others))


class _Fits:
    """Fits of the values of a train to one problem."""

    def __init__(self, problem: InstrumentProblem) -> None:
        self.problem = problem
        self.space = Space(tuple(c for c in problem.pool() if c.shifts(problem.model)))
        self._typical = self.space.joined("typical")
        self._directions = directions_of(problem)

    def trials(self, pairs: bool) -> list[Train]:
        """Trains from the declared values, from one far angle, from a second one next to it, and from two at once."""
        zero = np.zeros(self.space.size)
        free = minimize(self.problem, self.space, zero, expansions=0)
        trials = self.reweighted([zero, free.values])
        about, best = zero, _best(trials)
        for _ in range(2):
            if best.unit <= BENT and not best.is_far.any():
                return trials
            trials += self.reweighted([*self._far_starts(about, 1), *_without_each(best)])
            best = _best(trials)
            about = np.where(best.is_far, best.values, 0.0)
        if pairs and free.rms > FAR_OFF and best.unit > self.at(zero).unit / MUCH:
            trials += self.reweighted(self._far_starts(zero, 2))
        return trials

    def separate(self, best: Train, others: Sequence[Train]) -> tuple[Train, ...]:
        """Those of the others (the likeliest first) that are not much less likely, and no solution of the same line."""
        chosen = [best]
        for train in (t for t in others if t.score > best.score - LEAST_DIFFERENCE):
            between = [self.at((train.values + t.values) / 2) for t in chosen]
            # If the values in between fit as well, the posterior has the whole line.
            if all(0.5 * self._directions * np.log(m.unit / best.unit) > LEAST_DIFFERENCE for m in between):
                chosen.append(train)
        return tuple(chosen[1:])

    def at(self, values: Array) -> Train:
        """The train of these values (K,)."""
        sums = self.problem.sums(self.space, values, derivatives=False)
        unit = max(sums.chi2(self.problem.noise_known) / self._directions, NEARLY_ZERO)
        if self.problem.noise_known:
            # Two trains leave different parts of the noise over, which is no reason to prefer one.
            scatter = LIMIT * float(np.sqrt(2 * max(float(sums.freedom.sum()), 1.0) * self.problem.spread))
            unit = 1 + max(unit - scatter / self._directions, 0.0)
        cost = float(np.log1p((values / self._typical) ** 2).sum())
        return Train(self.space, values, -0.5 * self._directions * float(np.log(unit)) - cost, unit)

    def reweighted(self, starts: Iterable[Array]) -> list[Train]:
        """The likeliest train near each start (K,), of all steps from it.

        Where a path comes to a place that was reached before, it goes on as the one that reached it did.
        """
        paths, places = [[self.at(start)] for start in starts], list[Array]()
        open_paths = paths
        for _ in range(ROUNDS):
            trains = [self._step(path[-1]) for path in open_paths]
            ahead = []
            for path, train in zip(open_paths, trains, strict=True):
                path.append(train)
                if not any(np.all(np.abs(train.values - x) < LITTLE * self._typical) for x in places):
                    ahead.append(path)
                places.append(train.values)
            open_paths = ahead
        return [_best(path) for path in paths]

    def _step(self, train: Train) -> Train:
        """The train one step of reweighted least squares further."""
        weak = 2 * train.unit / (self._typical**2 + train.values**2)
        fit = minimize(self.problem, self.space, train.values, weak=weak, unit=train.unit, expansions=0)
        return self.at(fit.values)

    def _far_starts(self, values: Array, at_once: int) -> list[Array]:
        """Values (K,) with one angle changed or two, the two best of each choice, those that explain most first."""
        lower, upper, chosen = self.space.joined("lower"), self.space.joined("upper"), []
        single = [part.start for c, part in self.space.pairs if c.size == 1 and c.parameters[0].unit == "degree"]
        for angles in map(list, combinations(single, at_once)):
            steps = [np.arange(lower[k], upper[k] + 1, APART_DEG * at_once) for k in angles]
            trials = np.repeat(values[None], np.prod([len(each) for each in steps]), axis=0)
            trials[:, angles] = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, at_once)
            chi2 = [self._chi2(x) for x in trials]
            chosen += [(chi2[i], trials[i]) for i in np.argsort(chi2)[:2]]
        return [x for _, x in sorted(chosen, key=lambda trial: trial[0])[:STARTS]]

    def _chi2(self, values: Array) -> float:
        return self.problem.sums(self.space, values, derivatives=False).chi2(self.problem.noise_known)


def _best(trains: Sequence[Train]) -> Train:
    return max(trains, key=lambda train: train.score)


def _without_each(train: Train) -> list[Array]:
    """The values (K,) without each far one in turn: two may do what one of them does."""
    return [np.where(np.arange(train.values.size) == k, 0.0, train.values) for k in np.flatnonzero(train.is_far)]
