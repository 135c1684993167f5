"""Derived quantities with their gradients by the 16 Mueller elements, in closed form where there is one.

Every function takes Mueller matrices (..., 4, 4) in float64 and returns `Derived` by name; values of several
components stack on the left. Angles are in degrees here, as products hold them.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from processing import quantities
from processing.cloude import Floats, cloude, xi0_and_dominant
from processing.decompositions.differential import Differential, differential
from processing.decompositions.lu_chipman import depolarization_power, lu_chipman
from processing.decompositions.symmetric import symmetric
from processing.propagation import Derived, numeric_gradient


def coherency(m: Floats) -> dict[str, Derived]:
    """Coherency eigenvalues, their deviation from the triply degenerate model, entropy.

    d xi_k = v_k^H dH v_k for the eigenvector v_k of H: in Mueller elements (m_k - 4 xi_k e00) / (4 m00).
    """
    xi, parts = cloude(np.asarray(m, dtype=float))
    slope = np.moveaxis(parts.reshape(*parts.shape[:-2], 16), -2, 0).copy()
    eigenvalues = np.moveaxis(xi, -1, 0)
    slope[..., 0] -= 4 * eigenvalues
    slope /= 4 * np.asarray(m)[..., 0, 0, None]
    deviation = np.moveaxis(quantities.deviation_from_td(xi), -1, 0)
    off = slope[1:] - slope[1:].mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        # sum_k d xi_k = 0, so the constant of d(x log x) drops out.
        disorder = -np.sum(np.log(eigenvalues)[..., None] * slope, axis=0) / np.log(4)
    return {
        "coherency_eigenvalues": Derived(eigenvalues, slope),
        "eigenvalue_deviation": Derived(deviation, off),
        "td_missed": Derived(quantities.td_missed(xi), np.sum(np.sign(deviation)[..., None] * off, axis=0) / 2),
        "entropy": Derived(quantities.entropy(xi), disorder),
    }


def depolarization_index(m: Floats) -> dict[str, Derived]:
    """Depolarization index: d DI = (sum of m_ij d m_ij without 00) / (3 m00^2 DI) - DI d m00 / m00."""
    m = np.asarray(m, dtype=float)
    value, m00 = quantities.depolarization_index(m), m[..., 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = m.reshape(*m.shape[:-2], 16) / (3 * m00**2 * value)[..., None]
        gradient[..., 0] = -value / m00
    return {"depolarization_index": Derived(value, gradient)}


def diattenuation(m: Floats) -> dict[str, Derived]:
    """Diattenuation of M itself: magnitude, linear, circular, orientation."""
    m = np.asarray(m, dtype=float)
    return _vector("diattenuation", quantities.diattenuation_vector(m), m[..., 0, 0], (1, 2, 3))


def polarizance(m: Floats) -> dict[str, Derived]:
    """Polarizance of M itself: magnitude, linear, circular, orientation."""
    m = np.asarray(m, dtype=float)
    return _vector("polarizance", quantities.polarizance_vector(m), m[..., 0, 0], (4, 8, 12))


def _vector(name: str, v: Floats, m00: Floats, elements: tuple[int, int, int]) -> dict[str, Derived]:
    pixels = v.shape[:-1]
    slope = np.zeros((3, *pixels, 16))  # d v_i = d m_i / m00 - v_i d m00 / m00
    for i, element in enumerate(elements):
        slope[i, ..., element] = 1 / m00
        slope[i, ..., 0] = -v[..., i] / m00
    size, linear = quantities.magnitude(v), quantities.linear_magnitude(v)
    v1, v2, v3 = (v[..., i, None] for i in range(3))
    with np.errstate(divide="ignore", invalid="ignore"):
        return {
            name: Derived(size, (v1 * slope[0] + v2 * slope[1] + v3 * slope[2]) / size[..., None]),
            f"{name}_linear": Derived(linear, (v1 * slope[0] + v2 * slope[1]) / linear[..., None]),
            f"{name}_circular": Derived(v[..., 2], slope[2]),
            f"{name}_orientation_deg": Derived(
                np.rad2deg(quantities.orientation(v)),
                np.rad2deg(0.5) * (v1 * slope[1] - v2 * slope[0]) / linear[..., None] ** 2,
            ),
        }


DOMINANT = (
    "dominant_diattenuation_linear",
    "dominant_diattenuation_circular",
    "dominant_diattenuation_orientation_deg",
    "dominant_polarizance_linear",
    "dominant_polarizance_circular",
    "dominant_polarizance_orientation_deg",
)
RETARDER = ("retardance_deg", "retardance_linear_deg", "retardance_fast_axis_deg", "retardance_circular_deg")
_RETARDER_PERIOD = (np.inf, np.inf, 180.0, np.inf)


def dominant(m: Floats) -> dict[str, Derived]:
    """Diattenuation and polarizance of the dominant process m0 (the paper's psi and |D|)."""

    def values(mueller: Floats) -> Floats:
        return np.stack(list(_of_pure(xi0_and_dominant(mueller)[1]).values()), axis=-1)

    return _numeric(values, m, DOMINANT, (np.inf, np.inf, 180.0, np.inf, np.inf, 180.0))


def dominant_matrix(m: Floats) -> dict[str, Derived]:
    """The dominant Mueller-Jones matrix itself (4, 4, ...)."""

    def values(mueller: Floats) -> Floats:
        m0 = xi0_and_dominant(mueller)[1]
        return m0.reshape(*m0.shape[:-2], 16)

    value = np.moveaxis(values(np.asarray(m, dtype=float)), -1, 0)
    gradient = np.moveaxis(numeric_gradient(values, m), -2, 0)
    shape = value.shape[1:]
    return {"dominant_mueller_jones": Derived(value.reshape(4, 4, *shape), gradient.reshape(4, 4, *shape, 16))}


def lu_chipman_quantities(m: Floats) -> dict[str, Derived]:
    """Retardance and depolarization power of the Lu-Chipman decomposition; NaN where it is not defined."""

    def values(mueller: Floats) -> Floats:
        factors = lu_chipman(mueller)
        vector = quantities.retardance_vector(factors.retarder)
        return np.stack([*_retardance_deg(vector), depolarization_power(factors.depolarizer)], axis=-1)

    return _numeric(values, m, (*RETARDER, "depolarization_power"), (*_RETARDER_PERIOD, np.inf))


def symmetric_quantities(m: Floats) -> dict[str, Derived]:
    """Diagonal of the symmetric decomposition's depolarizer over its first element; NaN where not defined."""

    def values(mueller: Floats) -> Floats:
        d = np.diagonal(symmetric(mueller).depolarizer, axis1=-2, axis2=-1)
        return np.asarray(d[..., 1:] / d[..., :1])

    names = tuple(f"symmetric_d{k}" for k in (1, 2, 3))
    return _numeric(values, m, names, (np.inf,) * 3)


def differential_quantities(m: Floats) -> dict[str, Derived]:
    """Retardance, linear diattenuation and depolarization exponents of the differential decomposition."""

    def values(mueller: Floats) -> Floats:
        found: Differential = differential(mueller)
        linear = quantities.linear_magnitude(found.diattenuation())
        parts = [*_retardance_deg(found.retardance()), linear, *np.moveaxis(found.depolarization(), -1, 0)]
        return np.stack(parts, axis=-1)

    retarder = tuple(f"differential_{name}" for name in RETARDER)
    names = (*retarder, "differential_diattenuation_linear", *(f"differential_depolarization_{k}" for k in (1, 2, 3)))
    return _numeric(values, m, names, (*_RETARDER_PERIOD, np.inf, np.inf, np.inf, np.inf))


def _of_pure(m0: Floats) -> dict[str, Floats]:
    d, p = quantities.diattenuation_vector(m0), quantities.polarizance_vector(m0)
    each = [
        f(v)
        for v in (d, p)
        for f in (quantities.linear_magnitude, lambda v: v[..., 2], lambda v: np.rad2deg(quantities.orientation(v)))
    ]
    return dict(zip(DOMINANT, each, strict=True))


def _retardance_deg(vector: Floats) -> list[Floats]:
    return [
        np.rad2deg(quantities.magnitude(vector)),
        np.rad2deg(quantities.linear_magnitude(vector)),
        np.rad2deg(quantities.orientation(vector)),
        np.rad2deg(vector[..., 2]),
    ]


def _numeric(
    values: Callable[[Floats], Floats], m: Floats, names: tuple[str, ...], period: tuple[float, ...]
) -> dict[str, Derived]:
    m = np.asarray(m, dtype=float)
    value = values(m)
    gradient = numeric_gradient(values, m, np.asarray(period))
    return {name: Derived(value[..., k], gradient[..., k, :]) for k, name in enumerate(names)}
