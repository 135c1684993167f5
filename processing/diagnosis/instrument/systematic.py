"""How wrong a Mueller matrix may be still: the values of all effects about those that are applied, in directions.

Directions that an unknown sample absorbs (a common azimuth, a retardance) keep the variance of their prior. They are
not applied, and show up here; so does what was found and is not used.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.mueller_slopes import mueller_slopes
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.candidate import Candidate, SourceLevel
from processing.diagnosis.search.odds import MOST_ODDS
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import MOST_STORED, SMALL_PART, STORED_SHARE, TAKES_PART, UNSEEN
from processing.diagnosis.search.solution import Solution
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import by_wavelength, parameters_of, scope_of
from processing.instrument.effects.base import FieldEffect, Switch
from processing.instrument.model import AppliedEffect, EffectParameter, SystematicError

#: [elements, fixed] Of M/m00 that can be wrong.
ELEMENTS = 15


@dataclass(frozen=True)
class Uncertain:
    """What stays uncertain of M/m00.

    Attributes
    ----------
    error : as an instrument file stores it.
    of_elements : (4, 4) standard errors of the elements of M/m00, rms over the pixels of these captures.
    most : the candidate that the largest of them owes most to.
    """

    error: SystematicError
    of_elements: Array
    most: Candidate


def systematic_error(problem: InstrumentProblem, found: Posterior, used: Solution) -> Uncertain | None:
    """Second moments of all values about those `used`, in directions of one standard deviation; None without any."""
    chosen = [k for k, c in enumerate(found.space.candidates) if _takes_part(found, k)]
    space = Space(tuple(found.space.candidates[k] for k in chosen))
    if not space.size:
        return None
    index = np.concatenate([np.r_[found.space.slices[k]] for k in chosen])
    products, light = mueller_slopes(problem, space, found.values[index])
    missed = _missed(found, used)
    covariance = (found.covariance + _unseen(found) + np.outer(missed, missed))[np.ix_(index, index)]
    of_elements = np.sum(covariance * products, axis=(1, 2))
    # That of M/m00 is one, whatever m00 is.
    of_elements[0] = 0.0
    if of_elements.sum() <= 0 or light <= 0:
        return None
    largest = products[int(np.argmax(of_elements))]
    products = products.sum(axis=0)
    lasts = np.array([c.capture is None for c in space.candidates for _ in c.parameters])
    size, directions = _leading(covariance, products, lasts)
    enough = int(np.searchsorted(np.cumsum(size), STORED_SHARE * size.sum())) + 1
    names = tuple(c.name for c in problem.captures)
    told = []
    for direction in directions.T[: min(enough, MOST_STORED)]:
        weight = np.abs(direction) * np.sqrt(np.maximum(np.diag(products), 0.0))
        told.append(_as_effects(space, direction, weight > SMALL_PART * weight.max(), names))
    error = SystematicError(
        directions=tuple(told),
        rms_over_m00=float(np.sqrt(of_elements.sum() / light / ELEMENTS)),
        wavelength_nm=problem.wavelengths_nm[0] if len(set(problem.wavelengths_nm)) == 1 else None,
    )
    alone = [float(np.sum((covariance * largest)[p, p])) for p in space.slices]
    return Uncertain(
        error,
        np.sqrt(np.maximum(of_elements, 0.0) / light).reshape(4, 4),
        space.candidates[int(np.argmax(alone))],
    )


def _missed(found: Posterior, used: Solution) -> Array:
    """By how much the mean of the posterior differs from what is applied (K,)."""
    missed = found.values.copy()
    part = dict(zip(found.space.candidates, found.space.slices, strict=True))
    for candidate, values in zip(used.space.candidates, used.space.slices, strict=True):
        missed[part[candidate]] -= used.fit.values[values]
    return missed


def _leading(covariance: Array, products: Array, lasts: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Independent directions (K, K) of one standard deviation, the largest first, and their size (K,).

    What matters is the error of M of these captures and, as much, of any other capture: there only what `lasts` (K,)
    is wrong still. Forty values of a source in each capture would else leave no room for it.
    """
    wanted = np.zeros_like(products)
    for part in (products, products * np.outer(lasts, lasts)):
        wanted += part / max(float(np.sum(covariance * part)), 1e-300)
    value, vector = np.linalg.eigh(covariance)
    root = vector * np.sqrt(np.maximum(value, 0.0))
    size, turn = np.linalg.eigh(root.T @ wanted @ root)
    return np.maximum(size[::-1], 0.0), (root @ turn)[:, ::-1]


def _unseen(found: Posterior) -> Array:
    """Variance (K, K) of groups that are in no correction: what their prior leaves, in the units of the parameters."""
    typical = found.space.joined("typical")
    out = np.zeros((typical.size, typical.size))
    for k, (s, q) in found.sets.given_others(found.samples.best).items():
        group = found.sets.groups[k]
        if found.samples.probability[k] > TAKES_PART or group.share > 1:
            continue
        own = np.linalg.inv(s + np.eye(q.size))
        # Evidence for the group at its typical size, against none.
        gain = 0.5 * float(q @ own @ q - np.linalg.slogdet(np.eye(q.size) + s)[1])
        chance = 1 / (1 + (1 - UNSEEN) / UNSEEN * np.exp(group.price - np.clip(gain, -MOST_ODDS, MOST_ODDS)))
        scale = typical[group.index]
        out[np.ix_(group.index, group.index)] += chance * own * np.outer(scale, scale)
    return out


def _takes_part(found: Posterior, k: int) -> bool:
    candidate = found.space.candidates[k]
    # Levels of a source are projected out by each reduction, which carries their errors itself.
    if isinstance(candidate.effect, FieldEffect | Switch | SourceLevel):
        return False
    if not candidate.state_chosen:
        return True
    group = next(g for g, members in enumerate(found.members) if k in members)
    return bool(found.samples.probability[group] > TAKES_PART)


def _as_effects(space: Space, direction: Array, matters: Array, names: tuple[str, ...]) -> tuple[AppliedEffect, ...]:
    effects = []
    for candidate, part in zip(space.candidates, space.slices, strict=True):
        if not matters[part].any():
            continue
        own = direction[part]
        for one, values, _ in by_wavelength(candidate, own, np.zeros((own.size, own.size))):
            effects.append(
                AppliedEffect(
                    kind=one.kind,
                    element=one.place or None,
                    parameters=_values_alone(parameters_of(one, values, values)),
                    captures=() if scope_of(one) == "instrument" else _captures(one, names),
                    scope=scope_of(one),
                    wavelength_nm=one.wavelength_nm,
                )
            )
    return tuple(effects)


def _captures(candidate: Candidate, names: tuple[str, ...]) -> tuple[str, ...]:
    return names if candidate.capture is None else (names[candidate.capture],)


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
