"""Rusinkiewicz angles of a scattering geometry (Jarecki and Kupinski, Sec. III-A; docs/conventions.md, "Frames")."""

from typing import NamedTuple

import numpy as np

from processing.arrays import Array


class Angles(NamedTuple):
    """theta_h, theta_d (0..pi/2) and phi_d (-pi..pi), radians, each (...)."""

    theta_h: Array
    theta_d: Array
    phi_d: Array


def angles(n: Array, wi: Array, wo: Array) -> Angles:
    """Angles of unit vectors (..., 3): normal, to the source, to the camera.

    theta_h = angle(n, h), theta_d = angle(wi, h); phi_d is the azimuth of wi about h, counted from the
    direction n -> h, right-handed. Where theta_h or theta_d is 0, phi_d is undefined and 0 is returned.
    """
    h = wi + wo
    h = h / np.sqrt(_dot(h, h))[..., None]
    ch = _dot(n, h)
    # Continues from n beyond h; its length is sin(theta_h).
    away = ch[..., None] * h - n
    sh = np.sqrt(_dot(away, away))
    cd = _dot(wi, h)
    across = wi - cd[..., None] * h
    sd = np.sqrt(_dot(across, across))
    along = _dot(across, away)
    side = (
        h[..., 0] * (away[..., 1] * across[..., 2] - away[..., 2] * across[..., 1])
        + h[..., 1] * (away[..., 2] * across[..., 0] - away[..., 0] * across[..., 2])
        + h[..., 2] * (away[..., 0] * across[..., 1] - away[..., 1] * across[..., 0])
    )
    phi = np.where((sh > 1e-12) & (sd > 1e-12), np.arctan2(side, along), 0.0)
    return Angles(np.arctan2(sh, ch), np.arctan2(sd, cd), phi)


def directions(theta_h: Array, theta_d: Array, phi_d: Array) -> tuple[Array, Array, Array]:
    """Unit vectors n, wi, wo (..., 3) with the given angles: h on +z, wi and wo in the horizontal plane.

    wi = (sin theta_d, 0, cos theta_d), wo = (-sin theta_d, 0, cos theta_d): the instrument that stands
    still while the surface turns, so y is the axis s of both beams.
    """
    th, td, ph = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in (theta_h, theta_d, phi_d)))
    zero = np.zeros_like(th)
    wi = np.stack([np.sin(td), zero, np.cos(td)], axis=-1)
    wo = np.stack([-np.sin(td), zero, np.cos(td)], axis=-1)
    # wi lies at azimuth 0 about h, so the direction n -> h lies at -phi_d and n on the opposite side of h.
    n = np.stack([-np.sin(th) * np.cos(ph), np.sin(th) * np.sin(ph), np.cos(th)], axis=-1)
    return n, wi, wo


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("...i,...i->...", a, b))
