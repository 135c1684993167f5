"""Intervals of the dominant process m0: its elements, its diattenuation and polarizance, and their orientations.

An element a of m0 is a cosine. Where noise has turned the process its variance v is not that at the truth: at z errors
it is too small by the factor 1 + z^2 v / (1 - a^2). The second order of the noise is z times a shift of z errors.
Near 1 a diattenuation D has a bound that noise does not pass, and sqrt(1 - D^2) is the length of a vector.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, RealArray
from processing.maps.intervals import SEEN, Planes, put, set_angle
from processing.maps.ranges import ANGLES_OF
from processing.polarization.cloude import xi0_and_dominant
from processing.polarization.length_kernels import DEVIATES
from processing.polarization.magnitude import Interval, interval
from processing.polarization.propagation import Derived
from processing.polarization.vector_noise import VectorNoise, of_slopes

MATRIX = "dominant_mueller_jones"
#: Linear diattenuation as far from 1 as from 0, in units of its noise: above, its interval is that of sqrt(1 - D^2).
LONG = np.sqrt(0.5)


def set_dominant(
    planes: Planes, derived: Mapping[str, Derived], m: Array, covariance: RealArray, *, seen: Array
) -> None:
    """Replace values, errors and bounds of all maps of m0; every process is in them where it is not determined.

    Parameters
    ----------
    m : (..., 4, 4), the matrices of which `derived` is, with this covariance (..., 16, 16).
    seen : (...), gap of the first two eigenvalues over the noise between them; determined above `SEEN`.
    """
    turn = 2 / np.square(np.maximum(seen, SEEN))
    matrix = derived[MATRIX]
    variance = np.square(planes[f"{MATRIX}_errors"].astype(float))
    bend = _second_order(m, matrix, covariance, variance)
    planes[f"{MATRIX}_errors"] = np.sqrt(_variance(variance, matrix.value, bend, 1.0)).astype(np.float32)
    for name, row in (("dominant_diattenuation", True), ("dominant_polarizance", False)):
        elements: tuple[Any, ...] = (0, slice(1, None)) if row else (slice(1, None), 0)
        _set_linear(planes, derived, f"{name}_linear", covariance, elements=elements, bend=bend[elements], turn=turn)
        name = f"{name}_circular"
        value, square = planes[name].astype(float), np.square(planes[f"{name}_errors"].astype(float))
        half, far = (z * np.sqrt(_variance(square, value, bend[elements][2], z)) for z in DEVIATES)
        put(planes, name, value, half, value - far, value + far)
    if not (seen > SEEN).all():
        _open(planes, derived, seen > SEEN)


def _variance(variance: Array, value: RealArray, bend: Array, deviate: float) -> Array:
    """Variance of elements of m0 for an interval of so many errors."""
    turned = 1 - np.square(value, dtype=float)
    np.divide(variance, np.maximum(turned, 1e-12, out=turned), out=turned)
    turned *= deviate**2
    turned += 1
    turned *= variance
    return np.asarray(turned + np.square(deviate * bend))


def _second_order(m: Array, matrix: Derived, covariance: RealArray, variance: Array) -> Array:
    """Second order (4, 4, ...) of m0 along one standard error of the element that noise moves most."""
    pixels = np.arange(variance[0, 0].size)
    slope = np.asarray(matrix.gradient).reshape(16, -1, 16)[variance.reshape(16, -1).argmax(axis=0), pixels]
    slope = np.ascontiguousarray(slope.T, dtype=np.float32)
    # As covariances of an image lie in memory.
    moved = np.einsum("ijp,jp->ip", np.moveaxis(covariance.reshape(-1, 16, 16), 0, -1), slope)
    step = (moved / np.sqrt(np.einsum("ip,ip->p", moved, slope))).reshape(4, 4, *m.shape[:-2])
    step = np.moveaxis(step, (0, 1), (-2, -1))
    ends = [np.moveaxis(xi0_and_dominant(m + side * step)[1], (-2, -1), (0, 1)) for side in (-1, 1)]
    return np.asarray((ends[0] + ends[1]) / 2 - matrix.value)


def _set_linear(
    planes: Planes,
    derived: Mapping[str, Derived],
    name: str,
    covariance: RealArray,
    *,
    elements: tuple[Any, ...],
    bend: Array,
    turn: Array,
) -> None:
    quantity = derived[name]
    assert quantity.parts is not None
    vector: Array = np.asarray(quantity.parts.value, dtype=float)
    length: Array = np.asarray(quantity.value, dtype=float)
    noise = of_slopes(covariance, vector, quantity.parts.gradient)
    along = (bend[:2] * vector / length).sum(axis=0)
    found = np.stack(
        _interval(length, noise, *(_variance(noise.along, length, along, z) / noise.along for z in DEVIATES))
    )
    is_long = length > LONG
    if is_long.any():
        from_one = _from_one(derived[MATRIX], covariance, elements=elements, length=length.reshape(-1))
        np.copyto(found, from_one.reshape(found.shape), where=is_long)
    put(planes, name, *found)
    # What turns an orientation is not in its own variance: with that 95 % intervals covered 91 %.
    of_68, of_95 = (1 + z**2 * turn for z in DEVIATES)
    for angle in ANGLES_OF[name]:
        set_angle(planes, angle, vector, of_95 * noise.packed[[0, 1, 3]], of_68=np.sqrt(of_68 / of_95))


def _interval(length: Array, noise: VectorNoise, by: Array, by_95: Array) -> Interval:
    moments = by * noise.along, by * noise.total, by**2 * noise.square
    plane = by**2 * noise.mixed, by * noise.across, by**2 * noise.further
    return interval(length, *moments, plane=plane, far=by_95 / by)


def _from_one(matrix: Derived, covariance: RealArray, *, elements: tuple[Any, ...], length: Array) -> Array:
    """Interval (4, n) of linear diattenuations D near 1, by that of sqrt(1 - D^2).

    The latter is the length of the part of m0 across its diattenuation and polarizance, over sqrt(2), and of the
    circular component.
    """
    m0, slopes = (np.asarray(each).reshape(16, len(length), -1) for each in (matrix.value, matrix.gradient))
    m0 = m0[..., 0].reshape(4, 4, -1)
    left, right = (_across_of(v / np.sqrt(np.square(v).sum(axis=0))) for v in (m0[1:, 0], m0[0, 1:]))
    weights = np.zeros((len(length), 5, 4, 4))
    weights[:, :4, 1:, 1:] = np.einsum("ijp,lkp->piljk", left, right).reshape(-1, 4, 3, 3) / np.sqrt(2)
    weights[(..., 4, *(3 if isinstance(e, slice) else e for e in elements))] = 1
    by = weights.reshape(-1, 5, 16)
    vector = np.einsum("pnk,kp->np", by, m0.reshape(16, -1))
    noise = of_slopes(covariance, vector, np.moveaxis(by @ np.moveaxis(slopes, 0, 1), 1, 0))
    found = _interval(
        np.sqrt(np.maximum(1 - np.square(length), 0)), noise, *(1 + np.square(z) * noise.along for z in DEVIATES)
    )
    ends = np.stack([found.value + found.error, found.value - found.error, found.high, found.low])
    low, high, low_95, high_95 = np.sqrt(1 - np.square(np.clip(ends, 0, 1)))
    return np.stack([(low + high) / 2, (high - low) / 2, low_95, high_95])


def _across_of(vector: RealArray) -> Array:
    """Two unit vectors (2, 3, n) across each other and across unit vectors (3, n)."""
    x, y, z = vector
    sign = np.copysign(1.0, z)
    by = -1 / (sign + z)
    return np.array([[1 + sign * by * x**2, sign * by * x * y, -sign * x], [by * x * y, sign + by * y**2, -y]])


def _open(planes: Planes, derived: Mapping[str, Derived], is_determined: NDArray[np.bool_]) -> None:
    for name in [n for n in derived if n.startswith("dominant_")]:
        value = np.where(is_determined, planes[name], derived[name].value)
        error = planes[f"{name}_errors"]
        low, high = (value - 90, value + 90) if name.endswith("_deg") else (0.0 if "_linear" in name else -1.0, 1.0)
        half = np.where(is_determined, error, np.maximum(value - low, high - value))
        if name == MATRIX:
            planes[f"{name}_errors"] = np.asarray(half, dtype=np.float32)
        else:
            bounds = zip(planes[f"{name}_95"], (low, high), strict=True)
            put(planes, name, value, half, *(np.where(is_determined, bound, end) for bound, end in bounds))
