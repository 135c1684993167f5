"""The chi-square of a problem as a quadratic form in all candidates, their groups, and its unit."""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np
from scipy.linalg import eigh

from processing.arrays import Array
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.rules import LEAST_NOISE, NOISE_LEVEL, NOMINAL_TAU, SLACK
from processing.diagnosis.search.sets import Group, Noise, Quadratic
from processing.diagnosis.search.space import Problem, Space, Sums


def group_candidates(
    space: Space, fixed: Sequence[Candidate], far: Collection[Candidate] = ()
) -> tuple[tuple[tuple[int, ...], ...], list[Group]]:
    """Candidates of each group, and the groups: one kind at one place in all captures."""
    by_key: dict[tuple[str, str, int | None], list[int]] = {}
    for k, c in enumerate(space.candidates):
        by_key.setdefault((c.kind, c.place, c.capture if c.state_chosen else None), []).append(k)
    families = [space.candidates[m[0]].family for m in by_key.values()]
    groups = []
    for group, family in zip(by_key.values(), families, strict=True):
        index = np.concatenate([np.r_[space.slices[k]] for k in group]).astype(np.int64)
        always = space.candidates[group[0]] in fixed
        curve = space.candidates[group[0]].effect.is_response
        price = space.candidates[group[0]].price
        # How much a source fluctuates is learnt. With a wide prior, each level would cost less evidence in less light.
        is_level = space.candidates[group[0]].effect.is_projected
        is_far = is_level or any(space.candidates[k] in far for k in group)
        tau = NOMINAL_TAU if always and not is_level else None
        share = float(families.count(family))
        groups.append(Group(index, share, always=always, fixed_tau=tau, alone=curve, price=price, far=is_far))
    return tuple(tuple(m) for m in by_key.values()), groups


def noise_of(problem: Problem, sums: Sums) -> Noise:
    """Noise model of a problem: how its unit of chi-square follows."""
    freedom = max(float(sums.freedom.sum()), 1.0)
    if not problem.noise_known:
        # The unit is then the square of what `freedom` was reckoned with, relative to the signal.
        relative = float(sums.square.sum() / max(sums.count.sum(), 1.0)) * freedom
        chi2 = max(float(sums.excess.sum()) + freedom, 1e-300)
        return Noise(False, freedom, floor=LEAST_NOISE**2 * chi2 / max(relative, 1e-300))
    return Noise(True, directions_of(problem), SLACK * deviation_of(freedom, problem.spread))


def directions_of(problem: Problem) -> float:
    """Independent directions over which structure spreads: rows left over, for each component of the signal."""
    weighty = sum(free * power.sum() ** 2 / float(np.sum(power**2)) for free, power in problem.powers())
    return max(float(weighty), 1.0)


def deviation_of(freedom: float, spread: float) -> float:
    """Standard deviation of a sum of squares of so many degrees of freedom: of chance, and of the noise's own error."""
    return float(np.hypot(np.sqrt(2 * freedom * spread), NOISE_LEVEL * freedom))


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
    of_derivatives, of_counts = (part * np.outer(typical, typical) for part in problem.noise_information(space, x))
    h = h - of_counts - np.outer(g, a) - np.outer(a, g) + excess * np.outer(a, a)
    g = g - excess * a
    # Share of each curvature that is not noise of image derivatives.
    share = np.clip(1 - np.diag(of_derivatives) / np.maximum(np.diag(h), 1e-300), 0.0, 1.0)
    # The square of a count's noise varies twice as much as a product of two; what all counts share goes off.
    variance = 2 * (of_counts - freedom * np.outer(a, a))
    g, h = with_noise_of_counts(g * share, _without_negative(h * np.outer(share, share)), variance)
    excess, g, h = _integrate_out(np.sqrt(problem.time_noise(space, x)) / typical, excess, g, h)
    h = _without_negative(h)
    # Next to steep directions rounding can hide that a curvature is negative: such a value shows nothing.
    silent = np.diag(h) < 0
    g[silent], h[silent], h[:, silent] = 0.0, 0.0, 0.0
    z = x / typical
    total = excess if problem.noise_known else excess + freedom
    return Quadratic(float(total - 2 * g @ z + z @ h @ z), g - h @ z, h)


def _without_negative(h: Array) -> Array:
    """The matrix without its negative eigenvalues beyond rounding; a root, which is quick, shows if there are any."""
    rounding = h.shape[0] * np.finfo(float).eps * float(h.diagonal().max(initial=0.0))
    try:
        np.linalg.cholesky(h + rounding * np.eye(h.shape[0]))
    except np.linalg.LinAlgError:
        # Hundreds are zero but for rounding. Their vectors would take most of the time.
        value, vector = eigh(h, driver="evr", subset_by_value=(-np.inf, -rounding), check_finite=False)
        return np.asarray(h - (vector * value) @ vector.T)
    return h


def _integrate_out(sigma: Array, excess: float, g: Array, h: Array) -> tuple[float, Array, Array]:
    """A form with normal shifts of its values (K,), of standard deviation `sigma` (K,), integrated out."""
    index = np.flatnonzero(sigma)
    s, across = sigma[index], h[:, index]
    cov = np.linalg.inv(np.eye(index.size) + across[index] * np.outer(s, s)) * np.outer(s, s)
    return float(excess - g[index] @ cov @ g[index]), g - across @ cov @ g[index], h - across @ cov @ across.T


def with_noise_of_counts(g: Array, h: Array, variance: Array) -> tuple[Array, Array]:
    """Gradient and curvature of the same minimum, less certain by a further `variance` (K, K) of the gradient.

    The values H^-1 g have the covariance H^-1 (H + V) H^-1, the inverse of H (H + V)^-1 H.
    """
    index = np.flatnonzero(np.diag(variance) > 0)
    if not index.size:
        return g, h
    own = _without_negative(variance[np.ix_(index, index)])
    total = h.copy()
    total[np.ix_(index, index)] += own
    total += np.finfo(float).eps * len(h) * float(np.trace(total)) * np.eye(len(h))
    columns = np.column_stack([np.eye(len(h))[:, index], g])
    solved = np.linalg.solve(total, columns)[index]
    g, h = g.copy(), h.copy()
    g[index] -= own @ solved[:, -1]
    h[np.ix_(index, index)] += own @ solved[:, :-1] @ own - own
    return g, (h + h.T) / 2
