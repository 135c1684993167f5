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
from processing.diagnosis.search.likely_set import climb, likely_set
from processing.diagnosis.search.problem import Problem
from processing.diagnosis.search.rules import (
    BENT,
    CHANGES,
    GROWTH,
    LEAST_NOISE,
    NOMINAL_TAU,
    ROUNDS,
    SAMPLES,
    SAMPLES_BEFORE,
    SETTLED,
    SLACK,
    TAKES_PART,
    TAU,
)
from processing.diagnosis.search.sampling import Samples, sample
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets, State
from processing.diagnosis.search.space import Space, Sums
from processing.diagnosis.search.stays import stay

#: Called with a line that says what is being done.
Say = Callable[[str], None]

STEPS = 6
#: Times that everything is linearized anew before groups are chosen.
EXPANSIONS = 8
#: The descent ends when a step gains less than this in chi-square, or this fraction of it.
LEAST_GAIN, LEAST_RELATIVE = 0.05, 1e-7


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
            x = _everything(problem, space, fixed, x, sets.noise)
            continue
        settled = left == 0
        if not settled:
            new, settled = _next(problem, space, sets, state, x)
            x = x if settled else new
        if settled:
            break
    samples = _averaged(sets, state)
    there = [space.candidates[members[g][0]].label for g in np.flatnonzero((samples.probability > 0.5) & sets.free)]
    say(f"likely: {', '.join(there) or 'nothing'}; unit of chi-square {state.unit:.3g}")
    return _posterior_of(problem, space, members, sets, samples, about)


def _next(problem: Problem, space: Space, sets: Sets, state: State, x: Array) -> tuple[Array, bool]:
    """Values (K,) about which to linearize next, and whether they are so near to x (K,) that there is no need."""
    samples = sample(sets, state, SAMPLES_BEFORE)
    new = _improved(problem, space, sets.groups, samples, [_mean(space, samples, x), x])
    spread = np.sqrt(np.maximum(np.diag(samples.covariance), 1e-12)) * space.joined("typical")
    return new, bool(np.all(np.abs(new - x) < SETTLED * spread))


def _mean(space: Space, samples: Samples, x: Array) -> Array:
    """Values (K,), mean over the sets; of what is not fitted those of x (K,)."""
    typical, lower, upper = (space.joined(name) for name in ("typical", "lower", "upper"))
    return np.where(space.fixed, x, np.clip(samples.mean * typical, lower, upper))


def _averaged(sets: Sets, state: State) -> Samples:
    """Average over sets; where what is left is the noise each has a unit of its own, and counts by its evidence."""
    return stay(sets, state, CHANGES) if sets.noise.known else sample(sets, state, SAMPLES)


def _everything(problem: Problem, space: Space, fixed: Sequence[Candidate], x: Array, noise: Noise) -> Array:
    """Values (K,) with every group as wide as its prior allows, but those that are one of many alternatives."""
    chosen = [k for k, c in enumerate(space.candidates) if not c.state_chosen]
    part = Space(tuple(space.candidates[k] for k in chosen))
    positions = np.concatenate([np.r_[space.slices[k]] for k in chosen]).astype(int)
    always = np.concatenate([np.full(c.size, c in fixed) for c in part.candidates])
    width = part.joined("typical") * np.where(always, NOMINAL_TAU, TAU[-1])
    values = x[positions]
    for _ in range(EXPANSIONS):
        sums = problem.sums(part, values, derivatives=False)
        left = float(sums.excess.sum()) + (0.0 if problem.noise_known else float(sums.freedom.sum()))
        new = descend(problem, part, values, noise.unit(left) / width**2, steps=3)
        moved, values = np.max(np.abs(new - values) / width), new
        if not problem.relinearize(part, values) and moved < SETTLED:
            break
    out = x.copy()
    out[positions] = values
    return out


def resampled(problem: Problem, found: Posterior, rounds: int) -> Posterior:
    """The same with other weights of the captures, from the likeliest set on; linearized anew at most so many times."""
    x, space = found.values, found.space
    for left in reversed(range(rounds)):
        sets = Sets(quadratic(problem, space, x, problem.sums(space, x)), found.sets.groups, found.sets.noise)
        state = climb(sets, found.samples.best)
        new, settled = _next(problem, space, sets, state, x) if left else (x, True)
        if settled:
            break
        x = new
        problem.relinearize(space, x)
    return _posterior_of(problem, space, found.members, sets, _averaged(sets, state), x)


def _posterior_of(
    problem: Problem, space: Space, members: tuple[tuple[int, ...], ...], sets: Sets, samples: Samples, about: Array
) -> Posterior:
    """The posterior of a problem linearized `about` values (K,)."""
    typical, values = space.joined("typical"), _mean(space, samples, np.ones(space.size))
    z, form = values / typical, sets.form
    told = float(form.excess + 2 * form.gradient @ z + z @ form.curvature @ z)
    there = problem.sums(space, values, derivatives=False)
    left = float(there.excess.sum()) + (0.0 if problem.noise_known else float(there.freedom.sum()))
    if not sets.noise.unit(left) <= GROWTH * sets.noise.unit(told):
        # The least certain values lie along a bent valley, in which the straight line to their mean does not stay.
        values = _improved(problem, space, sets.groups, samples, [about], 2 * STEPS)
    return Posterior(space, members, sets, samples, values, samples.covariance * np.outer(typical, typical))


def grouped(space: Space, fixed: Sequence[Candidate]) -> tuple[tuple[tuple[int, ...], ...], list[Group]]:
    """Candidates of each group, and the groups: one kind at one place in all captures."""
    by_key: dict[tuple[str, str, int | None], list[int]] = {}
    for k, c in enumerate(space.candidates):
        by_key.setdefault((c.kind, c.place, c.capture if c.state_chosen else None), []).append(k)
    families = [space.candidates[m[0]].family for m in by_key.values()]
    groups = []
    for mine, family in zip(by_key.values(), families, strict=True):
        index = np.concatenate([np.r_[space.slices[k]] for k in mine]).astype(np.int64)
        always = space.candidates[mine[0]] in fixed
        groups.append(Group(index, float(families.count(family)), NOMINAL_TAU if always else None))
    return tuple(tuple(m) for m in by_key.values()), groups


def noise_of(problem: Problem, sums: Sums) -> Noise:
    """What the unit of chi-square is made of in a problem."""
    freedom = max(float(sums.freedom.sum()), 1.0)
    if not problem.noise_known:
        # The unit is then the square of what `freedom` was reckoned with, relative to the signal.
        relative = float(sums.square.sum() / max(sums.count.sum(), 1.0)) * freedom
        left = max(float(sums.excess.sum()) + freedom, 1e-300)
        return Noise(False, freedom, floor=LEAST_NOISE**2 * left / max(relative, 1e-300))
    weighty = sum(free * power.sum() ** 2 / float(np.sum(power**2)) for free, power in problem.powers())
    return Noise(True, max(weighty, 1.0), SLACK * float(np.sqrt(2 * freedom * problem.spread)))


def quadratic(problem: Problem, space: Space, x: Array, sums: Sums) -> Quadratic:
    """The chi-square about x as a form about zero, in typical sizes.

    A bend of the response stretches residual and noise alike, which is no gain: the derivative of the residual is that
    of the residual over the stretch, r / (1 + a . dx), so r a goes off it.
    """
    typical = space.joined("typical")
    freedom, excess = max(float(sums.freedom.sum()), 1e-300), float(sums.excess.sum())
    a = sums.stretch.sum(axis=0) * typical / freedom
    g = sums.gradient.sum(axis=0) * typical
    h = sums.curvature.sum(axis=0) * np.outer(typical, typical)
    h = h - np.outer(g, a) - np.outer(a, g) + (excess - freedom) * np.outer(a, a)
    g = g - excess * a
    told = _told(problem, space, x, h, typical)
    h, g = h * np.outer(told, told), g * told
    value, vector = np.linalg.eigh(h)
    h = (vector * np.maximum(value, 0.0)) @ vector.T
    z = x / typical
    total = excess if problem.noise_known else excess + freedom
    return Quadratic(float(total - 2 * g @ z + z @ h @ z), g - h @ z, h)


def _told(problem: Problem, space: Space, x: Array, h: Array, typical: Array) -> Array:
    """Share (K,) of the curvature that is not noise of image derivatives."""
    noise = np.diag(problem.noise_information(space, x)) * typical**2
    return np.asarray(np.clip(1 - noise / np.maximum(np.diag(h), 1e-300), 0.0, 1.0))


def _improved(
    problem: Problem,
    space: Space,
    groups: Sequence[Group],
    samples: Samples,
    starts: Sequence[Array],
    steps: int = STEPS,
) -> Array:
    """Values (K,) at the minimum of chi-square and prior, of the groups that are likely to be there.

    The descent begins at the best of some places (K,).
    """
    index = np.concatenate(
        [np.zeros(0, dtype=np.int64)]
        + [g.index for g, p in zip(groups, samples.probability, strict=True) if p > TAKES_PART]
    )
    chosen = [k for k, part in enumerate(space.slices) if part.start in set(index.tolist())]
    part = Space(tuple(space.candidates[k] for k in chosen))
    positions = np.concatenate([np.zeros(0, dtype=np.int64), *(np.r_[space.slices[k]] for k in chosen)]).astype(int)
    typical = space.joined("typical")[positions]
    width = np.sqrt(np.diag(samples.covariance) + samples.mean**2)[positions] * typical
    weak = samples.best.unit / np.maximum(width, 1e-3 * typical) ** 2
    out = np.where(space.fixed, starts[0], 0.0)
    if positions.size:
        places = [x[positions] for x in starts]
        left = [_penalized(problem.sums(part, x, derivatives=False), weak, x) for x in places]
        best = int(np.argmin(np.nan_to_num(left, nan=np.inf)))
        out[positions] = descend(problem, part, places[best], weak, steps)
    return out


def _penalized(sums: Sums, weak: Array, values: Array, reference: float | None = None) -> float:
    """Chi-square over its stretch and prior, in units of noise that is `reference` as a whole."""
    freedom = max(float(sums.freedom.sum()), 1e-300)
    return float(sums.excess.sum() * (freedom if reference is None else reference) / freedom + weak @ values**2)


def descend(problem: Problem, space: Space, x: Array, weak: Array, steps: int = STEPS) -> Array:
    """Values at the minimum of chi-square over its stretch, plus weak . x^2, near x (Levenberg-Marquardt, bounds)."""
    lower, upper = space.joined("lower"), space.joined("upper")
    problem.relinearize(space, x)
    start = problem.sums(space, x, derivatives=False)
    reference, damping = float(start.freedom.sum()), 0.0

    least = _penalized(start, weak, x, reference)
    for _ in range(steps):
        sums = problem.sums(space, x)
        freedom = max(float(sums.freedom.sum()), 1e-300)
        g = sums.gradient.sum(axis=0) - sums.excess.sum() / freedom * sums.stretch.sum(axis=0) + weak * x
        h = sums.curvature.sum(axis=0) + np.diag(weak)
        for _ in range(8):
            move = np.linalg.solve(h + damping * np.diag(np.diag(h)), g)
            tried = np.where(space.fixed, x, np.clip(x - move, lower, upper))
            # Derivatives are most of the work; a step that is refused needs none.
            now = _penalized(problem.sums(space, tried, derivatives=False), weak, tried, reference)
            if now <= least:
                break
            damping = max(10 * damping, 1e-3)
        # Also where the sum is no number: so far away that the model has no intensities.
        if not now <= least:
            break
        gain, x, least, damping = least - now, tried, now, damping / 10
        if gain < LEAST_GAIN + LEAST_RELATIVE * abs(least):
            break
    return x
