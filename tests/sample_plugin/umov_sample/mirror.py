"""A perfect mirror: the dominant process does not depend on the angles."""

from typing import Literal

import numpy as np
from pydantic import BaseModel

from processing.arrays import Array, ComplexArray
from processing.geometry.frames import ScatteringGeometry
from processing.reflectance.base import normalized_mueller


class Model(BaseModel):
    """diag(1, 1, -1, -1) everywhere."""

    kind: Literal["sample_mirror"] = "sample_mirror"
    name: str
    wavelengths_nm: tuple[float, ...] = ()

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2)."""
        return np.broadcast_to(np.diag([1.0 + 0j, -1]), (*np.shape(geometry.normal)[:-1], 2, 2))

    def mueller_jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Mueller matrices (..., 4, 4)."""
        return normalized_mueller(self.jones(geometry, wavelength_nm))
