"""Spherical purity P_S: the part of the polarimetric purity that no polarizance carries; 1 for a retarder.

|m| / (sqrt 3 m00) of the lower right 3 x 3 block m (Gil, *Components of purity of a Mueller matrix*, JOSA A 28, 1578,
2011). With the polarizance purity P_P: depolarization index^2 = 2/3 P_P^2 + P_S^2.
"""

import numpy as np

from processing.arrays import RealArray

#: It is the length of the vector of these elements over m00, apart from a factor.
ELEMENTS = (5, 6, 7, 9, 10, 11, 13, 14, 15)


def value(m: RealArray) -> RealArray:
    """P_S of Mueller matrices (..., 4, 4): (...)."""
    block = np.asarray(m)[..., 1:, 1:]
    return np.asarray(np.sqrt(np.square(block).sum(axis=(-2, -1)) / 3) / np.asarray(m)[..., 0, 0])


def gradient(m: RealArray) -> RealArray:
    """Gradient (..., 16) by the Mueller elements."""
    m = np.asarray(m, dtype=float)
    slope, size, m00 = np.zeros(m.shape), value(m), m[..., 0, 0]
    slope[..., 1:, 1:] = m[..., 1:, 1:] / (3 * size * m00**2)[..., None, None]
    slope[..., 0, 0] = -size / m00
    return slope.reshape(*m.shape[:-2], 16)
