"""Polarizance purity P_P: root mean square of diattenuation and polarizance; 1 for a polarizer, 0 for a retarder.

sqrt((D^2 + P^2) / 2), the other part of the purity (Gil, *Components of purity of a Mueller matrix*, JOSA A 28, 1578,
2011).
"""

import numpy as np

from processing.arrays import RealArray

#: It is the length of the vector of these elements over m00, apart from a factor.
ELEMENTS = (1, 2, 3, 4, 8, 12)


def value(m: RealArray) -> RealArray:
    """P_P of Mueller matrices (..., 4, 4): (...)."""
    m = np.asarray(m)
    square = np.square(m[..., 0, 1:]).sum(axis=-1) + np.square(m[..., 1:, 0]).sum(axis=-1)
    return np.asarray(np.sqrt(square / 2) / m[..., 0, 0])
