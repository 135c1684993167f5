"""Combinations of values that the data determine where they do not determine each value by itself."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from processing.arrays import Array
from processing.diagnosis.search.posterior import Posterior
from processing.diagnosis.search.result import Combination
from processing.diagnosis.search.rules import OPEN, TOGETHER
from processing.diagnosis.search.solution import Solution
from processing.instrument.effects.base import ValuePerState


@dataclass(frozen=True)
class Tie:
    """Values `index` (n,) of which weights @ values is determined to `stderr`; `open_by` (n,) is one standard deviation
    of the direction that is determined least. The largest weight is one."""

    index: NDArray[np.int64]
    weights: Array
    value: float
    stderr: float
    open_by: Array


def ties(values: Array, covariance: Array, typical: Array) -> Iterator[Tie]:
    """Groups of values (K,) that are known together much better than each by itself, of their covariance (K, K)."""
    error = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    alike = np.abs(covariance / np.outer(error, error)) > TOGETHER
    count, group = connected_components(alike, directed=False)
    for k in range(count):
        index = np.flatnonzero(group == k)
        if index.size < 2:
            continue
        size, vector = np.linalg.eigh(covariance[np.ix_(index, index)] / np.outer(typical[index], typical[index]))
        if size[-1] < OPEN**2 * max(size[0], 0.0):
            continue
        weights = vector[:, 0] / typical[index]
        weights = weights / weights[np.argmax(np.abs(weights * error[index]))]
        variance = weights @ covariance[np.ix_(index, index)] @ weights
        yield Tie(
            index,
            weights,
            float(weights @ values[index]),
            float(np.sqrt(max(variance, 0.0))),
            vector[:, -1] * np.sqrt(size[-1]) * typical[index],
        )


def combinations(found: Posterior, solved: Solution) -> tuple[Combination, ...]:
    """Of the values of a correction, those that are only known together."""
    effects = set(solved.effects)
    at: list[int] = []
    names: list[str] = []
    units: list[str] = []
    for candidate, part in zip(found.space.candidates, found.space.slices, strict=True):
        if candidate in effects and not isinstance(candidate.effect, ValuePerState):
            at += range(part.start, part.stop)
            single = candidate.size == 1
            names += [candidate.label if single else f"{candidate.label} {p.name}" for p in candidate.parameters]
            units += [p.unit for p in candidate.parameters]
    typical = found.space.joined("typical")[at]
    told = []
    for tie in ties(found.values[at], found.covariance[np.ix_(at, at)], typical):
        first = int(tie.index[np.argmin(np.abs(tie.weights - 1))])
        told.append(
            Combination(
                weights={names[i]: float(w) for i, w in zip(tie.index, tie.weights, strict=True)},
                value=tie.value,
                stderr=tie.stderr,
                unit=units[first],
                open_by={names[i]: float(v) for i, v in zip(tie.index, tie.open_by, strict=True)},
            )
        )
    return tuple(told)
