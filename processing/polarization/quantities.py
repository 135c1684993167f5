"""What a Mueller matrix says: depolarization, diattenuation, polarizance, and light between two polarizers.

Functions of Mueller matrices (..., 4, 4) return one number a matrix; angles are in radians. `gradients` beside it has
their derivatives, `decompositions` and `cloude` the decompositions.
"""

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import RealArray

NamedStokes = Literal["horizontal", "vertical", "45", "135", "right", "left", "unpolarized"]

#: Stokes vectors by name of the polarization, unit intensity.
POLARIZATIONS: dict[str, NDArray[np.float64]] = {
    "unpolarized": np.array([1.0, 0, 0, 0]),
    "horizontal": np.array([1.0, 1, 0, 0]),
    "vertical": np.array([1.0, -1, 0, 0]),
    "45": np.array([1.0, 0, 1, 0]),
    "135": np.array([1.0, 0, -1, 0]),
    "right": np.array([1.0, 0, 0, 1]),
    "left": np.array([1.0, 0, 0, -1]),
}

#: The pairs of Jarecki and Kupinski's bunny figure: (generator, analyzer).
PAPER_PAIRS: dict[str, tuple[NamedStokes, NamedStokes]] = {
    "crossed_linear": ("vertical", "horizontal"),
    "aligned_linear": ("vertical", "vertical"),
    "crossed_circular": ("left", "right"),
}


def depolarization_index(m: RealArray) -> RealArray:
    """Gil and Bernabeu's index sqrt(|M|^2 - m00^2) / (sqrt 3 m00): 1 for a pure matrix, 0 for the ideal depolarizer."""
    m = np.asarray(m)
    total = np.einsum("...ij,...ij->...", m, m)
    m00 = m[..., 0, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.sqrt(np.maximum(total - m00 * m00, 0)) / (np.sqrt(3, dtype=m.dtype) * m00))


def entropy(eigenvalues: RealArray) -> RealArray:
    """Cloude's entropy -sum xi log4 xi (0 pure, 1 ideal depolarizer) of coherency eigenvalues (..., 4).

    NaN where an eigenvalue is negative: an unphysical matrix has no entropy.
    """
    xi = np.asarray(eigenvalues)
    with np.errstate(divide="ignore", invalid="ignore"):
        terms = np.where(xi == 0, 0, xi * np.log(xi))
    return np.asarray(-terms.sum(axis=-1) / np.log(4))


def deviation_from_td(eigenvalues: RealArray) -> RealArray:
    """xi1, xi2, xi3 minus their mean (1 - xi0) / 3: (..., 3), zero where the triply degenerate model holds."""
    xi = np.asarray(eigenvalues)
    return np.asarray(xi[..., 1:] - xi[..., 1:].mean(axis=-1, keepdims=True))


def td_missed(eigenvalues: RealArray) -> RealArray:
    """Fraction (...) of the light that the triply degenerate model puts in the wrong process: sum |deviation| / 2.

    Half, because what one process has too much another has too little. Noise makes it positive even for a matrix
    that is triply degenerate.
    """
    return np.asarray(np.abs(deviation_from_td(eigenvalues)).sum(axis=-1) / 2)


def diattenuation_vector(m: RealArray) -> RealArray:
    """D = (m01, m02, m03) / m00: (..., 3)."""
    m = np.asarray(m)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(m[..., 0, 1:] / m[..., :1, 0])


def polarizance_vector(m: RealArray) -> RealArray:
    """P = (m10, m20, m30) / m00: (..., 3)."""
    m = np.asarray(m)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(m[..., 1:, 0] / m[..., 0, :1])


def magnitude(vector: RealArray) -> RealArray:
    """Length of a vector (..., 3)."""
    return np.asarray(np.sqrt(np.sum(np.square(vector), axis=-1)))


def linear_magnitude(vector: RealArray) -> RealArray:
    """Linear part sqrt(v1^2 + v2^2) of a vector (..., 3): |D| in Jarecki and Kupinski."""
    v = np.asarray(vector)
    return np.asarray(np.hypot(v[..., 0], v[..., 1]))


def orientation(vector: RealArray) -> RealArray:
    """Azimuth 1/2 atan2(v2, v1) of a vector (..., 3), radians from horizontal in [0, pi)."""
    v = np.asarray(vector)
    return np.asarray(np.mod(0.5 * np.arctan2(v[..., 1], v[..., 0]), np.pi))


def retardance_vector(retarder: RealArray) -> RealArray:
    """Retardance vector (..., 3) of rotations MR (..., 4, 4): length in [0, pi], direction the fast eigenpolarization.

    Components: horizontal, 45 degrees, right circular (Lu and Chipman, Eqs. 16-17). At pi the fast and the slow one
    cannot be told apart; the vector is then one of the two.
    """
    r = np.asarray(retarder)[..., 1:, 1:]
    twice_sine = np.stack(
        [r[..., 1, 2] - r[..., 2, 1], r[..., 2, 0] - r[..., 0, 2], r[..., 0, 1] - r[..., 1, 0]], axis=-1
    )
    trace = np.trace(r, axis1=-2, axis2=-1)
    length = magnitude(twice_sine)
    angle = np.arctan2(length, trace - 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        vector = twice_sine * (angle / length)[..., None]
    # Near pi the sine vanishes: the axis is then the column of (R + R^T) / 2 + ... with the longest diagonal.
    half_turn = trace < -0.5
    if np.any(half_turn):
        vector = np.where(half_turn[..., None], _near_half_turn(r, twice_sine, angle), vector)
    return np.asarray(np.where((length == 0)[..., None] & ~half_turn[..., None], 0.0, vector))


def _near_half_turn(r: RealArray, twice_sine: RealArray, angle: RealArray) -> RealArray:
    """The same vector from the symmetric part, (1 - cos) a a^T + cos 1, which stays well conditioned at pi."""
    outer = (r + np.swapaxes(r, -1, -2)) / 2 - np.cos(angle)[..., None, None] * np.eye(3)
    longest = np.argmax(np.diagonal(outer, axis1=-2, axis2=-1), axis=-1)
    axis = np.take_along_axis(outer, longest[..., None, None], axis=-1)[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        axis = axis / magnitude(axis)[..., None]
    sign = np.where(np.sum(axis * twice_sine, axis=-1) < 0, -1.0, 1.0)
    return np.asarray(axis * (sign * angle)[..., None])


def between(m: RealArray, generator: NamedStokes | ArrayLike, analyzer: NamedStokes | ArrayLike) -> RealArray:
    """Fraction of the light, generated with one polarization, that a polarizer for another one passes after the sample.

    Parameters
    ----------
    m : (..., 4, 4)
    generator, analyzer : a name (`POLARIZATIONS`) or a Stokes vector (4,); divided by its S0. The analyzer carries
        the factor 1/2 of an ideal polarizer, so an unpolarized beam through air gives 1/2.

    Returns
    -------
    (...), in units of m00: 1/2 a M g.
    """
    g, a = _stokes(generator, "generator"), _stokes(analyzer, "analyzer")
    return np.asarray(0.5 * np.einsum("i,...ij,j->...", a, np.asarray(m), g))


def _stokes(light: NamedStokes | ArrayLike, what: str) -> NDArray[np.float64]:
    if isinstance(light, str):
        if light not in POLARIZATIONS:
            known = ", ".join(POLARIZATIONS)
            raise ValueError(f"{what} {light!r} is no polarization; known: {known}, or four Stokes parameters")
        return POLARIZATIONS[light]
    s = np.asarray(light, dtype=float)
    if s.shape != (4,) or not s[0] > 0 or not np.linalg.norm(s[1:]) <= s[0] * (1 + 1e-9):
        raise ValueError(f"{what} must be a Stokes vector (4,) with S0 > 0 and degree of polarization <= 1; got {s}")
    return np.asarray(s / s[0])
