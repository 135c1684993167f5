"""The posterior of all effects at once: linearize, find which groups are there, improve the solution, again.

Every effect at every place takes part from the beginning, so no order of adding matters. Values of one kind in several
captures are one group; a slip is one of as many alternatives as there are states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.descent import STEPS, all_at_once, improved, mean_over_sets, next_values
from processing.diagnosis.search.down_to_noise import down_to_noise
from processing.diagnosis.search.likely_set import climb, likely_set
from processing.diagnosis.search.linearized import grouped, noise_of, quadratic
from processing.diagnosis.search.problem import Problem
from processing.diagnosis.search.rules import BENT, CHANGES, GROWTH, ROUNDS, SAMPLES, TAU
from processing.diagnosis.search.sampling import Samples, sample
from processing.diagnosis.search.sets import Group, Sets, State
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stays import stay

#: Called with a line that says what is being done.
Say = Callable[[str], None]

#: Rounds where the noise is not known: every one makes what is left smaller, which is then taken for the noise.
FEWER_ROUNDS = 4


@dataclass(frozen=True)
class Posterior:
    """Posterior of the parameters of all candidates.

    Attributes
    ----------
    space : all candidates; members : numbers of the candidates of each group.
    sets, samples : the last linearization, and the sets that were visited in it.
    values : (K,) mean; covariance : (K, K), both in the units of the parameters.
    """

    space: Space
    members: tuple[tuple[int, ...], ...]
    sets: Sets
    samples: Samples
    values: Array
    covariance: Array

    @property
    def score(self) -> float:
        """Log probability of the likeliest set, a constant left out."""
        return self.sets.fitted(self.samples.best).score

    def label(self, group: int) -> Candidate:
        """A candidate that stands for a group."""
        return self.space.candidates[self.members[group][0]]


def posterior(problem: Problem, space: Space, fixed: Sequence[Candidate], start: Array, say: Say) -> Posterior:
    """The posterior of all values of a space.

    Parameters
    ----------
    fixed : candidates that are always there (nominal values of the train, switches that are on).
    start : (K,) values to begin with.
    """
    members, groups = grouped(space, fixed)
    about, sets, state = _found(problem, space, fixed, groups, start)
    if problem.noise_known and state.unit > BENT:
        say("structure is left: once more, with every intensity counted in full")
        explained = down_to_noise(problem, space, fixed, groups, start, sets.noise, state.unit)
        if explained is None:
            problem.relinearize(space, about)
        else:
            about, sets, state = explained
    samples = _averaged(sets, state)
    there = [space.candidates[members[g][0]].label for g in np.flatnonzero((samples.probability > 0.5) & sets.free)]
    say(f"likely: {', '.join(there) or 'nothing'}; unit of chi-square {state.unit:.3g}")
    return _posterior_of(problem, space, members, sets, samples, about)


def _found(
    problem: Problem, space: Space, fixed: Sequence[Candidate], groups: Sequence[Group], start: Array
) -> tuple[Array, Sets, State]:
    """Values (K,) about which it was linearized last, the sets there, and the likeliest of them."""
    x = about = start
    rounds = ROUNDS if problem.noise_known else FEWER_ROUNDS
    for left in reversed(range(rounds)):
        problem.relinearize(space, x)
        sums = problem.sums(space, x)
        form = quadratic(problem, space, x, sums)
        if not (np.isfinite(form.excess) and np.all(np.isfinite(form.curvature))):
            # The step went where the model has no intensities: what was found before it stays.
            problem.relinearize(space, about)
            break
        about = x
        sets = Sets(form, groups, noise_of(problem, sums))
        state = likely_set(sets)
        if left == rounds - 1 and (state.unit > BENT or not problem.noise_known):
            # Several large causes, none of which explains much alone, or far from linear: all of them at once first.
            x = all_at_once(problem, space, fixed, x, sets.noise, TAU[-1])
            continue
        settled = left == 0
        if not settled:
            new, settled = next_values(problem, space, sets, state, x)
            x = x if settled else new
        if settled:
            break
    return about, sets, state


def _averaged(sets: Sets, state: State) -> Samples:
    """Average over sets; where what is left is the noise each has a unit of its own, and counts by its evidence."""
    return stay(sets, state, CHANGES) if sets.noise.known else sample(sets, state, SAMPLES)


def resampled(problem: Problem, found: Posterior, rounds: int) -> Posterior:
    """The same with other weights of the captures, from the likeliest set on; linearized anew at most so many times."""
    x, space = found.values, found.space
    for left in reversed(range(rounds)):
        sets = Sets(quadratic(problem, space, x, problem.sums(space, x)), found.sets.groups, found.sets.noise)
        state = climb(sets, found.samples.best)
        new, settled = next_values(problem, space, sets, state, x) if left else (x, True)
        if settled:
            break
        x = new
        problem.relinearize(space, x)
    return _posterior_of(problem, space, found.members, sets, _averaged(sets, state), x)


def _posterior_of(
    problem: Problem, space: Space, members: tuple[tuple[int, ...], ...], sets: Sets, samples: Samples, about: Array
) -> Posterior:
    """The posterior of a problem linearized `about` values (K,)."""
    typical, values = space.joined("typical"), mean_over_sets(space, samples, np.ones(space.size))
    z, form = values / typical, sets.form
    told = float(form.excess + 2 * form.gradient @ z + z @ form.curvature @ z)
    there = problem.sums(space, values, derivatives=False)
    left = float(there.excess.sum()) + (0.0 if problem.noise_known else float(there.freedom.sum()))
    if not sets.noise.unit(left) <= GROWTH * sets.noise.unit(told):
        # The least certain values lie along a bent valley, in which the straight line to their mean does not stay.
        values = improved(problem, space, sets.groups, samples, [about], 2 * STEPS)
    return Posterior(space, members, sets, samples, values, samples.covariance * np.outer(typical, typical))
