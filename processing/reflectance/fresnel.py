"""Fresnel reflection: amplitudes, and the Jones matrix of a microfacet in the instrument frames."""

import numpy as np
from numpy.typing import ArrayLike

from processing.arrays import Array, ComplexArray
from processing.geometry.frames import ScatteringGeometry, cross, dot


def amplitudes(index: complex, angle: ArrayLike) -> tuple[ComplexArray, ComplexArray]:
    """r_s and r_p at angles of incidence in radians, for a refractive index ratio n + i k, k >= 0.

    r_p = -r_s at normal incidence (docs/conventions.md). The sign of k goes with decreasing phase.
    """
    c = np.cos(np.asarray(angle, dtype=float))
    n = complex(index)
    # n cos t' = sqrt(n^2 - sin^2 t); the principal root has the decaying wave for k >= 0.
    root = np.sqrt(n * n - (1 - c * c) + 0j)
    rs = (c - root) / (c + root)
    rp = (n * n * c - root) / (n * n * c + root)
    return rs, rp


def basis(geometry: ScatteringGeometry) -> tuple[Array, Array]:
    """Real matrices (..., 2, 2) of s- and p-polarized reflection at the facet: F = r_s S + r_p P."""
    s = geometry.s_axis
    p_in, p_out = cross(-geometry.to_source, s), cross(geometry.to_camera, s)
    via_s, via_p = (np.empty((*s.shape[:-1], 2, 2)) for _ in range(2))
    for i, axis_out in enumerate(geometry.axes_out):
        for j, axis_in in enumerate(geometry.axes_in):
            via_s[..., i, j] = dot(axis_out, s) * dot(s, axis_in)
            via_p[..., i, j] = dot(axis_out, p_out) * dot(p_in, axis_in)
    return via_s, via_p


def jones(geometry: ScatteringGeometry, index: complex) -> ComplexArray:
    """Jones matrices (..., 2, 2) of reflection at the facet whose normal is h (F of Jarecki and Kupinski)."""
    rs, rp = amplitudes(index, geometry.angles.theta_d)
    via_s, via_p = basis(geometry)
    return np.asarray(rs[..., None, None] * via_s + rp[..., None, None] * via_p)
