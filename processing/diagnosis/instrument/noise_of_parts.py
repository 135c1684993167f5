"""What noise gives of the squares of a residual, and how that changes with the matrix and with the corrections.

The noise of feature f of row l reaches the corrected counts as c_f n_f, or as c_f H n_f where f is a derivative, which
is one of the fitted image (H = Q Q^T); the residual is P of that. Q is much narrower than H, so products go through it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array


class NoiseOfParts:
    """Noise of T parts of an image, each projected with a matrix of its own.

    Attributes
    ----------
    of_features : (T, F, L) mean product of the residual's noise with that of each feature, as it reaches each row.
    """

    def __init__(self, noise: Array, q: Array, outside: Array, c: Array, around: NDArray[np.bool_]) -> None:
        """noise (T, L, F, F), q (T, L, K), outside P (T, L, L), c (T or 1, F, L); `around` (F,): the derivatives."""
        self._noise, self._q, self._outside = noise, q, outside
        self._plain, self._around = np.flatnonzero(~around), np.flatnonzero(around)
        self._moving = self._around[np.any(c[:, self._around], axis=(0, 2))]
        self._c = c.swapaxes(1, 2)
        # (T, L, F): the noise of each feature with that of the features of the pixel itself, as they are joined.
        self._joined = np.einsum("tlg,tlfg->tlf", self._c[..., self._plain], noise[..., self._plain])
        self.of_features = self._of_features().swapaxes(1, 2)

    def _of_features(self) -> Array:
        own = np.diagonal(self._outside, axis1=1, axis2=2)[..., None]
        out = np.asarray(own * self._joined)
        if not self._around.size:
            return out
        hat = self._q @ self._q.transpose(0, 2, 1)
        out[..., self._around] = (hat * self._outside) @ self._joined[..., self._around]
        if self._moving.size:
            narrow = self._outside[:, None] @ (self._q[:, None] * self._by_feature(self._c[..., self._moving]))
            # (T, M, L, L): from the noise of each row to the residual, by way of each derivative.
            takes = narrow @ self._q.transpose(0, 2, 1)[:, None]
            noise = self._noise[..., self._moving]
            here = np.diagonal(takes, axis1=2, axis2=3).swapaxes(1, 2)
            out[..., self._plain] += np.einsum("tlm,tlfm->tlf", here, noise[:, :, self._plain])
            # One product over rows and derivatives.
            wide = (hat[:, None] * takes).swapaxes(1, 2).reshape(*hat.shape[:2], -1)
            of_around = noise[:, :, self._around].transpose(0, 3, 1, 2)
            out[..., self._around] += wide @ of_around.reshape(len(hat), -1, self._around.size)
        return out

    def carried(self, back: Array) -> Array:
        """Mean product (T, L, L) of the residual's noise with that of the counts, times back (T, L, K)."""
        plain, moving = self._plain, self._moving
        out = np.sum(self._c[..., plain] * self._joined[..., plain], axis=2)[..., None] * back
        if moving.size:
            c = self._by_feature(self._c[..., moving])
            back_of = fitted(self._q[:, None], c * back[:, None])
            joined = self._by_feature(self._joined[..., moving])
            out += np.sum(joined * back_of, axis=1)
            noise = self._noise[:, :, moving][..., moving]
            whole = joined * back[:, None] + np.einsum("tlfg,tflk->tglk", noise, back_of)
            out += np.sum(c * fitted(self._q[:, None], whole), axis=1)
        return np.asarray(self._outside @ out)

    @staticmethod
    def _by_feature(x: Array) -> Array:
        """(T, M, L, 1) of (T, L, M)."""
        return np.asarray(x.swapaxes(1, 2)[..., None])


def fitted(q: Array, x: Array) -> Array:
    """Q Q^T x (..., L, R) of orthonormal directions q (..., L, K)."""
    return np.asarray(q @ (q.swapaxes(-1, -2) @ x))
