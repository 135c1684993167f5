"""The triply degenerate (TD) Mueller matrix: a Mueller-Jones matrix and an ideal depolarizer.

Q. Jarecki and M. Kupinski, *Efficient Modeling of Depolarizing Mueller BRDFs*, Eq. 1.
"""

import numpy as np
from numpy.typing import ArrayLike

from processing.arrays import RealArray


def mueller_matrix(m0: ArrayLike, xi0: ArrayLike, m00: ArrayLike = 1.0) -> RealArray:
    """M = 4 M00/3 [(xi0 - 1/4) m0 + (1 - xi0) mID].

    Parameters
    ----------
    m0 : (..., 4, 4), dominant Mueller-Jones matrix, its element 00 equal to 1.
    xi0 : (...), largest coherency eigenvalue; 1/4 is the ideal depolarizer, 1 is m0 alone.
    m00 : (...), throughput for unpolarized light.
    """
    m = np.asarray(m0)
    xi, t = np.asarray(xi0), np.asarray(m00)
    out = np.asarray(m * ((4.0 * t / 3.0) * (xi - 0.25))[..., None, None])
    out[..., 0, 0] += (4.0 * t / 3.0) * (1.0 - xi)
    return out
