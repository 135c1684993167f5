"""Lu-Chipman decomposition: depolarizer after retarder after diattenuator, M = Mdelta MR MD.

Lu and Chipman, J. Opt. Soc. Am. A 13, 1106 (1996), Eqs. 42-52. For det M < 0 there is no agreed form
(docs/conventions.md, "Negative determinants"); here MR stays a rotation (det +1) and the 3 x 3 block of Mdelta turns
negative, Eq. 52.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from processing.arrays import RealArray
from processing.computing.threads import for_ranges
from processing.polarization.cloude import as_planar
from processing.polarization.decompositions.polar_kernel import lu_chipman_range


class LuChipman(NamedTuple):
    """Factors of M = depolarizer @ retarder @ diattenuator; NaN where not defined."""

    depolarizer: RealArray
    """(..., 4, 4), m00 = 1, first row (1, 0, 0, 0), symmetric 3 x 3 block."""
    retarder: RealArray
    """(..., 4, 4), a rotation: det +1 always."""
    diattenuator: RealArray
    """(..., 4, 4), symmetric, with the throughput m00 of M. Defined wherever |D| < 1."""
    defined: NDArray[np.bool_]
    """(...): m00 > 0, |D| < 1 and det M not zero. Else retarder and depolarizer are not determined."""
    negative_determinant: NDArray[np.bool_]
    """(...): det M < 0; the depolarizer's 3 x 3 block is then negative definite."""


def lu_chipman(m: RealArray) -> LuChipman:
    """Lu-Chipman decomposition of Mueller matrices (..., 4, 4); the factors have the type of m.

    Linear retarder, half wave plate and rotation come back as themselves, the ideal depolarizer as not defined.

    Parameters
    ----------
    m : array (..., 4, 4)

    Returns
    -------
    LuChipman
        m = depolarizer retarder diattenuator, each (..., 4, 4).

    Examples
    --------
    >>> import numpy as np
    >>> parts = lu_chipman(np.diag([1, 0.5, 0.5, 0.5]))
    >>> np.diag(parts.depolarizer).round(6).tolist(), np.diag(parts.retarder).round(6).tolist()
    ([1.0, 0.5, 0.5, 0.5], [1.0, 1.0, 1.0, 1.0])
    """
    planar, shape = as_planar(m)
    planar = np.ascontiguousarray(planar)
    md, mr, mdelta = (np.empty((16, planar.shape[1]), planar.dtype) for _ in range(3))
    sign = np.empty(planar.shape[1])
    for_ranges(planar.shape[1], lambda start, stop: lu_chipman_range(planar, mdelta, mr, md, sign, start, stop))
    depolarizer, retarder, diattenuator = (
        np.moveaxis(f.reshape(4, 4, *shape), (0, 1), (-2, -1)) for f in (mdelta, mr, md)
    )
    sign = sign.reshape(shape)
    return LuChipman(depolarizer, retarder, diattenuator, ~np.isnan(sign), sign < 0)


def depolarization_power(depolarizer: RealArray) -> RealArray:
    """Lu-Chipman depolarization power 1 - |tr mdelta| / 3 (Eq. 58): 0 for none, 1 for the ideal depolarizer."""
    trace = np.trace(np.asarray(depolarizer)[..., 1:, 1:], axis1=-2, axis2=-1)
    return np.asarray(1 - np.abs(trace) / 3)
