"""Mueller BRDF of PTFE as the set `ptfe-mueller-brdf` has it; the axes of its file: docs/reflectance.md."""

import numpy as np

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry, change_frames
from processing.polarization import mueller

_OTHER_HANDEDNESS = np.diag([1.0, 1.0, 1.0, -1.0])


def direction(theta_deg: Array, phi_deg: Array) -> Array:
    """Unit vectors (N, 3) above a surface whose normal is z."""
    t, p = np.deg2rad(theta_deg), np.deg2rad(phi_deg)
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def in_surface_axes(table: Array, um: float, turn: float = -1.0) -> tuple[Array, Array, Array, Array]:
    """Rows of a wavelength, M/m00 in s and p of the surface, directions to source and receiver.

    `turn` times the azimuth of the reflected beam is undone.
    """
    s = table[table[:, 0] == um]
    m = np.concatenate([np.ones((len(s), 1)), s[:, 6:]], axis=1).reshape(-1, 4, 4)
    m = mueller.rotation(turn * np.deg2rad(s[:, 4])) @ (_OTHER_HANDEDNESS @ m @ _OTHER_HANDEDNESS)
    return s, m, direction(s[:, 1], s[:, 2]), direction(s[:, 3], s[:, 4])


def in_facet_axes(table: Array, um: float, turn: float = -1.0) -> tuple[ScatteringGeometry, Array]:
    """Geometry with y along s of the facet, and M/m00 in those axes."""
    s, m, to_source, to_receiver = in_surface_axes(table, um, turn)
    normal = np.tile([0.0, 0.0, 1.0], (len(s), 1))
    # Axes x = unit(n cross k), y = k cross x are s and p of the surface.
    surface = ScatteringGeometry(normal, to_source, to_receiver, normal)
    return surface.with_up(surface.s_axis), change_frames(m, surface, surface.s_axis)
