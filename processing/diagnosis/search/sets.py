"""Which groups of parameters are there: evidence for sets of groups in one linearized problem.

The chi-square is a quadratic form in the parameters x (in units of their typical sizes). A group of parameters is
either absent (zero) or normal about zero with one variance tau^2, tau on a grid ("spike and slab", Mitchell and
Beauchamp, J. Am. Stat. Assoc. 83, 1023, 1988): values of one group share it, so forty values of a source that hardly
flickers come out as small as they are. The evidence of a set is then known in closed form (Tipping and Faul, AISTATS
2003, for one parameter).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.blas import dtrmm
from scipy.linalg.lapack import dlauum, dpotrf, dtrtri, dtrtrs

from processing.arrays import Array
from processing.diagnosis.search.rules import LITTLE, MANY, TAU, TAU_WEIGHT, TAU_WEIGHT_OF_FAR, TAU_WEIGHT_OF_MANY

#: [log odds] Of an impossible set, below the evidence of any data.
NEVER = -1e9
#: [1] Rates of causes, -1 to 1 for 0 to 1, and the weight of each in the prior's integral over them (Gauss, Legendre).
RATES, WEIGHTS = np.polynomial.legendre.leggauss(20)


@dataclass(frozen=True)
class Quadratic:
    """Chi-square about zero: excess + 2 gradient . x + x . curvature . x, of x (K,) in typical sizes."""

    excess: float
    gradient: Array
    curvature: Array

    def at(self, x: Array) -> float:
        """Chi-square at x (K,)."""
        return float(self.excess + 2 * self.gradient @ x + x @ self.curvature @ x)


@dataclass(frozen=True)
class Group:
    """Parameters that are there together and have one variance.

    Attributes
    ----------
    index : positions in x.
    share : it is one of so many alternatives of which one may be there (states at which an axis slips).
    always : it is there in every set.
    fixed_tau : standard deviation of its values; None: it is learnt.
    alone : of all groups that are, one may be there.
    far : its values may be beyond the plausible.
    """

    index: NDArray[np.int64]
    share: float = 1.0
    always: bool = False
    fixed_tau: float | None = None
    alone: bool = False
    price: float = 0.0
    far: bool = False


@dataclass(frozen=True)
class Noise:
    """Noise model of the chi-square: its unit is noise, and structure that no set explains.

    Residual structure is the same in all pixels: a noise of a few directions. It widens every error for any number of
    pixels.

    Attributes
    ----------
    is_known : the noise is known, so the unit is at least one; else the whole residual is noise.
    directions : independent directions over which structure spreads; of unknown noise, the degrees of freedom.
    slack : excess up to which the residual is noise.
    floor : least unit.
    """

    is_known: bool
    directions: float
    slack: float = 0.0
    floor: float = 1.0

    def unit(self, excess: Any) -> Any:
        """Most likely unit where a fit has an `excess`, one or several, the cost of the prior included."""
        beyond = self.directions + np.maximum(excess - self.slack, 0.0) if self.is_known else excess
        return np.maximum(beyond / self.directions, self.floor)

    def log_likelihood(self, excess: Any, unit: Any = None) -> Any:
        """Log of the likelihood of a fit with a unit, by default the most likely one."""
        unit, spread, within = self.unit(excess) if unit is None else unit, excess, 0.0
        if self.is_known:
            # Within the noise differences count in full.
            spread = self.directions + np.maximum(excess - self.slack, 0.0)
            within = np.minimum(excess - self.slack, 0.0)
        return -0.5 * (self.directions * np.log(unit) + spread / unit + within)


@dataclass
class State:
    """One set: tau of each group (0: absent), and the unit of chi-square."""

    tau: Array
    unit: float = 1.0

    def copy(self) -> State:
        """The same, to be changed."""
        return State(self.tau.copy(), self.unit)


@dataclass(frozen=True)
class SetFit:
    """Posterior of the parameters of one set: which `active` (A,), mean (A,), covariance (A, A), and how likely.

    `excess` is that of the fit (the cost of the prior included), `score` the log probability of the set with its unit.
    """

    active: NDArray[np.int64]
    mean: Array
    covariance: Array
    excess: float
    score: float


@dataclass(frozen=True)
class Conditional(SetFit):
    """The same, with the conditional posterior of every group: log odds (G,), and weights (G, T) of each tau.

    The odds are those of the set, as the search compares sets; averages take `Sets.learnt_odds`. `log_factor` (G,): log
    Bayes factor of the group, which is the log odds without the prior of the set; `fit_gain` (G,): the part of it that
    a better fit gives.
    """

    log_factor: Array
    log_odds: Array
    tau_weights: Array
    fit_gain: Array


@dataclass(frozen=True)
class _Factored:
    """A set with its unit: prior curvature (A,), lower root (A, A) of the posterior curvature, posterior mean (A,).

    `whitened` (A,) is the root's inverse times the gradient. The root has no meaning above its diagonal.
    """

    active: NDArray[np.int64]
    prior: Array
    lower: Array
    whitened: Array
    mean: Array
    excess: float
    score: float


class Sets:
    """Sets of groups in one quadratic problem."""

    def __init__(self, form: Quadratic, groups: Sequence[Group], noise: Noise) -> None:
        self.form, self.groups, self.noise = form, tuple(groups), noise
        self.is_learnt = np.array([g.fixed_tau is None for g in groups], dtype=bool)
        self.free = np.array([not g.always for g in groups], dtype=bool)
        self.share = np.array([g.share for g in groups])
        self.price = np.array([g.price for g in groups])
        self.alone = np.array([g.alone for g in groups], dtype=bool)
        self.size = form.gradient.size
        self._last: tuple[bytes, _Factored] | None = None
        # One of several alternatives, or a sentence with a price, is there less often than a cause: of each such weight
        # (W,) the log probability (R, W) to be there, and not to be, at each rate.
        weights, self._weight = np.unique(np.exp(-self.price) / self.share, return_inverse=True)
        present = (1 + RATES[:, None]) / 2 * weights
        self._log_present, self._log_absent = np.log(present), np.log1p(-present)
        self.taus = TAU
        sizes = np.array([g.index.size for g in groups])
        self.tau_weight = np.where((sizes >= MANY)[:, None], TAU_WEIGHT_OF_MANY, TAU_WEIGHT)
        self.tau_weight[np.array([g.far for g in groups], dtype=bool)] = TAU_WEIGHT_OF_FAR
        #: Groups of one size, where their values stand (G, n), and the curvature (G, n, n) of each.
        self._alike: list[tuple[NDArray[np.int64], NDArray[np.int64], Array]] = []
        for n in np.unique(sizes):
            if (members := np.flatnonzero((sizes == n) & self.is_learnt)).size:
                index = np.stack([self.groups[i].index for i in members])
                self._alike.append((members, index, form.curvature[index[:, :, None], index[:, None, :]]))

    def empty(self) -> State:
        """The set of the groups that are always present."""
        return self.settled(State(np.array([g.fixed_tau or float(g.always) for g in self.groups])))

    def settled(self, state: State) -> State:
        """The state with the unit of its residual."""
        for _ in range(4):
            fit = self._factored(state)
            unit = float(self.noise.unit(fit.excess))
            # About the likeliest unit the score is flat.
            if abs(unit - state.unit) <= LITTLE * state.unit:
                break
            # A larger unit weighs the prior more, so the excess grows: a step by Newton, at most ten times as far.
            grows = float(fit.prior @ fit.mean**2) / self.noise.directions if unit > self.noise.floor else 0.0
            step = (unit - state.unit) / (1 - min(grows, 0.9))
            state.unit = max(state.unit + step, self.noise.floor)
        return state

    def without(self, state: State, k: int) -> State:
        """The state without group k, the unit as it is."""
        reduced = state.copy()
        reduced.tau[k] = 0.0
        return reduced

    def _log_prior(self, tau: Array) -> float:
        """Log probability of a set and its variances."""
        learnt = self.is_learnt & (tau > 0)
        weight = self.tau_weight[learnt, np.argmin(np.abs(self.taus[:, None] - tau[learnt]), axis=0)]
        return self.log_prior(self.free & learnt) + float(np.log(np.maximum(weight, 1e-300)).sum())

    def log_prior(self, is_included: NDArray[np.bool_]) -> float:
        """Log probability of a set: any rate of causes is as likely as another (Scott and Berger, Ann. Stat. 38, 2010).

        So the rate is learnt from how many groups there are.
        """
        too_many = max(float((is_included & self.alone).sum()) - 1, 0.0)
        return float(np.logaddexp.reduce(self._at_rates(is_included))) + NEVER * too_many

    def _at_rates(self, is_included: NDArray[np.bool_]) -> Array:
        """Log of the part (R,) that each rate has in the probability of a set."""
        present, absent = (
            np.bincount(self._weight[self.free & which], minlength=self._log_present.shape[1])
            for which in (is_included, ~is_included)
        )
        return np.asarray(np.log(WEIGHTS / 2) + self._log_present @ present + self._log_absent @ absent)

    def prior_odds(self, is_included: NDArray[np.bool_]) -> Array:
        """Log odds (G,) of each free group to be there, of the prior, given the others of a set."""
        at_rates = self._at_rates(is_included)[:, None]
        of_absent, of_present = (
            np.logaddexp.reduce(at_rates - own + self._log_present)
            - np.logaddexp.reduce(at_rates - own + self._log_absent)
            for own in (self._log_absent, self._log_present)
        )
        return np.asarray(np.where(is_included, of_present[self._weight], of_absent[self._weight])) + self._barred(
            is_included
        )

    def learnt_odds(self, c: Conditional, is_included: NDArray[np.bool_]) -> Array:
        """Log odds (G,) of each group to be there, the presence of all others summed over at each rate.

        Whether a group is there that no data show tells nothing of the rate. With independent data it is exact.
        """
        factor = np.where(self.free, c.log_factor, 0.0)
        log_present, log_absent = (part[:, self._weight] for part in (self._log_present, self._log_absent))
        each = np.logaddexp(log_absent, log_present + factor)
        others = np.log(WEIGHTS)[:, None] + each.sum(axis=1, keepdims=True) - each
        at_rates = np.exp(others - others.max(axis=0))
        present, absent = (np.sum(at_rates * np.exp(part), axis=0) for part in (log_present, log_absent))
        prior = np.log(present / absent)
        return np.where(self.free, c.log_factor + prior + self._barred(is_included), np.inf)

    def _barred(self, is_included: NDArray[np.bool_]) -> Array:
        """Log odds (G,) of groups beside which no other may be there."""
        beside = (is_included & self.alone).sum() - (is_included & self.alone)
        return np.asarray(NEVER * np.where(self.alone, beside, 0.0))

    def fitted(self, state: State) -> SetFit:
        """Posterior of the parameters that are there."""
        return self._solved(state)[0]

    def score(self, state: State) -> float:
        """Log probability of a set with its unit."""
        return self._factored(state).score

    def _factored(self, state: State) -> _Factored:
        key = np.append(state.unit, state.tau).tobytes()
        # A set is scored, and asked for the odds of others, one after the other.
        if self._last is None or self._last[0] != key:
            self._last = key, self._factor(state)
        return self._last[1]

    def _factor(self, state: State) -> _Factored:
        on, u = np.flatnonzero(state.tau > 0), state.unit
        active = np.concatenate([np.zeros(0, dtype=np.int64), *(self.groups[i].index for i in on)])
        prior = np.concatenate([np.zeros(0), *(np.full(self.groups[i].index.size, state.tau[i] ** -2.0) for i in on)])
        if not active.size:
            # LAPACK takes no empty matrix.
            score = self.noise.log_likelihood(self.form.excess, u) + self._log_prior(state.tau)
            return _Factored(active, prior, np.zeros((0, 0)), prior, prior, self.form.excess, score)
        # A third of the time that `ix_` takes.
        curvature = self.form.curvature.ravel().take(active[:, None] * self.size + active)
        curvature /= u
        curvature.flat[:: active.size + 1] += prior
        lower = _root(curvature)
        whitened = dtrtrs(lower, self.form.gradient[active] / u, lower=1)[0]
        excess = self.form.excess - u * float(whitened @ whitened)
        # What the width of the prior costs: log det (I + T H / u).
        width = 2 * float(np.log(np.diag(lower)).sum()) - float(np.log(prior).sum())
        score = self.noise.log_likelihood(excess, u) - 0.5 * width + self._log_prior(state.tau)
        mean = -dtrtrs(lower, whitened, lower=1, trans=1)[0]
        return _Factored(active, prior, lower, whitened, mean, excess, score)

    def _solved(self, state: State) -> tuple[SetFit, Array, Array]:
        fit = self._factored(state)
        inverse = np.asarray(dtrtri(fit.lower, lower=1)[0]) if fit.active.size else fit.lower
        half = np.tril(dlauum(inverse, lower=1)[0]) if fit.active.size else fit.lower
        covariance = half + np.tril(half, -1).T
        return SetFit(fit.active, fit.mean, covariance, fit.excess, fit.score), inverse, fit.whitened

    def conditional(self, state: State, *, follow: bool = False) -> Conditional:
        """Posterior of the parameters that are there, and odds of every group given the others.

        With `follow` the unit is that which a group leaves, where it is not there yet.
        """
        fit, inverse, right = self._solved(state)
        log_factor, fit_gain = np.full(len(self.groups), np.inf), np.zeros(len(self.groups))
        weights, now = np.zeros((len(self.groups), self.taus.size)), self.noise.log_likelihood(fit.excess)
        for members, s, q in self._cavities(state, fit, inverse, right):
            value, along = _along_axes(s, q)
            prior = self.tau_weight[members]
            kept = np.flatnonzero(prior.any(axis=0))
            t2 = (self.taus[kept] ** 2)[:, None]
            scaled = t2 * value
            explained = np.sum(t2 * along / (1 + scaled), axis=2)
            gain = 0.5 * (explained - np.sum(np.log1p(scaled), axis=2))
            if follow and (new := state.tau[members] == 0).any():
                excess = fit.excess - state.unit * explained[new]
                wider = np.log1p(scaled[new] * (state.unit / self.noise.unit(excess))[..., None])
                gain[new] = self.noise.log_likelihood(excess) - now - 0.5 * np.sum(wider, axis=2)
            gain += np.log(np.maximum(prior[:, kept], 1e-300))
            top = gain.max(axis=1, keepdims=True)
            share = np.exp(gain - top)
            total = share.sum(axis=1, keepdims=True)
            weights[members[:, None], kept] = share / total
            fit_gain[members] = 0.5 * np.sum(explained * share / total, axis=1)
            log_factor[members] = (top + np.log(total))[:, 0]
        is_included = (state.tau > 0) & self.free
        log_odds = np.where(self.free, log_factor + self.prior_odds(is_included), np.inf)
        return Conditional(
            **vars(fit), log_factor=log_factor, log_odds=log_odds, tau_weights=weights, fit_gain=fit_gain
        )

    def _cavities(
        self, state: State, fit: SetFit, inverse: Array, right: Array
    ) -> Iterator[tuple[NDArray[np.int64], Array, Array]]:
        """Groups of one size, with curvature (G, n, n) and gradient (G, n) about zero given all other groups."""
        where = np.full(self.size, -1)
        where[fit.active] = np.arange(fit.active.size)
        rest = np.flatnonzero(where < 0)
        where[rest] = np.arange(rest.size)
        # What the groups that are there take from each value of the rest; the inverse is a triangle.
        taken = self.form.curvature.ravel().take(rest[:, None] * self.size + fit.active)
        if fit.active.size:
            taken = dtrmm(1 / state.unit, inverse, taken.T, lower=1, overwrite_b=1).T
        for members, index, own_curvature in self._alike:
            s, q = own_curvature / state.unit, self.form.gradient[index] / state.unit
            is_included = state.tau[members] > 0
            part = taken[where[index[~is_included]]]
            s[~is_included] -= part @ part.transpose(0, 2, 1)
            q[~is_included] -= part @ right
            # The posterior of a group that is there is its prior times what the others leave it.
            at = where[index[is_included]]
            precision = np.linalg.inv(fit.covariance[at[:, :, None], at[:, None, :]])
            s[is_included] = precision - np.eye(at.shape[1]) * state.tau[members[is_included], None, None] ** -2.0
            q[is_included] = -(precision @ fit.mean[at][..., None])[..., 0]
            yield members, s, q


def _along_axes(s: Array, q: Array) -> tuple[Array, Array]:
    """Eigenvalues (G, 1, n) of matrices s (G, n, n), and squares (G, 1, n) of vectors q (G, n) along their axes."""
    if s.shape[1] == 1:
        # Most groups are one value, which is its own axis: LAPACK would take as long for each as for a matrix.
        return np.maximum(s, 0.0), q[:, None] ** 2
    value, vector = np.linalg.eigh((s + s.transpose(0, 2, 1)) / 2)
    along = (q[:, None] @ vector) ** 2
    return np.maximum(value, 0.0)[:, None], along


def _root(matrix: Array) -> Array:
    """Lower Cholesky factor of a symmetric matrix; above its diagonal it has no meaning.

    It is that of the nearest positive matrix if rounding has made this one indefinite next to steep directions.
    """
    root, failed = dpotrf(matrix.T, lower=1, clean=0, overwrite_a=0)
    if failed:
        value, vector = np.linalg.eigh(matrix)
        least = matrix.shape[0] * np.finfo(float).eps * value[-1]
        mended = (vector * np.maximum(value, 4 * least)) @ vector.T + least * np.eye(len(value))
        return np.asfortranarray(np.linalg.cholesky(mended))
    return np.asarray(root)
