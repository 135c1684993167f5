"""A perfect mirror: the dominant process does not depend on the angles."""

from typing import Literal

import numpy as np
from pydantic import BaseModel

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry


class Model(BaseModel):
    """diag(1, 1, -1, -1) everywhere."""

    kind: Literal["sample_mirror"] = "sample_mirror"
    name: str
    wavelengths_nm: tuple[float, ...] = ()

    def mueller_jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Mueller matrices (..., 4, 4)."""
        shape = np.shape(geometry.normal)[:-1]
        return np.broadcast_to(np.diag([1.0, 1, -1, -1]), (*shape, 4, 4))
