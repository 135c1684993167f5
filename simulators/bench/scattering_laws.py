"""How depolarization and throughput of a simulated surface depend on its scattering geometry.

These are statements about an invented surface, not results: Jarecki and Kupinski give no law for xi0 or M00.
"""

from typing import Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry, dot
from processing.polarization import mueller
from processing.section import Section


class Xi0Law(Section):
    """xi0 = base + lobe exp(-(theta_h/width)^2) + rise sin^2(theta_d): largest near specular and at grazing."""

    base: float = Field(ge=0.25, le=1, description="value without the lobe")
    lobe: float = Field(default=0.0, ge=0, description="height of the specular lobe")
    width_deg: float = Field(default=25.0, gt=0, description="width of the lobe, degrees")
    rise: float = Field(default=0.0, ge=0, description="change towards grazing angles")

    @model_validator(mode="after")
    def _physical(self) -> Self:
        if self.base + self.lobe + self.rise > 1:
            raise ValueError("base + lobe + rise exceeds 1, the largest value of xi0")
        return self

    def __call__(self, geometry: ScatteringGeometry) -> Array:
        """xi0 (...) at the points."""
        th, td, _ = geometry.angles
        lobe = np.exp(-((th / np.deg2rad(self.width_deg)) ** 2))
        return np.asarray(self.base + self.lobe * lobe + self.rise * np.sin(td) ** 2)


class M00Law(Section):
    """M00 = albedo cos(theta_i) + lobe exp(-(theta_h/width)^2), a fraction of a perfect white surface."""

    albedo: float = Field(ge=0, le=1, description="throughput without the lobe")
    lobe: float = Field(default=0.0, ge=0, description="height of the specular lobe")
    width_deg: float = Field(default=12.0, gt=0, description="width of the lobe, degrees")

    def __call__(self, geometry: ScatteringGeometry) -> Array:
        """M00 (...) at the points."""
        th = geometry.angles.theta_h
        lobe = np.exp(-((th / np.deg2rad(self.width_deg)) ** 2))
        return np.asarray(self.albedo * dot(geometry.normal, geometry.to_source) + self.lobe * lobe)


def split_eigenvalues(m: Array, jones: NDArray[np.complex128], shift: Array) -> Array:
    """Add to TD matrices what takes their three small eigenvalues apart, by (+shift, 0, -shift).

    Parameters
    ----------
    m : (N, 4, 4), TD Mueller matrices with dominant Jones matrix `jones` (N, 2, 2).
    shift : (N,), of the eigenvalues normalized to sum 1; smaller than each of them.

    Notes
    -----
    The eigenvectors of the small eigenvalues are columns of the Householder reflection that takes the first
    axis to vec(J0). Which basis of that subspace a real surface prefers is not known; this one is arbitrary.
    """
    v = jones.reshape(-1, 4)
    v = v / np.linalg.norm(v, axis=-1, keepdims=True)
    # The phase of a Jones matrix is free; a real, negative first element keeps the reflection well-conditioned.
    first = v[:, :1]
    size = np.abs(first)
    v = v * np.where(size > 0, -first.conj() / np.where(size > 0, size, 1), 1)
    w = -v
    w[:, 0] += 1
    w /= np.linalg.norm(w, axis=-1, keepdims=True)
    eye = np.eye(4)
    plus, minus = (eye[k] - 2 * w * w[:, k : k + 1].conj() for k in (1, 3))
    h = plus[:, :, None] * plus[:, None, :].conj() - minus[:, :, None] * minus[:, None, :].conj()
    # A unit eigenvector gives m00 = 1/2 (docs/conventions.md, "Coherency matrix"): twice that times the throughput.
    scale = 2 * m[:, 0, 0] * shift
    return np.asarray(m + scale[:, None, None] * mueller.coherency_to_mueller(h))
