"""Derived quantities with their gradients by the 16 Mueller elements, in closed form where there is one.

Every function takes Mueller matrices (..., 4, 4) in float64 and returns `Derived` by name; values of several
components stack on the left. Angles are in degrees here, as products hold them.
"""

from collections.abc import Callable, Mapping

import numpy as np

from processing.arrays import RealArray
from processing.polarization import quantities
from processing.polarization.cloude import cloude, xi0_and_dominant
from processing.polarization.decompositions.differential import differential, differential_slopes
from processing.polarization.decompositions.lu_chipman import depolarization_power, lu_chipman
from processing.polarization.decompositions.symmetric import G, Symmetric, symmetric
from processing.polarization.propagation import Derived, numeric_gradient
from processing.polarization.quantities import NamedStokes


def coherency(m: RealArray) -> dict[str, Derived]:
    """Coherency eigenvalues, their deviation from the triply degenerate model, entropy, of matrices (..., 4, 4).

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


def depolarization_index(m: RealArray) -> dict[str, Derived]:
    """Depolarization index of M (..., 4, 4): d DI = (sum of m_ij d m_ij but 00) / (3 m00^2 DI) - DI d m00 / m00."""
    m = np.asarray(m, dtype=float)
    value, m00 = quantities.depolarization_index(m), m[..., 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = m.reshape(*m.shape[:-2], 16) / (3 * m00**2 * value)[..., None]
        gradient[..., 0] = -value / m00
    return {"depolarization_index": Derived(value, gradient, tuple(range(1, 16)))}


def diattenuation(m: RealArray) -> dict[str, Derived]:
    """Diattenuation of M (..., 4, 4) itself: magnitude, linear, circular, orientation."""
    m = np.asarray(m, dtype=float)
    return _vector("diattenuation", quantities.diattenuation_vector(m), m[..., 0, 0], (1, 2, 3))


def polarizance(m: RealArray) -> dict[str, Derived]:
    """Polarizance of M (..., 4, 4) itself: magnitude, linear, circular, orientation."""
    m = np.asarray(m, dtype=float)
    return _vector("polarizance", quantities.polarizance_vector(m), m[..., 0, 0], (4, 8, 12))


def ellipticity(m: RealArray) -> dict[str, Derived]:
    """Ellipticity angle of the light that M (..., 4, 4) makes of unpolarized light, -45 to 45 degrees."""
    parts = polarizance(m)
    linear, circular = parts["polarizance_linear"], parts["polarizance_circular"]
    x, y = np.asarray(linear.value)[..., None], np.asarray(circular.value)[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        gradient = np.rad2deg(0.5) * (x * circular.gradient - y * linear.gradient) / (x**2 + y**2)
    value = np.rad2deg(0.5 * np.arctan2(circular.value, linear.value))
    return {"polarizance_ellipticity_deg": Derived(value, gradient)}


def _vector(name: str, v: RealArray, m00: RealArray, elements: tuple[int, int, int]) -> dict[str, Derived]:
    slope = np.zeros((3, *v.shape[:-1], 16))  # d v_i = d m_i / m00 - v_i d m00 / m00
    for i, element in enumerate(elements):
        slope[i, ..., element] = 1 / m00
        slope[i, ..., 0] = -v[..., i] / m00
    size = quantities.magnitude(v)
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = np.sum(np.moveaxis(v, -1, 0)[..., None] * slope, axis=0) / size[..., None]
    return {name: Derived(size, whole, elements)} | _parts(name, v, slope, elements[:2])


def _parts(name: str, v: RealArray, slope: RealArray, elements: tuple[int, ...] = ()) -> dict[str, Derived]:
    """Linear part, circular part and orientation of a vector v (..., 3) with gradient slope (3, ..., 16)."""
    linear = quantities.linear_magnitude(v)
    v1, v2 = v[..., 0, None], v[..., 1, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (v1 * slope[0] + v2 * slope[1]) / linear[..., None]
        across = np.rad2deg(0.5) * (v1 * slope[1] - v2 * slope[0]) / linear[..., None] ** 2
    parts = None if elements else Derived(np.moveaxis(v[..., :2], -1, 0), slope[:2])
    return {
        f"{name}_linear": Derived(linear, along, elements, parts),
        f"{name}_circular": Derived(v[..., 2], slope[2]),
        f"{name}_orientation_deg": Derived(np.rad2deg(quantities.orientation(v)), across),
    }


RETARDER = ("retardance_deg", "retardance_linear_deg", "retardance_fast_axis_deg", "retardance_circular_deg")
_RETARDER_PERIOD = (np.inf, np.inf, 180.0, np.inf)


def dominant(m: RealArray) -> dict[str, Derived]:
    """The dominant Mueller-Jones matrix m0 (4, 4, ...), its diattenuation and polarizance (|D| and psi)."""

    def values(mueller: RealArray) -> RealArray:
        m0 = xi0_and_dominant(mueller)[1]
        return m0.reshape(*m0.shape[:-2], 16)

    value = values(np.asarray(m, dtype=float))
    gradient = np.moveaxis(numeric_gradient(values, m), -2, 0)
    # m00 adds the same to all eigenvalues.
    gradient[..., 0] = 0
    first_row, first_column = [1, 2, 3], [4, 8, 12]
    shape = (4, 4, *value.shape[:-1])
    matrix = Derived(np.moveaxis(value, -1, 0).reshape(shape), gradient.reshape(*shape, 16))
    return (
        {"dominant_mueller_jones": matrix}
        | _parts("dominant_diattenuation", value[..., first_row], gradient[first_row])
        | _parts("dominant_polarizance", value[..., first_column], gradient[first_column])
    )


def lu_chipman_quantities(m: RealArray) -> dict[str, Derived]:
    """Retardance and depolarization power of M (..., 4, 4) after Lu and Chipman; NaN where it is not defined."""

    def values(mueller: RealArray) -> RealArray:
        factors = lu_chipman(mueller)
        vector = quantities.retardance_vector(factors.retarder)
        axes = [np.rad2deg(vector[..., k]) for k in range(3)]
        return np.stack([*_retardance_deg(vector), depolarization_power(factors.depolarizer), *axes], axis=-1)

    axes = tuple(f"axis{k}" for k in range(3))
    period = (*_RETARDER_PERIOD, *4 * (np.inf,))
    found = _numeric(values, m, (*RETARDER, "depolarization_power", *axes), period)
    parts = [found.pop(name) for name in axes]
    vector = Derived(np.stack([p.value for p in parts]), np.stack([p.gradient for p in parts]))
    for name, count in (("retardance_deg", 3), ("retardance_linear_deg", 2)):
        found[name] = found[name]._replace(parts=Derived(vector.value[:count], vector.gradient[:count]))
    fast = found["retardance_fast_axis_deg"]
    either = Derived(np.mod(fast.value, 90.0), fast.gradient)
    return found | {"retardance_axis_or_90_deg": either, "retardance_vector_deg": vector}


def symmetric_quantities(m: RealArray, found: Symmetric | None = None) -> dict[str, Derived]:
    """Diagonal of the symmetric decomposition's depolarizer over its first element; NaN where not defined.

    The squares of the four elements are the eigenvalues of N = M^T G M G up to one factor; with N v = lambda v the left
    eigenvector is G v, so d lambda = 2 (G M G v)^T dM (G v) / (v^T G v).
    """
    m = np.asarray(m, dtype=float)
    found = found or symmetric(m)
    safe = np.where(found.defined[..., None, None], m, np.diag([1.0, 0.5, 0.4, 0.3]))
    values, vectors = np.linalg.eig(np.swapaxes(safe, -1, -2) @ G @ safe @ G)
    order = np.argsort(-values.real, axis=-1)
    values = np.take_along_axis(values, order, axis=-1).real
    gv = G @ np.take_along_axis(vectors, order[..., None, :], axis=-1).real
    left = G @ safe @ gv
    norm = np.einsum("...ik,...ik->...k", G @ gv, gv)
    with np.errstate(divide="ignore", invalid="ignore"):
        # d ln lambda_k, (..., k, a, b)
        slope = 2 * np.einsum("...ak,...bk,...k->...kab", left, gv, 1 / (norm * values))
        d = np.diagonal(found.depolarizer, axis1=-2, axis2=-1)
        ratio = d[..., 1:] / d[..., :1]
        gradient = 0.5 * ratio[..., None, None] * (slope[..., 1:, :, :] - slope[..., :1, :, :])
    flat = gradient.reshape(*gradient.shape[:-2], 16)
    return {f"symmetric_d{k}": Derived(ratio[..., k - 1], flat[..., k - 1, :]) for k in (1, 2, 3)}


def differential_quantities(m: RealArray) -> dict[str, Derived]:
    """Retardance, linear diattenuation and depolarization exponents of M (..., 4, 4), differential decomposition."""
    found = differential(m)
    slope = differential_slopes(np.asarray(m, dtype=float), found.defined)
    retardance, diattenuation = found.retardance(), found.diattenuation()
    size = quantities.magnitude(retardance)
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = np.sum(np.moveaxis(retardance, -1, 0)[..., None] * slope[:3], axis=0) / size[..., None]
    vector = _parts("", retardance, slope[:3])
    linear, circular, axis = vector["_linear"], vector["_circular"], vector["_orientation_deg"]
    to_deg = np.rad2deg(1.0)
    values, slopes = to_deg * np.moveaxis(retardance, -1, 0), to_deg * slope[:3]
    return {
        "differential_retardance_deg": Derived(to_deg * size, to_deg * whole, parts=Derived(values, slopes)),
        "differential_retardance_linear_deg": Derived(
            to_deg * linear.value, to_deg * linear.gradient, parts=Derived(values[:2], slopes[:2])
        ),
        "differential_retardance_fast_axis_deg": axis,
        "differential_retardance_circular_deg": Derived(to_deg * circular.value, to_deg * circular.gradient),
        "differential_diattenuation_linear": _parts("", diattenuation, slope[3:6])["_linear"],
    } | {
        f"differential_depolarization_{k}": Derived(found.depolarization()[..., k - 1], slope[5 + k]) for k in (1, 2, 3)
    }


def pairs(m: RealArray, named: Mapping[str, tuple[NamedStokes, NamedStokes]]) -> dict[str, Derived]:
    """Light between generator and analyzer over m00 of M (..., 4, 4), for named pairs; linear in M apart from m00."""
    m = np.asarray(m, dtype=float)
    m00 = m[..., 0, 0]
    found = {}
    for name, (generator, analyzer) in named.items():
        value = quantities.between(m, generator, analyzer) / m00
        pair = 0.5 * np.outer(quantities.POLARIZATIONS[analyzer], quantities.POLARIZATIONS[generator]).reshape(16)
        gradient = np.repeat((1 / m00)[..., None], 16, axis=-1) * pair
        gradient[..., 0] -= value / m00
        found[name] = Derived(value, gradient)
    return found


def _retardance_deg(vector: RealArray) -> list[RealArray]:
    return [
        np.rad2deg(quantities.magnitude(vector)),
        np.rad2deg(quantities.linear_magnitude(vector)),
        np.rad2deg(quantities.orientation(vector)),
        np.rad2deg(vector[..., 2]),
    ]


def _numeric(
    values: Callable[[RealArray], RealArray], m: RealArray, names: tuple[str, ...], period: tuple[float, ...]
) -> dict[str, Derived]:
    m = np.asarray(m, dtype=float)
    value = values(m)
    gradient = numeric_gradient(values, m, np.asarray(period))
    return {name: Derived(value[..., k], gradient[..., k, :]) for k, name in enumerate(names)}
