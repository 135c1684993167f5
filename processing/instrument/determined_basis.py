"""The part of a Mueller matrix that an instrument determines: all 16 elements, or fewer for a partial polarimeter."""

import numpy as np

from processing.arrays import Array, BoolArray
from processing.instrument.model import InstrumentModel

#: States drawn to find out: more than any rank, at angles without regularity.
DRAWN = 400
#: Relative size of a singular value that counts.
LEAST = 1e-8


def determined_basis(model: InstrumentModel) -> Array:
    """Orthonormal basis (16, rank) of the matrices that the instrument determines; `model` is at a wavelength.

    Its span is that of all rows kron(a, g): 16 for two turning retarders, 4 for a Stokes polarimeter, 9 where only
    linear polarization is sent and analyzed.
    """
    random = np.random.default_rng(0)
    ideal = model.model_copy(update={"effects": ()})
    drawn = {axis: random.uniform(0, 360, DRAWN) for axis in model.axes}
    w = ideal.rows(drawn if model.measured is None else model.measured.angles_deg).reshape(-1, 16)
    _, size, vt = np.linalg.svd(w, full_matrices=False)
    basis = np.asarray(vt[size > LEAST * size[0]].T)
    return np.eye(16) if basis.shape[1] == 16 else basis


def determined_elements(basis: Array) -> BoolArray:
    """(16,) True for elements of M that lie in the span of the basis: they are determined each by itself."""
    return np.asarray(np.sum(basis**2, axis=1) > 1 - 1e-9)
