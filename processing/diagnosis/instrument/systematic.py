"""What stays uncertain after a correction, as a Mueller matrix notices it: the covariance of all values, in directions.

Directions that an unknown sample absorbs (a common azimuth, a retardance) keep the variance of their prior. They are
not applied, and show up here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.instrument.mueller_slopes import mueller_slopes
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.rules import TAKES_PART, UNSEEN
from processing.diagnosis.search.space import Space
from processing.diagnosis.search.stored import by_wavelength, parameters_of, scope_of
from processing.instrument.effects.base import FieldEffect, Switch
from processing.instrument.model import AppliedEffect, EffectParameter, SystematicError

#: Share of the squared error of M that the stored directions hold, and how many they are at most.
SHARE, MOST = 0.995, 20
#: Part of the largest effect in a direction below which another one in it is left out.
SMALL = 0.03
#: Elements of M/m00 that can be wrong.
ELEMENTS = 15


def systematic_error(problem: InstrumentProblem, found: Posterior) -> SystematicError | None:
    """The covariance of the posterior as directions of one standard deviation; None where nothing is uncertain."""
    chosen = [k for k, c in enumerate(found.space.candidates) if _takes_part(found, k)]
    space = Space(tuple(found.space.candidates[k] for k in chosen))
    if not space.size:
        return None
    index = np.concatenate([np.r_[found.space.slices[k]] for k in chosen])
    products, light = mueller_slopes(problem, space, found.values[index])
    covariance = (found.covariance + _unseen(found))[np.ix_(index, index)]
    total = float(np.sum(covariance * products))
    if total <= 0 or light <= 0:
        return None
    lasts = np.array([c.capture is None for c in space.candidates for _ in c.parameters])
    size, directions = _leading(covariance, products, lasts)
    enough = int(np.searchsorted(np.cumsum(size), SHARE * size.sum())) + 1
    names = tuple(c.name for c in problem.captures)
    told = []
    for direction in directions.T[: min(enough, MOST)]:
        weight = np.abs(direction) * np.sqrt(np.maximum(np.diag(products), 0.0))
        told.append(_as_effects(space, direction, weight > SMALL * weight.max(), names))
    return SystematicError(
        directions=tuple(told),
        rms_over_m00=float(np.sqrt(total / light / ELEMENTS)),
        wavelength_nm=problem.wavelengths_nm[0] if len(set(problem.wavelengths_nm)) == 1 else None,
    )


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
        chance = 1 / (1 + (1 - UNSEEN) / UNSEEN * np.exp(-np.clip(gain, -50, 50)))
        scale = typical[group.index]
        out[np.ix_(group.index, group.index)] += chance * own * np.outer(scale, scale)
    return out


def _takes_part(found: Posterior, k: int) -> bool:
    candidate = found.space.candidates[k]
    if isinstance(candidate.effect, FieldEffect | Switch):
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
                    parameters=_without_errors(parameters_of(one, values, values)),
                    captures=names if one.capture is None else (names[one.capture],),
                    scope=scope_of(one),
                    wavelength_nm=one.wavelength_nm,
                )
            )
    return tuple(effects)


def _without_errors(parameters: dict[str, EffectParameter]) -> dict[str, EffectParameter]:
    return {name: p.model_copy(update={"stderr": None}) for name, p in parameters.items()}
