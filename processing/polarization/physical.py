"""Physical Mueller matrices near a measured one: coherency matrix without negative eigenvalues.

Noise makes a measured matrix of a weakly depolarizing sample unphysical. These estimates go beside the plain one,
never in its place: they are biased where the truth is near the border.
"""

import numpy as np
from numpy.typing import NDArray

from processing.polarization.mueller import coherency, coherency_to_mueller

#: Pixels handled at a time by the iteration.
BATCH = 4096
MAX_STEPS = 300
#: The iteration ends where no element moves by more than this part of its standard error.
TOLERANCE = 1e-3
#: Over-relaxation; 1.5 to 1.8 halves the number of steps (Boyd et al., Sec. 3.4.3).
RELAXATION = 1.7


def nearest(m: NDArray[np.floating]) -> NDArray[np.floating]:
    """Nearest physical Mueller matrix in the Frobenius norm.

    Negative eigenvalues of the coherency matrix become zero. The map from Mueller to coherency matrices keeps
    Frobenius distances up to a factor, so this is the nearest in the space of Mueller matrices too.

    Parameters
    ----------
    m : (16, pixels), row-major elements in planes.

    Returns
    -------
    (16, pixels), same type; NaN where an element is not finite.
    """
    out = np.full(m.shape, np.nan, m.dtype)
    good = np.flatnonzero(np.isfinite(m).all(axis=0))
    for part in np.array_split(good, -(-good.size // BATCH) or 1):
        out[:, part] = _project(m[:, part].T.astype(float)).T
    return out


def most_likely(m: NDArray[np.floating], information: NDArray[np.floating]) -> NDArray[np.floating]:
    """Physical Mueller matrix of highest likelihood, for Gaussian noise.

    Minimizes (x - m)^T F (x - m) over the physical x, F being the inverse covariance of the weighted estimate m, by
    the alternating direction method of multipliers (Boyd et al., Found. Trends Mach. Learn. 3, 1, 2011, Sec. 5).

    Parameters
    ----------
    m : (16, pixels), the weighted estimate.
    information : (136, pixels), F packed as in `weighted_kernels`.

    Returns
    -------
    (16, pixels); equal to m where m is physical, NaN where it is not finite.
    """
    out = np.asarray(m).copy()
    good = np.flatnonzero(np.isfinite(m).all(axis=0))
    matrices = m[:, good].T.astype(float).reshape(-1, 4, 4)
    outside = good[np.linalg.eigvalsh(coherency(matrices))[:, 0] < 0]
    rows, columns = np.tril_indices(16)
    for part in np.array_split(outside, -(-outside.size // BATCH) or 1):
        f = np.empty((len(part), 16, 16))
        f[:, rows, columns] = information[:, part].T
        f[:, columns, rows] = information[:, part].T
        out[:, part] = _constrained(m[:, part].T.astype(float), f).T
    return out


def _constrained(m: NDArray[np.float64], f: NDArray[np.float64]) -> NDArray[np.float64]:
    # Whitened by the mean information, so that one penalty suits all pixels.
    scale = np.trace(f, axis1=1, axis2=2)[:, None, None] / 16
    errors = np.sqrt(np.einsum("pii->pi", np.linalg.inv(f)))
    f = f / scale
    solve = np.linalg.inv(f + np.eye(16))
    pull = np.einsum("pij,pj->pi", f, m)
    z, dual = _project(m), np.zeros_like(m)
    active = np.arange(len(m))
    for _ in range(MAX_STEPS):
        x = np.einsum("pij,pj->pi", solve[active], pull[active] + z[active] - dual[active])
        x = RELAXATION * x + (1 - RELAXATION) * z[active]
        new = _project(x + dual[active])
        dual[active] += x - new
        moved = np.maximum(np.abs(new - z[active]), np.abs(new - x)) / errors[active]
        z[active] = new
        active = active[moved.max(axis=1) > TOLERANCE]
        if active.size == 0:
            break
    return z


def _project(m: NDArray[np.float64]) -> NDArray[np.float64]:
    values, vectors = np.linalg.eigh(coherency(m.reshape(-1, 4, 4)))
    h = np.einsum("pik,pk,pjk->pij", vectors, np.maximum(values, 0.0), vectors.conj(), optimize=True)
    return coherency_to_mueller(h).reshape(-1, 16)
