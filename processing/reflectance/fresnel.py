"""Fresnel reflection: amplitudes, and the Jones matrix of a microfacet in the instrument frames."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.geometry.frames import ScatteringGeometry, cross, dot

ComplexArray = NDArray[np.complex128]


def amplitudes(index: complex, angle: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
    """r_s and r_p at angles of incidence in radians, for a refractive index ratio n + i k, k >= 0.

    r_p = -r_s at normal incidence (trap 2). The sign of k goes with decreasing phase.
    """
    c = np.cos(np.asarray(angle, dtype=float))
    n = complex(index)
    # n cos t' = sqrt(n^2 - sin^2 t); the principal root has the decaying wave for k >= 0.
    root = np.sqrt(n * n - (1 - c * c) + 0j)
    rs = (c - root) / (c + root)
    rp = (n * n * c - root) / (n * n * c + root)
    return rs, rp


def jones(geometry: ScatteringGeometry, index: complex) -> ComplexArray:
    """Jones matrices (..., 2, 2) of reflection at the facet whose normal is h (paper Eq. for F)."""
    s = geometry.s_axis
    rs, rp = amplitudes(index, geometry.angles.theta_d)
    p_in, p_out = cross(-geometry.to_source, s), cross(geometry.to_camera, s)
    x_in, y_in = geometry.axes_in
    x_out, y_out = geometry.axes_out
    out = np.empty((*rs.shape, 2, 2), dtype=complex)
    for i, axis_out in enumerate((x_out, y_out)):
        via_s, via_p = dot(axis_out, s) * rs, dot(axis_out, p_out) * rp
        for j, axis_in in enumerate((x_in, y_in)):
            out[..., i, j] = via_s * dot(s, axis_in) + via_p * dot(p_in, axis_in)
    return out
