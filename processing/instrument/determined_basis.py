"""The part of a Mueller matrix that an instrument determines: all 16 elements, or fewer for a partial polarimeter."""

import numpy as np

from processing.arrays import Array, BoolArray
from processing.instrument.model import InstrumentModel

#: States drawn to find out: more than any rank, at angles without regularity.
DRAWN = 400
#: Relative size of a singular value that counts.
LEAST = 1e-8
#: Relative difference of generator states that is rounding of what the axes read.
ALIKE = 1e-6


def determined_basis(model: InstrumentModel) -> Array:
    """Orthonormal basis (16, rank) of the matrices that the instrument determines; `model` is at a wavelength.

    Its span is that of all rows kron(a, g): 16 for two turning retarders, 4 for a Stokes polarimeter, 9 where only
    linear polarization is sent and analyzed.
    """
    _, size, vt = np.linalg.svd(_drawn_rows(model), full_matrices=False)
    basis = np.asarray(vt[size > LEAST * size[0]].T)
    return np.eye(16) if basis.shape[1] == 16 else basis


def has_one_light(model: InstrumentModel) -> bool:
    """Whether every state lights the sample alike, as a Stokes polarimeter does; `model` is at a wavelength."""
    size = np.linalg.svd(_drawn_rows(model).reshape(-1, 4), compute_uv=False)
    return bool(size[1] <= ALIKE * size[0])


def _drawn_rows(model: InstrumentModel) -> Array:
    """Rows (states, 16) of W at angles drawn at random, or at those where W was measured."""
    random = np.random.default_rng(0)
    ideal = model.model_copy(update={"effects": ()})
    drawn = {axis: random.uniform(0, 360, DRAWN) for axis in model.axes}
    return ideal.rows(drawn if model.measured is None else model.measured.angles_deg).reshape(-1, 16)


def determined_elements(basis: Array) -> BoolArray:
    """(16,) True for elements of M that lie in the span of the basis: they are determined each by itself."""
    return np.asarray(np.sum(basis**2, axis=1) > 1 - 1e-9)
