"""Where the delta method does not hold: noise that can be taken off is, else the error bar is NaN, "not determined".

Magnitudes are pushed up by noise and equal eigenvalues apart; an angle means nothing where its vector is noise, and at
a retardance of 180 degrees nobody can tell the fast axis from the slow one. Limits are in units of the noise.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from processing.polarization.eigenvalue_noise import EigenvalueNoise
from processing.polarization.quantities import deviation_from_td
from processing.polarization.scalar_files import scalar_quantities

Planes = dict[str, NDArray[Any]]

#: A magnitude has an error bar above this many of its errors; below, it is an upper limit.
SEEN = 3.0
#: Eigenvalues have one where their neighbours are this many times the noise between them away.
APART = 5.0
#: The fast axis is determined where it is the slow one with less than this probability: three errors from 180 degrees.
FLIPPED = 0.00135
#: Components of the vectors whose magnitudes these are.
MAGNITUDES = {
    "diattenuation": 3,
    "diattenuation_linear": 2,
    "polarizance": 3,
    "polarizance_linear": 2,
    "dominant_diattenuation_linear": 2,
    "dominant_polarizance_linear": 2,
    "retardance_deg": 3,
    "retardance_linear_deg": 2,
    "differential_retardance_deg": 3,
    "differential_retardance_linear_deg": 2,
    "differential_diattenuation_linear": 2,
}
RETARDANCE = (
    "retardance_deg",
    "retardance_linear_deg",
    "retardance_fast_axis_deg",
    "retardance_axis_or_90_deg",
    "retardance_circular_deg",
    "retardance_vector_deg",
)
#: Angles, and the magnitudes that they are of.
ANGLES = {
    "diattenuation_orientation_deg": "diattenuation_linear",
    "polarizance_orientation_deg": "polarizance_linear",
    "dominant_diattenuation_orientation_deg": "dominant_diattenuation_linear",
    "dominant_polarizance_orientation_deg": "dominant_polarizance_linear",
    "retardance_fast_axis_deg": "retardance_linear_deg",
    "retardance_axis_or_90_deg": "retardance_linear_deg",
    "differential_retardance_fast_axis_deg": "differential_retardance_linear_deg",
}


def limit(
    planes: Planes, noise: EigenvalueNoise | None, relative: NDArray[np.floating], depolarizer: NDArray[np.floating]
) -> None:
    """Change quantities and errors (`<name>_errors`) in place.

    Parameters
    ----------
    noise : of the coherency matrix; None: nothing splits equal eigenvalues.
    relative : root mean square error of the 15 elements other than m00, over m00.
    depolarizer : (..., 4, 4), of the Lu-Chipman decomposition; retardance is divided by its diagonal.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        weakest = np.abs(_symmetric_eigenvalues(np.nan_to_num(depolarizer[..., 1:, 1:]))).min(axis=0)
        for name in RETARDANCE:
            _forget(planes, name, weakest < SEEN * relative)
        _half_turn(planes)
        limit_vectors(planes)
        _index(planes, 15 * relative**2 / 3)
        if "symmetric_d1" in planes:
            _equal_diagonal(planes)
        if noise is not None:
            _equal_eigenvalues(planes, noise)
        lowest = planes["coherency_eigenvalues"][3] < SEEN * planes["coherency_eigenvalues_errors"][3]
        _forget(planes, "entropy", lowest)


def limit_vectors(planes: Planes) -> None:
    """The part that needs no more than the planes: noise off magnitudes, angles only of vectors that are seen."""
    with np.errstate(divide="ignore", invalid="ignore"):
        for angle, vector in ANGLES.items():
            if angle in planes:
                _forget(planes, angle, ~(planes[vector] > SEEN * planes[f"{vector}_errors"]))
        lengths = {name: s.components for name, s in scalar_quantities().items() if s.components}
        for name, components in (MAGNITUDES | lengths).items():
            if name in planes:
                # Noise across a vector adds its square; taken as alike in all directions.
                _magnitude(planes, name, (components - 1) * planes[f"{name}_errors"] ** 2)


def _symmetric_eigenvalues(a: NDArray[np.floating]) -> NDArray[np.float64]:
    """Eigenvalues (3, ...) of symmetric matrices (..., 3, 3) from their invariants, far quicker than LAPACK.

    Good to half the digits where two are equal, which is plenty for a limit.
    """
    mean = np.trace(a, axis1=-2, axis2=-1) / 3
    rest = a - mean[..., None, None] * np.eye(3)
    size = np.sqrt(np.einsum("...ij,...ij->...", rest, rest) / 6)
    x, y, z = rest[..., 0, :], rest[..., 1, :], rest[..., 2, :]
    determinant = np.einsum("...i,...i->...", x, np.cross(y, z))
    turn = np.arccos(np.clip(np.nan_to_num(determinant / (2 * size**3)), -1, 1)) / 3
    return np.stack([mean + 2 * size * np.cos(turn + 2 * np.pi * k / 3) for k in range(3)])


def _forget(planes: Planes, name: str, where: NDArray[np.bool_] | np.bool_) -> None:
    planes[f"{name}_errors"] = np.where(where, np.float32(np.nan), planes[f"{name}_errors"])


def _magnitude(planes: Planes, name: str, added: NDArray[Any]) -> None:
    """Take off what noise adds to the square; no error bar where the magnitude is an upper limit."""
    value = planes[name]
    _forget(planes, name, ~(value > SEEN * planes[f"{name}_errors"]))
    planes[name] = np.sqrt(np.maximum(value**2 - np.nan_to_num(added), 0)).astype(np.float32)


def _index(planes: Planes, added: NDArray[np.floating]) -> None:
    """The same of the depolarization index, whose square `added` is; its scatter is that of 15 squares of noise."""
    second = added * np.sqrt(2 / 15) / (2 * planes["depolarization_index"])
    planes["depolarization_index_errors"] = np.hypot(planes["depolarization_index_errors"], second).astype(np.float32)
    _magnitude(planes, "depolarization_index", added)


def _half_turn(planes: Planes) -> None:
    """At 180 degrees a rotation about an axis is that about its opposite: fast and slow, right and left are one."""
    gap, error = 180 - planes["retardance_deg"], planes["retardance_deg_errors"]
    planes["retardance_axis_flip"] = ndtr(-gap / error).astype(np.float32)
    ambiguous = ~(planes["retardance_axis_flip"] < FLIPPED)
    _forget(planes, "retardance_fast_axis_deg", ambiguous)
    _forget(planes, "retardance_circular_deg", ambiguous)
    _forget(planes, "retardance_vector_deg", ambiguous)


def _equal_diagonal(planes: Planes) -> None:
    """The elements of the symmetric decomposition are sorted eigenvalues."""
    names = [f"symmetric_d{k}" for k in (1, 2, 3)]
    value = np.stack([np.ones_like(planes[names[0]]), *(planes[n] for n in names)])
    error = np.stack([np.zeros_like(value[0]), *(planes[f"{n}_errors"] for n in names)])
    close = ~(value[:-1] - value[1:] > SEEN * np.hypot(error[:-1], error[1:]))
    for k, name in enumerate(names):
        _forget(planes, name, close[k] | close[min(k + 1, 2)])


def _equal_eigenvalues(planes: Planes, noise: EigenvalueNoise) -> None:
    xi = planes["coherency_eigenvalues"]
    among = np.sqrt(noise.others / 8)
    close = xi[:-1] - xi[1:] < APART * np.stack([noise.coupling, among, among])
    touched = np.stack([close[0], close[0] | close[1], close[1] | close[2], close[2]])
    for name in [n for n in planes if n.startswith("dominant_") and not n.endswith("_errors")]:
        _forget(planes, name, close[0])
    _forget(planes, "coherency_eigenvalues", touched)
    _forget(planes, "eigenvalue_deviation", touched[1:])
    _forget(planes, "entropy", touched.any(axis=0))
    observed = np.sum(np.square(deviation_from_td(np.moveaxis(xi, 0, -1))), axis=-1)
    left = np.sqrt(np.maximum(1 - noise.others / observed, 0))
    planes["td_missed_noise"] = (planes["td_missed"] * np.sqrt(noise.others / observed)).astype(np.float32)
    planes["td_missed"] = (planes["td_missed"] * left).astype(np.float32)
    _forget(planes, "td_missed", observed < SEEN * noise.others)
