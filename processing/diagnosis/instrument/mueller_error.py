"""Error of a Mueller matrix: the posterior of all effects about the values that are applied, in directions of M.

Directions that an unknown sample absorbs (a common azimuth, a retardance) keep the variance of their prior. They are
not applied and remain in this error. So does what was found and is not used.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.features import DERIVATIVES, FEATURES, features
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.recommend import SAMPLES
from processing.diagnosis.search.decision import Along, PredictedChange, chance_checks, predicted_change
from processing.diagnosis.search.fit import Solution
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.range_of import RANK
from processing.diagnosis.search.result import Check, MuellerError
from processing.diagnosis.search.rules import CHANCE_WORSE, SMALL
from processing.diagnosis.search.space import Acting, Space
from processing.instrument.changes import Changes
from processing.instrument.model import AppliedEffect, EffectParameter, SystematicError

#: [of the squared error of M] That the stored directions hold of what stays uncertain.
STORED_SHARE = 0.995
#: [directions] That are stored at most.
MOST_STORED = 20


def mueller_slopes(
    problem: InstrumentProblem, space: Space, values: Array, rms: Array | None = None, *, samples: Sequence[Array] = ()
) -> Iterator[tuple[NDArray[np.int64], Array, Array]]:
    """For each capture: the J values that act on it, and products (16, J, J) of the slopes of each element of M/m00.

    A common factor of M is left out. Products are means over the 15 elements, and over the pixels by their brightness.
    The last of the three has the products (S, J, J), summed over the elements, of other `samples` M/m00 (16,).
    `rms` (captures,) is what the intensities of each are known to, in units of noise (default: 1). What they do not
    tell of M, within the size of its elements, is not made wrong by an instrument either.
    """
    rms = np.ones(len(problem.captures)) if rms is None else rms
    problem, values = problem.near(space, values)
    for k, moments in enumerate(problem.moments):
        acting = space.acting(k, problem.wavelengths_nm[k])
        slopes = _SlopesOfPixels.of(problem, k, acting, values)
        blocks = moments.blocks[:: problem.folds if moments.tiles is None else 1]
        each = [slopes.products(slopes.joined(b.z), b.z, rms[k] ** 2 * b.pixels) for b in blocks]
        light = max(sum(bright for _, bright in each), 1e-300)
        own = np.sum([part for part, _ in each], axis=0) / (light * 15)
        # Another sample has the light of this one.
        level = float(np.mean(problem.captures[k].signal[..., problem.captures[k].usable]))
        others = np.zeros((len(samples), *own.shape[1:]))
        for n, sample in enumerate(samples):
            part, bright = slopes.products(*slopes.even(sample, level), 0.0)
            others[n] = part.sum(axis=0) / (bright * 15)
        yield acting.index, acting.spread_products(own), acting.spread_products(others)


@dataclass(frozen=True, eq=False)
class _SlopesOfPixels:
    """What J values do to M of the pixels of a capture.

    Attributes
    ----------
    w : (L, 16) rows of the measurement matrix in units of their noise; c : (F, L) coefficients of the features.
    dw, dc : (J, L, 16), (J, F, L) derivatives of both by the values.
    scale : (L, 1) one over the noise of each row; counts : (L,) rows that count.
    free : channels that share a level in each state, if they do.
    """

    w: Array
    c: Array
    dw: Array
    dc: Array
    scale: Array
    counts: NDArray[np.bool_]
    free: int | None

    @classmethod
    def of(cls, problem: InstrumentProblem, k: int, acting: Acting, values: Array) -> _SlopesOfPixels:
        """Of the values (K,) of a problem that are acting on its capture k."""
        space, local, moments = acting.space, acting.of(values), problem.moments[k]
        changes, columns = problem.changes(k, space, local), partial(_all_columns, problem, k)
        w, c = columns(changes), problem.coefficients(k, changes)
        dw, dc = problem.slopes(k, space, local, w, c=c, columns=columns)
        free = problem.channels(k) if problem.has_free_level(k) else None
        return cls(w, c, dw, dc, 1 / moments.sigma[:, None], moments.counts, free)

    @cached_property
    def _decomposed(self) -> tuple[Array, Array, Array]:
        return _decompose(self.w * self.counts[:, None])

    def joined(self, z: Array) -> Array:
        """Corrected counts (L, R), in units of their noise, of features (F, L, R)."""
        return np.asarray(np.einsum("fl,flr->lr", self.c, z) * self.scale)

    def even(self, sample: Array, level: float) -> tuple[Array, Array]:
        """Counts (L, 1) of an even sample M/m00 (16,), of a mean level, and their features (F, L, 1)."""
        signal = self.w @ sample[:, None] / self.scale
        signal *= level / float(np.mean(signal))
        z = np.zeros((len(FEATURES), *signal.shape))
        z[:-DERIVATIVES] = features(signal, np.zeros(1), np.zeros(1))[0]
        return signal * self.scale, z

    def products(self, y: Array, z: Array, noise: float) -> tuple[Array, float]:
        """Products (16, J, J) of the slopes of counts y (L, R) of features z (F, L, R), and the square of m00.

        `noise` : summed square of what they are known to.
        """
        u, size, vt = self._decomposed
        m00 = (vt[:, 0] / size) @ (u.T @ y)
        # The best linear estimate of elements that are as large as m00 at most.
        unknown = noise / max(float(m00 @ m00), 1e-300)
        back = (vt.T * (size / (size**2 + unknown))) @ u.T
        m = back @ y
        if self.free:
            # A reduction projects the level of each state out: a common factor of its channels moves no element.
            u, size, vt = _decompose(_without_levels(self.w * self.counts[:, None], m, self.free))
            back = (vt.T * (size / (size**2 + unknown))) @ u.T
        slopes = -np.einsum("el,klm,mr->ker", back, self.dw, m, optimize=True)
        for j in np.flatnonzero(np.any(self.dc, axis=(1, 2))):
            slopes[j] += back @ (np.einsum("fl,flr->lr", self.dc[j], z) * self.scale)
        bright = float(m[0] @ m[0])
        slopes -= (slopes[:, 0] @ m[0] / max(bright, 1e-300))[:, None, None] * m
        return np.array([each @ each.T for each in np.moveaxis(slopes, 1, 0)]), bright


def _decompose(w: Array) -> tuple[Array, Array, Array]:
    """Singular value decomposition of rows (L, 16), of what they determine."""
    u, size, vt = np.linalg.svd(w, full_matrices=False)
    keep = size > RANK * size[0]
    return u[:, keep], size[keep], vt[keep]


def _without_levels(w: Array, m: Array, channels: int) -> Array:
    """Rows (L, 16) without what a factor of each state does to the signal of Mueller matrices m (16, R)."""
    signal = (w @ np.linalg.svd(m, full_matrices=False)[0][:, 0]).reshape(-1, channels, 1)
    rows = w.reshape(*signal.shape[:2], -1)
    common = np.sum(signal * rows, axis=1, keepdims=True) / np.maximum(np.sum(signal**2, axis=1, keepdims=True), 1e-300)
    return np.asarray((rows - signal * common).reshape(w.shape))


def _all_columns(problem: InstrumentProblem, k: int, changes: Changes) -> Array:
    """Rows (L, 16) of the measurement matrix in units of their noise, whatever the sample."""
    w = problem.captures[k].matrix_of(problem.models[k], changes)
    return np.asarray(w / problem.moments[k].sigma[:, None])


@dataclass(frozen=True, eq=False)
class MuellerErrors:
    """Errors of M/m00 that the posterior expects, by one covariance for guard, error bar and report.

    What the captures do not show keeps its prior in it: an unknown sample takes up a common azimuth or a retardance.

    Attributes
    ----------
    space : candidates that may move M; values (K,), covariance (K, K) : of the posterior.
    products : (16, K, K) of the slopes of each element of M/m00, mean over elements and captures.
    of_captures : of each capture, the values that act on it and products (J, J) of their slopes.
    of_samples : (S, K, K) products of the slopes for usual samples, mean over elements and captures.
    along : distribution of a sum of the values with weights (K,), in each set of causes; None: it is normal.
    """

    space: Space
    values: Array
    covariance: Array
    products: Array
    of_captures: tuple[tuple[NDArray[np.int64], Array], ...]
    of_samples: Array
    along: Along | None = None

    @classmethod
    def of(cls, problem: InstrumentProblem, posterior: Posterior, solved: Solution) -> MuellerErrors:
        """Errors of a posterior, with slopes at its mean; `solved` gives the residual of the intensities."""
        chosen = [k for k, c in enumerate(posterior.space.candidates) if _moves_m(posterior, k, c in solved.effects)]
        space = Space(tuple(posterior.space.candidates[k] for k in chosen))
        index = posterior.space.positions(chosen)
        values, captures = posterior.values[index], len(problem.captures)
        samples = [sample.reshape(16) / sample[0, 0] for sample in SAMPLES.values()]
        products, each = np.zeros((16, index.size, index.size)), []
        of_samples = np.zeros((len(samples), index.size, index.size))
        for acting, part, others in mueller_slopes(
            problem, space, values, _residual_rms(problem, solved), samples=samples
        ):
            products[:, acting[:, None], acting] += part / captures
            of_samples[:, acting[:, None], acting] += others / captures
            each.append((acting, part.sum(axis=0)))
        along = partial(_along_some, posterior.along, index, posterior.values.size)
        return cls(space, values, posterior.covariance[np.ix_(index, index)], products, tuple(each), of_samples, along)

    def corrected_values(self, used: Solution) -> Array:
        """Values (K,) that a correction applies."""
        return self.space.vector(used.space.split(used.fit.values))

    def changes(
        self, used: Solution
    ) -> tuple[PredictedChange, tuple[PredictedChange, ...], tuple[PredictedChange, ...]]:
        """Change of M by a correction: for these captures, for later ones of each sample, and for each of these."""
        correction, products = self.corrected_values(used), self.products.sum(axis=0)
        lasts = np.flatnonzero([c.scope == "instrument" for c in self.space.candidates for _ in c.parameters])
        return (
            self.change(np.arange(correction.size), correction, products),
            tuple(self.change(lasts, correction, p[np.ix_(lasts, lasts)]) for p in (products, *self.of_samples)),
            tuple(self.change(index, correction, part) for index, part in self.of_captures),
        )

    def change(self, index: NDArray[np.int64], correction: Array, products: Array) -> PredictedChange:
        """Change by the values at an `index` (S,) of a correction (K,), with products (S, S) of the slopes of M."""
        covariance, size = self.covariance[np.ix_(index, index)], self.values.size
        along = None if self.along is None else partial(_along_some, self.along, index, size)
        return predicted_change(correction[index], self.values[index], covariance, products, along=along)

    def uncertain(
        self, problem: InstrumentProblem, used: Solution, *, lasting: bool
    ) -> tuple[SystematicError, MuellerError] | None:
        """Remaining uncertainty of M/m00 about the applied values, as a file stores it and as the answer reports it.

        None where nothing does. The effects of a correction that is not `lasting` are uncertain as a whole in later
        captures, which it does not correct.
        """
        missed = self.values - self.corrected_values(used)
        covariance = self.covariance + np.outer(missed, missed)
        of_elements = np.sum(covariance * self.products, axis=(1, 2)) * 15
        # That of M/m00 is one, whatever m00 is.
        of_elements[0] = 0.0
        if of_elements.sum() <= 0:
            return None
        largest, products = self.products[int(np.argmax(of_elements))], self.products.sum(axis=0)
        lasts = np.array([c.capture is None for c in self.space.candidates for _ in c.parameters])
        size, directions = leading_directions(covariance, products, lasts)
        enough = int(np.searchsorted(np.cumsum(size), STORED_SHARE * size.sum())) + 1
        names = tuple(c.name for c in problem.captures)
        several = len(set(problem.wavelengths_nm)) > 1
        slopes = np.sqrt(np.maximum(np.diag(products), 0.0))
        rms = float(np.sqrt(of_elements.sum() / 15))
        effects_of = partial(_effects_of, self.space, slopes, names)
        stored = [effects_of(d) for d in directions.T[: min(enough, MOST_STORED)]]
        is_effect = np.array([c in used.effects for c in self.space.candidates for _ in c.parameters])
        not_applied = np.where(lasts & is_effect, self.corrected_values(used), 0.0)
        if not lasting and not_applied.any():
            # It holds in later captures: in these the same effects with the other sign cancel it.
            here = (e.model_copy(update={"scope": "capture", "captures": names}) for e in effects_of(-not_applied))
            stored.insert(0, (*effects_of(not_applied), *here))
        error = SystematicError(
            directions=tuple(stored),
            rms_over_m00=rms,
            wavelength_nm=None if several else problem.wavelengths_nm[0],
        )
        alone = [float(np.sum((covariance * largest)[p, p])) for p in self.space.slices]
        most = self.space.candidates[int(np.argmax(alone))].short
        elements = tuple(map(float, np.sqrt(np.maximum(of_elements, 0.0))))
        return error, MuellerError(elements=elements, rms=rms, most=most)


def _along_some(along: Along, index: NDArray[np.int64], size: int, weights: Array) -> tuple[Array, Array, Array]:
    """`along` of a sum of some values, at an `index` (J,) among `size`, with weights (J,)."""
    of_all = np.zeros(size)
    of_all[index] = weights
    return along(of_all)


def _residual_rms(problem: InstrumentProblem, solved: Solution) -> Array:
    """Rms residual (captures,) after the correction, in units of the noise of each; at least 1."""
    noise = np.array([m.noise_floor for m in problem.moments])
    rms = np.array([solved.after.of(k).rms for k in range(noise.size)])
    return np.asarray(np.maximum(rms / np.maximum(noise, 1e-300), 1.0))


def leading_directions(covariance: Array, products: Array, lasts: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Independent directions (K, K) of one standard deviation, the largest first, and their size (K,).

    What matters is the error of M of these captures and, as much, of any other capture: there only what `lasts` (K,)
    is wrong still. Forty values of a source in each capture would else leave no room for it.
    """
    weight = np.zeros_like(products)
    for part in (products, products * np.outer(lasts, lasts)):
        weight += part / max(float(np.sum(covariance * part)), 1e-300)
    value, vector = np.linalg.eigh(covariance)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    size, turn = np.linalg.eigh(root.T @ weight @ root)
    return np.maximum(size[::-1], 0.0), (root @ turn)[:, ::-1]


def _moves_m(posterior: Posterior, k: int, applied: bool) -> bool:
    """Whether a candidate may make M wrong by values that do not differ over the image."""
    candidate = posterior.space.candidates[k]
    # Levels of a source are projected out by each reduction, which carries their errors itself.
    if candidate.effect.varies_over_image or candidate.effect.is_switch or candidate.effect.is_projected:
        return False
    spread = np.diag(posterior.covariance)[posterior.space.slices[k]]
    if applied or not candidate.state_chosen:
        return applied or bool(spread.any())
    group = next(g for g, members in enumerate(posterior.members) if k in members)
    return bool(posterior.samples.takes_part[group])


def _effects_of(space: Space, slopes: Array, names: tuple[str, ...], direction: Array) -> tuple[AppliedEffect, ...]:
    """Effects of a direction (K,), without those that M hardly notices, in the captures of these names."""
    effects, size = [], slopes * np.abs(direction)
    for candidate, part in space.pairs:
        if size[part].max() <= SMALL * size.max():
            continue
        step, captures = direction[part], names if candidate.capture is None else (names[candidate.capture],)
        for single, values, _ in candidate.by_wavelength(step, np.zeros((step.size, step.size))):
            effects.append(
                AppliedEffect(
                    kind=single.kind,
                    element=single.place or None,
                    parameters=_values_alone(single.stored(values, values)),
                    captures=() if single.scope == "instrument" else captures,
                    scope=single.scope,
                    wavelength_nm=single.wavelength_nm,
                )
            )
    return tuple(effects)


def _values_alone(parameters: dict[str, EffectParameter]) -> dict[str, EffectParameter]:
    """Nobody reads their units, nor more than six of their digits."""

    def rounded(value: float) -> float:
        return float(f"{value:.6g}")

    return {
        name: EffectParameter(
            value=tuple(map(rounded, p.value)) if isinstance(p.value, tuple) else rounded(p.value), unit=""
        )
        for name, p in parameters.items()
    }


def chance_later(later: Sequence[PredictedChange]) -> float:
    """Chance that the error of M grows in later captures, of samples that the correction changes: a mean over them.

    What a sample does not show of a correction makes nothing worse there, and may in another one.
    """
    return float(np.mean([c.chance_worse for c in later if c.is_change] or [0.0]))


def chances(
    now: PredictedChange, later: Sequence[PredictedChange], lasting: bool, each: Mapping[str, PredictedChange]
) -> tuple[Check, ...]:
    """Error of M as the posterior expects it, and the chance that it grows: an explanation may be too vague to use.

    Of all captures together it decides. Of `each` of several it is told: a sample that hardly polarizes gains little
    and may lose. What is too vague for later captures is written for these alone (`lasts`).
    """
    predicted, grows = chance_checks("M/m00", now)
    words = {
        name: f"{c.rounded_chance:.2g}" if c.rounded_chance > 0 else "less than 0.0001" for name, c in each.items()
    }
    alone = "" if lasting else ", so it is written for these captures alone"
    return (
        predicted,
        grows,
        Check(
            name=f"{grows.name} in later captures{alone}", before=0.0, after=round(chance_later(later), 4), holds=True
        ),
        *(
            Check(
                name=f"predicted error of M/m00 of {name}, rms (it grows with a chance of {words[name]})",
                before=change.before,
                after=change.after,
                holds=True,
            )
            for name, change in each.items()
        ),
    )


def lasts(later: Sequence[PredictedChange], solved: Solution, changed: Collection[int] = ()) -> bool:
    """Whether what belongs to the instrument may be used for later captures.

    Of captures whose sample `changed` it may be a part of that: the others have to bear it out.
    """
    others = [k for k in range(len(solved.after.shares)) if k not in changed]
    gain = sum(solved.before.of(k).excess - solved.after.of(k).excess for k in others)
    return chance_later(later) <= CHANCE_WORSE and (not changed or gain > 0)
