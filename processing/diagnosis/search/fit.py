"""Fit active effects to the captures, score a candidate without fitting it, and cross-fit it on held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.space import Problem, Space, Sums

#: [of the degrees of freedom] That fitted values leave at least, where nothing is held out.
LEAST_FREEDOM = 0.2

#: [typical sizes] Width of the prior that keeps unseen parameters still.
PRIOR_WIDTH = 10.0
#: [steps] Of a fit.
STEPS = 15
#: [steps] Of a fit that what is held out is predicted by.
MANY_STEPS = 30
#: [of the excess] To which what is held out is predicted: a fit that ends earlier would still know it.
HELD_OUT_RELATIVE = 1e-4
#: [steps] Of such a fit where the model is far from linear.
FEW_STEPS = 6
#: [times] That corrections of counts are expanded anew in one fit.
EXPANSIONS = 2
#: [chi-square] The fit ends when a step promises less than this.
LEAST_GAIN = 0.01
#: [of the excess] The same.
LEAST_RELATIVE = 1e-7
#: [1] By which a step that is refused is damped more, and one that is taken less.
STIFFER = 10.0
#: [of the curvature] Damping of the first step.
FIRST_DAMPING = 1e-6
#: [of the curvature] Least damping of a step that is taken.
LEAST_DAMPING = 1e-9
#: [of the curvature] Least damping of a step that was refused.
REFUSED_DAMPING = 1e-4
#: [of the curvature] Damping beyond which there is no step.
MOST_DAMPING = 1e6


@dataclass(frozen=True)
class Fit:
    """Values at the minimum, the sums there, and the excess summed over the folds used."""

    values: Array
    sums: Sums
    excess: float

    @property
    def rms(self) -> float:
        """Residual relative to the mean signal, root mean square."""
        return float(np.sqrt(self.sums.square.sum() / max(self.sums.count.sum(), 1.0)))


def prior(space: Space) -> Array:
    """Curvature (K,) of the weak prior about zero."""
    return np.asarray(1.0 / (PRIOR_WIDTH * space.joined("typical")) ** 2)


def minimize(
    problem: Problem,
    space: Space,
    start: Array,
    folds: Sequence[int] | None = None,
    *,
    free: NDArray[np.bool_] | None = None,
    steps: int = STEPS,
    expansions: int = EXPANSIONS,
    least_gain: float = LEAST_GAIN,
    weak: Array | None = None,
) -> Fit:
    """Least squares by Levenberg-Marquardt with bounds, on the data of the folds given; `free` (K,) may hold some.

    It ends when a step gains less than `least_gain`. `weak` (K,) is the curvature of the prior; default: `prior`.
    Corrections of counts are expanded about the start, and at most `expansions` times anew about where the fit ended.
    """
    if folds is None and expansions:
        problem.relinearize(space, start)
    weak = prior(space) if weak is None else weak
    fit = _descend(problem, space, start, folds, free=free, steps=steps, least_gain=least_gain, weak=weak)
    if folds is None:
        for _ in range(expansions):
            if not problem.relinearize(space, fit.values):
                break
            fit = _descend(problem, space, fit.values, folds, free=free, steps=steps, least_gain=least_gain, weak=weak)
    return fit


def _descend(
    problem: Problem,
    space: Space,
    start: Array,
    folds: Sequence[int] | None,
    *,
    free: NDArray[np.bool_] | None,
    steps: int,
    least_gain: float,
    weak: Array,
) -> Fit:
    use = list(range(problem.folds) if folds is None else folds)
    lower, upper = space.joined("lower"), space.joined("upper")
    free = (np.ones(space.size, dtype=bool) if free is None else free) & ~space.fixed
    x = np.clip(start, lower, upper)
    sums = problem.sums(space, x)
    cost = sums.excess[use].sum() + weak @ x**2
    damping = FIRST_DAMPING
    for _ in range(steps):
        g = sums.gradient[use].sum(axis=0) + weak * x
        h = sums.curvature[use].sum(axis=0) + np.diag(weak)
        move = free & ~((x <= lower) & (g > 0)) & ~((x >= upper) & (g < 0))
        if not move.any():
            break
        gm, hm = g[move], h[np.ix_(move, move)]
        if damping <= FIRST_DAMPING and _promise(gm, hm) < least_gain + LEAST_RELATIVE * abs(cost):
            break
        while True:
            step = np.zeros_like(x)
            step[move] = -np.linalg.solve(hm + damping * np.diag(np.diag(hm)), gm)
            tried = np.clip(x + step, lower, upper)
            # Derivatives are most of the work; a step that is refused needs none.
            new_cost = problem.sums(space, tried, derivatives=False).excess[use].sum() + weak @ tried**2
            if new_cost <= cost or damping > MOST_DAMPING:
                break
            damping = max(damping * STIFFER, REFUSED_DAMPING)
        if not new_cost <= cost:
            break
        gain = cost - new_cost
        x, sums, cost = tried, problem.sums(space, tried), new_cost
        damping = max(damping / STIFFER, LEAST_DAMPING)
        if gain < least_gain + LEAST_RELATIVE * abs(cost):
            break
    return Fit(x, sums, float(sums.excess[use].sum()))


def _promise(g: Array, h: Array) -> float:
    return float(g @ np.linalg.solve(h, g))


def score(sums: Sums, active: int, new: slice, weak: Array) -> tuple[float, Array]:
    """What one Gauss-Newton step of some parameters promises, the first `active` ones refitted with them.

    Returns
    -------
    gain in chi-square, and the information (k, k) about the new parameters that the active ones leave.
    """
    g = sums.gradient.sum(axis=0)
    h = sums.curvature.sum(axis=0)
    left, right = h[new, new], g[new]
    if active:
        old = h[:active, :active] + np.diag(weak[:active])
        inverse = np.linalg.solve(old, np.column_stack([h[:active, new], g[:active]]))
        left = left - h[new, :active] @ inverse[:, :-1]
        right = right - h[new, :active] @ inverse[:, -1]
    left = (left + left.T) / 2
    return float(right @ np.linalg.solve(left + np.diag(weak[new]), right)), left


@dataclass(frozen=True)
class HeldOut:
    """How well every fold is predicted by a fit to the others; see `Sums`.

    `shares` (captures, 4): what each capture has of `square`, `count`, `excess` and `freedom`.
    """

    excess: float
    freedom: float
    square: float
    count: float
    shares: Array = field(default_factory=lambda: np.zeros((0, 4)))

    def rms_of(self, capture: int) -> float:
        """`rms` of one capture alone."""
        return self.of(capture).rms

    def of(self, capture: int) -> HeldOut:
        """The same of one capture alone."""
        square, count, excess, freedom = self.shares[capture].tolist()
        return HeldOut(excess, max(freedom, 1e-300), square, max(count, 1e-300))

    def and_more(self, excess: float, square: float) -> HeldOut:
        """The same with more left over, in units of the noise and of the signal."""
        # Fits to other folds may end elsewhere than the fit to all, whose difference this is.
        return HeldOut(self.excess + excess, self.freedom, max(self.square + square, 0.0), self.count)

    @property
    def chi2_reduced(self) -> float:
        """Sum of squares in units of the noise for each degree of freedom."""
        return (self.excess + self.freedom) / self.freedom

    @property
    def rms(self) -> float:
        """Root mean square residual over the mean signal, for each degree of freedom."""
        return float(np.sqrt(self.square / self.count))


def held_out(problem: Problem, space: Space, full: Fit, weak: Array | None = None) -> HeldOut:
    """Predict every fold from a fit to the other folds.

    Values that belong to one state alone cannot come from other states: where states are held out they are fitted to
    the state itself, and take away as many degrees of freedom as the data determine of them (and count as many more, as
    fitted noise would gain): several values of one state that share its few data, shrunk to their prior, are not one
    each. Where the data have a single part nothing is held out, and fitted values take degrees of freedom away.

    `weak` (K,) is the curvature of the prior; default: `prior`.
    """
    weak = prior(space) if weak is None else weak
    if problem.folds == 1:
        return _in_sample(space, full, weak)
    by_state = problem.holds_out_states
    local = np.zeros(space.size, dtype=bool)
    for candidate, part in space.pairs:
        local[part] = candidate.effect.per_state and by_state
    total, shares = np.zeros(4), np.zeros((full.sums.shares.shape[0], 4))
    spent = np.zeros(space.size)
    for fold in range(problem.folds):
        others = [f for f in range(problem.folds) if f != fold]
        if problem.far_from_linear:
            values = minimize(problem, space, full.values, others, steps=FEW_STEPS).values
        else:
            values = _one_step(full, space, others, weak)
            if _worse(problem, space, full, values, folds=others, weak=weak):
                # The least certain values moved farther than one step can tell.
                least = max(LEAST_GAIN, HELD_OUT_RELATIVE * abs(full.excess))
                fit = minimize(problem, space, full.values, others, steps=MANY_STEPS, least_gain=least, weak=weak)
                values = fit.values
        if local.any():
            start = np.where(local, full.values, values)
            fit = minimize(problem, space, start, [fold], free=local, steps=3)
            determined = _determined(fit.sums.curvature[fold], weak, local)
            spent += determined
            total[3] -= determined.sum()
            if problem.noise_known:
                total[0] += 2 * determined.sum()
            sums = fit.sums
        else:
            sums = problem.sums(space, values, derivatives=False)
        total += (sums.excess[fold], sums.freedom[fold], sums.square[fold], sums.count[fold])
        shares += sums.shares[:, :, fold]
    if by_state:
        _count_values(space, spent, shares, problem.noise_known)
    excess, freedom, square, count = map(float, total)
    return HeldOut(excess, freedom, square, count, shares)


def _determined(curvature: Array, weak: Array, local: BoolArray) -> Array:
    """What share of each local value the data determine, against the prior and the other local values; 0 elsewhere."""
    h = curvature[np.ix_(local, local)]
    shares = np.zeros(local.size)
    shares[local] = np.diag(np.linalg.lstsq(h + np.diag(weak[local]), h, rcond=None)[0])
    return shares


def _count_values(space: Space, spent: Array, shares: Array, noise_known: bool) -> None:
    """Values of single states take degrees of freedom of their capture away; what several share, of all alike."""
    for candidate, part in space.pairs:
        if candidate.effect.per_state:
            mine = slice(None) if candidate.capture is None else candidate.capture
            each = spent[part].sum() / np.size(shares[mine, 1])
            shares[mine, 1] -= each
            shares[mine, 2] += 2 * each * noise_known


def _in_sample(space: Space, full: Fit, weak: Array) -> HeldOut:
    h = full.sums.curvature.sum(axis=0)
    fitted = float(np.trace(np.linalg.solve(h + np.diag(weak), h))) if space.size else 0.0
    freedom = float(full.sums.freedom.sum())
    share = max(1 - fitted / max(freedom, 1e-300), LEAST_FREEDOM)
    square, count = float(full.sums.square.sum()), float(full.sums.count.sum())
    shares = full.sums.shares.sum(axis=2) * [1.0, share, 1.0, share]
    excess = float(full.sums.excess.sum())
    return HeldOut(excess, max(share * freedom, 1e-300), square, max(share * count, 1e-300), shares)


def _worse(problem: Problem, space: Space, full: Fit, values: Array, *, folds: Sequence[int], weak: Array) -> bool:
    """Whether the data of these folds and the prior are fitted worse than by the fit to all of them."""
    new = problem.sums(space, values, derivatives=False)
    gain = full.sums.excess[folds].sum() - new.excess[folds].sum() + weak @ (full.values**2 - values**2)
    return not gain >= 0


def _one_step(full: Fit, space: Space, folds: Sequence[int], weak: Array) -> Array:
    """Minimum for some of the folds, one Gauss-Newton step from the minimum for all: they are close."""
    if not space.size:
        return full.values
    g = full.sums.gradient[folds].sum(axis=0) + weak * full.values
    h = full.sums.curvature[folds].sum(axis=0) + np.diag(weak)
    lower, upper = space.joined("lower"), space.joined("upper")
    step = np.where(space.fixed, 0.0, np.linalg.solve(h, g))
    return np.asarray(np.clip(full.values - step, lower, upper))


@dataclass
class Solution:
    """Before and after, on data that the fit did not see.

    Attributes
    ----------
    base : what is always fitted; space : that, and the effects of the correction (the mean of the posterior).
    before_fit, fit : at these; before, after : predictions of what was held out.
    weak : (K,) curvature of the prior of the values of `space`.
    """

    base: Space
    before_fit: Fit
    before: HeldOut
    space: Space
    fit: Fit
    after: HeldOut
    weak: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def effects(self) -> tuple[Candidate, ...]:
        """Effects of the correction."""
        return self.space.candidates[len(self.base.candidates) :]

    @property
    def undone(self) -> Solution:
        """Nothing corrected."""
        return Solution(self.base, self.before_fit, self.before, self.base, self.before_fit, self.before)
