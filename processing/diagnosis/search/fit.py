"""Fit active effects to the captures, score a candidate without fitting it, and cross-fit it on held-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, BoolArray
from processing.diagnosis.search.bounded_step import bounded_step
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.range_of import NEARLY_ZERO, RANK
from processing.diagnosis.search.rules import LITTLE, NOMINAL_TAU, ROUNDS
from processing.diagnosis.search.space import Problem, Space, Sums

#: [of the degrees of freedom] That fitted values leave at least, where nothing is held out.
LEAST_FREEDOM = 0.2
#: [steps] Of a fit.
STEPS = 15
#: [unit of chi-square, see `minimize`] The fit ends when a step gains less than this.
LEAST_GAIN = 0.05


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
    return np.asarray(1.0 / (NOMINAL_TAU * space.joined("typical")) ** 2)


def minimize(
    problem: Problem,
    space: Space,
    start: Array,
    folds: Sequence[int] | None = None,
    *,
    free: NDArray[np.bool_] | None = None,
    steps: int = STEPS,
    expansions: int = ROUNDS,
    weak: Array | None = None,
    unit: float = 1.0,
    at_start: Sums | None = None,
) -> Fit:
    """Least chi-square over its stretch by Levenberg-Marquardt with bounds, on the data of the folds given.

    `weak` (K,) is the curvature of the prior; default: `prior`. Some values may be held, others are `free` (K,).
    `unit` is the chi-square of one independent direction: the fit ends when a step gains 5 % of it or less.
    Corrections of counts are expanded about the start, and at most `expansions` times anew about where the fit ended.
    `at_start`: the sums at the start, if they are known. Those of the fit may be without derivatives.
    """
    weak = prior(space) if weak is None else weak
    use = list(range(problem.folds) if folds is None else folds)
    move = (np.ones(space.size, dtype=bool) if free is None else free) & ~space.fixed
    fit = None
    for _ in range(1 + (expansions if folds is None else 0)):
        if folds is None and not problem.relinearize(space, start) and fit is not None:
            break
        fit = _descend(problem, space, start, use, free=move, steps=steps, weak=weak, unit=unit, sums=at_start)
        start, at_start = fit.values, None
    assert fit is not None
    return fit


def _descend(
    problem: Problem,
    space: Space,
    x: Array,
    use: Sequence[int],
    *,
    free: NDArray[np.bool_],
    steps: int,
    weak: Array,
    unit: float,
    sums: Sums | None,
) -> Fit:
    lower, upper = space.joined("lower"), space.joined("upper")
    x, damping = np.clip(x, lower, upper), 0.0
    sums = problem.sums(space, x) if sums is None else sums
    reference = float(sums.freedom[use].sum())
    cost = _penalize(sums, weak, x, use, reference=reference)
    for _ in range(steps):
        # A bend of the response stretches residual and noise alike, which is no gain.
        reduced = sums.excess[use].sum() / max(float(sums.freedom[use].sum()), 1e-300)
        g = sums.gradient[use].sum(axis=0) - reduced * sums.stretch[use].sum(axis=0) + weak * x
        h = sums.curvature[use].sum(axis=0) + np.diag(weak)
        if not free.any():
            break
        enough = LEAST_GAIN * unit + RANK * abs(cost)
        while True:
            # A step fails because values that the data hardly determine go too far to be linear. So the damping is in
            # units of the prior. In units of the curvature such values would move by a thousandth of the way.
            step = bounded_step(g, h + damping * np.diag(weak), lower - x, upper - x, free=free)
            # It also ends where slopes are no numbers: so far away the model has no intensities.
            if not damping and not -step @ (2 * g + h @ step) >= enough:
                return Fit(x, sums, float(sums.excess[use].sum()))
            tried = np.clip(x + step, lower, upper)
            # Derivatives are most of the work; a step that is refused needs none, and neither does the last one.
            new = problem.sums(space, tried, derivatives=False)
            now = _penalize(new, weak, tried, use, reference=reference)
            if now <= cost or damping > 1 / NEARLY_ZERO**2:
                break
            damping = max(10 * damping, 1.0)
        # Also where the sum is no number: so far away that the model has no intensities.
        if not now <= cost:
            break
        gain, x, cost, sums = cost - now, tried, now, new
        if gain < enough:
            break
        sums = problem.sums(space, x)
        damping = damping / 10 if damping > LITTLE else 0.0
    return Fit(x, sums, float(sums.excess[use].sum()))


def _with_slopes(problem: Problem, space: Space, fit: Fit) -> Fit:
    """The fit, its sums with derivatives."""
    return fit if fit.sums.gradient.shape[1] == space.size else replace(fit, sums=problem.sums(space, fit.values))


def _penalize(sums: Sums, weak: Array, values: Array, use: Sequence[int], *, reference: float) -> float:
    """Chi-square over its stretch, of some folds whose noise is `reference` as a whole, and the prior."""
    freedom = max(float(sums.freedom[use].sum()), 1e-300)
    return float(sums.excess[use].sum() * reference / freedom + weak @ values**2)


def score(sums: Sums, active: int, new: slice, weak: Array) -> tuple[float, Array]:
    """Expected gain of one Gauss-Newton step of some parameters, with the first `active` ones refitted.

    Returns
    -------
    gain in chi-square, and the information (k, k) about the new parameters that the active ones leave.
    """
    g = sums.gradient.sum(axis=0)
    h = sums.curvature.sum(axis=0)
    information, gradient = h[new, new], g[new]
    if active:
        old = h[:active, :active] + np.diag(weak[:active])
        inverse = np.linalg.solve(old, np.column_stack([h[:active, new], g[:active]]))
        information = information - h[new, :active] @ inverse[:, :-1]
        gradient = gradient - h[new, :active] @ inverse[:, -1]
    information = (information + information.T) / 2
    return float(gradient @ np.linalg.solve(information + np.diag(weak[new]), gradient)), information


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

    def of(self, capture: int) -> HeldOut:
        """The same of one capture alone."""
        square, count, excess, freedom = self.shares[capture].tolist()
        return HeldOut(excess, max(freedom, 1e-300), square, max(count, 1e-300))

    @property
    def chi2_reduced(self) -> float:
        """Sum of squares in units of the noise for each degree of freedom."""
        return (self.excess + self.freedom) / self.freedom

    @property
    def rms(self) -> float:
        """Root mean square residual over the mean signal, for each degree of freedom."""
        return float(np.sqrt(self.square / self.count))


def held_out(problem: Problem, space: Space, full: Fit, weak: Array | None = None, *, unit: float = 1.0) -> HeldOut:
    """Predict every fold from a fit to the other folds.

    Values that belong to one state alone cannot come from other states: where states are held out they are fitted to
    the state itself, and take away as many degrees of freedom as the data determine of them (and count as many more, as
    fitted noise would gain): several values of one state that share its few data, shrunk to their prior, are not one
    each. Where the data have a single part nothing is held out, and fitted values take degrees of freedom away.

    `weak` (K,) is the curvature of the prior; default: `prior`. `unit`: see `minimize`.
    """
    weak = prior(space) if weak is None else weak
    full = _with_slopes(problem, space, full)
    if problem.folds == 1:
        return _in_sample(space, full, weak)
    by_state = problem.holds_out_states
    local = np.zeros(space.size, dtype=bool)
    for candidate, part in space.pairs:
        local[part] = candidate.effect.per_state and by_state
    total, shares = np.zeros(4), np.zeros((full.sums.shares.shape[0], 4))
    spent = np.zeros(space.size)
    for fold in range(problem.folds):
        training_folds = [f for f in range(problem.folds) if f != fold]
        values = minimize(problem, space, full.values, training_folds, weak=weak, unit=unit, at_start=full.sums).values
        if local.any():
            start = np.where(local, full.values, values)
            of_states = minimize(problem, space, start, [fold], free=local, steps=3, unit=unit)
            fit = _with_slopes(problem, space, of_states)
            determined = _count_determined(fit.sums.curvature[fold], weak, local)
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


def _count_determined(curvature: Array, weak: Array, local: BoolArray) -> Array:
    """Share of each local value that the data determine, against the prior and other local values; 0 elsewhere."""
    h = curvature[np.ix_(local, local)]
    shares = np.zeros(local.size)
    shares[local] = np.diag(np.linalg.lstsq(h + np.diag(weak[local]), h, rcond=None)[0])
    return shares


def _count_values(space: Space, spent: Array, shares: Array, noise_known: bool) -> None:
    """Values of single states take degrees of freedom of their capture away; what several share, of all alike."""
    for candidate, part in space.pairs:
        if candidate.effect.per_state:
            scope = slice(None) if candidate.capture is None else candidate.capture
            each = spent[part].sum() / np.size(shares[scope, 1])
            shares[scope, 1] -= each
            shares[scope, 2] += 2 * each * noise_known


def _in_sample(space: Space, full: Fit, weak: Array) -> HeldOut:
    h = full.sums.curvature.sum(axis=0)
    fitted = float(np.trace(np.linalg.solve(h + np.diag(weak), h))) if space.size else 0.0
    freedom = float(full.sums.freedom.sum())
    share = max(1 - fitted / max(freedom, 1e-300), LEAST_FREEDOM)
    square, count = float(full.sums.square.sum()), float(full.sums.count.sum())
    shares = full.sums.shares.sum(axis=2) * [1.0, share, 1.0, share]
    excess = float(full.sums.excess.sum())
    return HeldOut(excess, max(share * freedom, 1e-300), square, max(share * count, 1e-300), shares)


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
    def ends(self) -> tuple[tuple[Space, Fit], tuple[Space, Fit]]:
        """Space and fit before and after."""
        return (self.base, self.before_fit), (self.space, self.fit)

    @property
    def undone(self) -> Solution:
        """Nothing corrected."""
        return Solution(self.base, self.before_fit, self.before, self.base, self.before_fit, self.before)
