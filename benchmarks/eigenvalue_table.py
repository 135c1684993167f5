"""Bounds of eigenvalues and singular values of noisy 3 x 3 matrices: `processing/polarization/eigenvalue_table.npz`.

    python benchmarks/eigenvalue_table.py

takes ten minutes. `processing.polarization.sorted_eigenvalues` says what the table holds and in which units.
"""

import functools
import itertools
from collections.abc import Sequence

import numpy as np
from scipy import optimize
from scipy.special import ndtr

from processing.polarization.sorted_eigenvalues import COMPONENTS, GAPS, LEAST_OWN, OF_MEAN, SUMS, TABLE

#: True gaps at which a bound shall hold as often as it claims, and draws at each.
TRUE = (0, 0.7, 1.4, 2.2, 3, 4, 5.5, 8, 12, 20)
DRAWS, ROUNDS, LARGEST_STEP = 8000, 30, 0.4
#: Deviates of the bounds of the largest (0) and of the middle eigenvalue (1), and how smooth they are.
BOUNDS = tuple(
    (k, d, 3e-4 if abs(d) == 1 else 1e-4) for k, d in ((0, -1), (0, 1), (0, -1.96), (0, 1.96), (1, -1), (1, -1.96))
)
#: The same of singular values: the largest, the middle and the smallest one, which carries the sign of the determinant
#: and has lower bounds only: its upper ones are those of the matrix with the opposite sign.
TRUE_SINGULAR = (0, 0.8, 1.8, 3.2, 5.5, 10)
BOUNDS_SINGULAR = tuple(
    (k, d, 3e-5 if abs(d) == 1 else 1e-5) for k in (0, 1, 2) for d in (-1, 1, -1.96, 1.96) if k < 2 or d < 0
)
#: Draws at each, and how far their steps of coverage are smoothed.
DRAWS_SINGULAR, SPREAD = 1200, 0.1


def fall_of(directions: float, number: int) -> float:
    """Factor from one of a `number` of variances to the next, whose noise acts in so many directions."""
    if directions > number - 1e-3:
        return 1.0
    steps = np.arange(number)
    return float(optimize.brentq(lambda r: np.sum(r**steps) ** 2 / np.sum(r ** (2 * steps)) - directions, 1e-6, 1))


def blocks(components: float, random: np.random.Generator, draws: int = DRAWS, numbers: int = 8) -> np.ndarray:
    """Projection of independent noise in 15 directions on the 8 of a block of three eigenvalues: (draws, 8, 15).

    Of a block of three singular values the `numbers` are 9.
    """
    directions = np.linalg.qr(random.normal(size=(draws, 15, numbers)))[0]
    fall = fall_of(1 / (1 / 15 + 16 / 15 * (1 / components - 1 / 8)), 15)
    into = np.swapaxes(directions, 1, 2) * fall ** (np.arange(15) / 2)
    return np.asarray(into / np.sqrt(np.square(into).sum(axis=(1, 2), keepdims=True) / numbers))


def products(components: float, random: np.random.Generator, draws: int) -> np.ndarray:
    """Likewise (draws, 9, 15), with outer products for directions, as those of analyzers and generators are.

    Random directions are nearly of rank 2: the mean largest of their singular values is 0.87, that of six of seven
    instruments 0.84 to 0.99.
    """
    scale = fall_of(np.sqrt(1 / (1 / 9 + 64 / 63 * (1 / components - 1 / 8))), 3) ** (np.arange(3) / 2)
    sides = [np.linalg.qr(random.normal(size=(draws, 3, 3)))[0] * scale for _ in range(2)]
    into = np.einsum("dip,djq->dijpq", *sides).reshape(draws, 9, 9)
    into /= np.sqrt(np.square(into).sum(axis=(1, 2), keepdims=True) / 9)
    return np.pad(into, ((0, 0), (0, 0), (0, 6)))


def basis() -> np.ndarray:
    """Traceless Hermitian matrices (8, 3, 3), orthonormal under tr(A B)."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    out = np.zeros((8, 3, 3), complex)
    for k, (i, j) in enumerate(pairs):
        out[k, i, j] = out[k, j, i] = 1 / np.sqrt(2)
        out[3 + k, i, j], out[3 + k, j, i] = -1j / np.sqrt(2), 1j / np.sqrt(2)
    out[6], out[7] = np.diag([1, -1, 0]) / np.sqrt(2), np.diag([1, 1, -2]) / np.sqrt(6)
    return out


def eigenvalues(
    first: float, second: float, random: np.random.Generator, into: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Observed deviations from the mean (draws, 3) of these true gaps, and their errors to first order, over sqrt(2/3).

    The noise `into` (draws, 8, 15) has variance 1 of an element on average over its directions.
    """
    noise = np.einsum("dai,di,ajk->djk", into, random.normal(size=into.shape[::2]), basis(), optimize=True)
    values, vectors = np.linalg.eigh(noise + np.diag([first + second, second, 0.0]))
    values, vectors = values[:, ::-1], vectors[:, :, ::-1]
    slopes = np.einsum("djk,ajl,dlk->dka", vectors.conj(), basis(), vectors, optimize=True).real
    errors = np.sqrt(1.5 * np.square(slopes @ into).sum(axis=-1))
    return values - values.mean(axis=1, keepdims=True), np.maximum(errors, LEAST_OWN)


def deviations(first: float, second: float) -> np.ndarray:
    """True deviations (3,) from the mean."""
    true = np.array([first + second, second, 0.0])
    return np.asarray(true - true.mean())


def singular_values(true: np.ndarray, random: np.random.Generator, into: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Observed singular values (draws, 3) of diag(true), descending, the last with sign, and errors to first order.

    The noise `into` (draws, 9, 15) has variance 1 of an element on average over its directions.
    """
    noise = np.einsum("dai,di->da", into, random.normal(size=into.shape[::2]), optimize=True).reshape(-1, 3, 3)
    left, found, right = np.linalg.svd(np.diag(true) + noise)
    found[:, 2] *= np.sign(np.linalg.det(left) * np.linalg.det(right))
    slopes = np.einsum("djk,dkl->dkjl", left, right).reshape(-1, 3, 9)
    return found, np.maximum(np.sqrt(np.square(slopes @ into).sum(axis=-1)), LEAST_OWN)


def weights(gaps: Sequence[np.ndarray], nodes: np.ndarray) -> np.ndarray:
    """Weights (draws, nodes) of linear interpolation between the nodes of the table."""
    out = np.ones((len(gaps[0]), 1))
    for gap in gaps:
        hats = np.stack([np.interp(gap, nodes, hat) for hat in np.eye(len(nodes))], axis=1)
        out = (out[:, :, None] * hats[:, None, :]).reshape(len(gap), -1)
    return out


def bound(
    deviate: float,
    smooth: float,
    drawn: Sequence[tuple[np.ndarray, np.ndarray]],
    *,
    nodes: tuple[int, ...],
    spread: float,
) -> np.ndarray:
    """Shifts (nodes) with which the bound is above the truth as often as it claims.

    Parameters
    ----------
    drawn : at each truth how far the observed value is off (draws,), and what the shifts do to it (draws, nodes).
    spread : of further noise.
    """
    count, level = int(np.prod(nodes)), ndtr(deviate)
    rough = []
    for axis in range(len(nodes)):
        parts = [np.diff(np.eye(n), axis=0) if k == axis else np.eye(n) for k, n in enumerate(nodes)]
        rough.append(functools.reduce(np.kron, parts))
    all_rough = np.concatenate(rough)
    penalty, shift = smooth * all_rough.T @ all_rough, np.full(count, deviate)
    for _ in range(ROUNDS):
        misses, slopes = [], []
        for off, between in drawn:
            z = (off + between @ shift) / spread
            misses.append(ndtr(z).mean() - level)
            slopes.append(np.exp(-(z**2) / 2) @ between / len(z) / np.sqrt(2 * np.pi) / spread)
        slope = np.array(slopes)
        right = slope.T @ np.array(misses) + penalty @ shift
        step = np.linalg.solve(slope.T @ slope + penalty + 1e-9 * np.eye(count), right)
        shift = shift - np.clip(step, -LARGEST_STEP, LARGEST_STEP)
    return np.asarray(shift.reshape(nodes))


def of_eigenvalues(random: np.random.Generator) -> np.ndarray:
    """Shifts (components, bounds, nodes, nodes)."""
    shifts = []
    for components in COMPONENTS:
        into, drawn = blocks(components, random), []
        for gaps in itertools.product(TRUE, TRUE):
            observed, errors = eigenvalues(*gaps, random, into)
            drawn.append((observed - deviations(*gaps), errors, weights(-np.diff(observed.T, axis=0), GAPS)))
        size = (len(GAPS), len(GAPS))
        shifts.append([bound(d, smooth, _of(k, drawn), nodes=size, spread=np.sqrt(OF_MEAN)) for k, d, smooth in BOUNDS])
        print(components)
    return np.array(shifts, dtype=np.float32)


def _of(k: int, drawn: Sequence[tuple[np.ndarray, ...]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """What `bound` needs of how far value k is off, of its error to first order and of the weights of the nodes."""
    return [(off[:, k], errors[:, k : k + 1] * plain) for off, errors, plain in drawn]


def of_singular_values(random: np.random.Generator) -> np.ndarray:
    """Shifts (components, bounds, nodes, nodes, nodes)."""
    shifts = []
    for components in COMPONENTS:
        half, drawn = DRAWS_SINGULAR // 2, []
        into = np.concatenate([blocks(components, random, half, 9), products(components, random, half)])
        for first, less, plus in itertools.product(TRUE_SINGULAR, repeat=3):
            true = np.array([first + (plus + less) / 2, (plus + less) / 2, (plus - less) / 2])
            observed, errors = singular_values(true, random, into)
            gaps = (observed[:, 0] - observed[:, 1], observed[:, 1] - observed[:, 2], observed[:, 1] + observed[:, 2])
            drawn.append((observed - true, errors, weights(gaps, SUMS)))
        shifts.append(
            [bound(d, smooth, _of(k, drawn), nodes=3 * (len(SUMS),), spread=SPREAD) for k, d, smooth in BOUNDS_SINGULAR]
        )
        print(components, flush=True)
    return far_apart(np.array(shifts, dtype=np.float32))


def far_apart(shifts: np.ndarray) -> np.ndarray:
    """Errors to first order at the last nodes, where a singular value is far from those next to it."""
    last = ((-1,), (-1, -1, -1), (..., -1, -1))
    for number, (k, deviate, _) in enumerate(BOUNDS_SINGULAR):
        shifts[(slice(None), number, *last[k])] = deviate
    return shifts


if __name__ == "__main__":
    made = {"shifts": of_eigenvalues, "singular": of_singular_values}
    np.savez_compressed(TABLE, **{name: of(np.random.default_rng(2026)) for name, of in made.items()})
