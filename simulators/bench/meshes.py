"""Meshes made here for tests and demonstrations; no scanned object is at hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def write_bumpy_body(path: Path | str, radius_mm: float = 12.0, subdivisions: int = 4) -> None:
    """Write a closed, asymmetric, bumpy body of about the size of the sphere (STL, OBJ or PLY by its name)."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    x, y, z = ball.vertices.T
    bumps = 1 + 0.12 * np.sin(3 * x + 1) * np.cos(2 * y) + 0.10 * x * y + 0.08 * np.sin(4 * y + 2 * z)
    ball.vertices = ball.vertices * (radius_mm * bumps)[:, None] * np.array([1.0, 0.85, 0.9])
    ball.export(path)
