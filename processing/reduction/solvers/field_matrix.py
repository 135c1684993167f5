"""A matrix that varies smoothly over the image, as a few fixed matrices weighted by polynomials of the place.

Building and inverting W for each pixel would take minutes. The matrix is worked out at Chebyshev nodes of the image;
a singular value decomposition of these samples leaves as many fixed matrices as the wanted precision needs (of the
pseudo-inverse 3 with one retarder that varies by 16 degrees, 9 with two), and a pixel costs one product with them.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from processing.arrays import Array
from processing.errors import NotDetermined

#: Largest error of an interpolated matrix, relative to its largest element.
TOLERANCE = 1e-5
NODES = (5, 7, 9, 12, 16)


@dataclass(frozen=True)
class FieldMatrix:
    """Matrix (rows, columns) at every place of the image.

    Attributes
    ----------
    stack : (K * rows, columns), the K fixed matrices one below the other.
    polynomials : (K, n, n), Chebyshev coefficients over y and x of the weight of each.
    """

    stack: NDArray[np.float32]
    polynomials: Array

    @classmethod
    def of(cls, matrix: Callable[[float, float], Array], what: str) -> "FieldMatrix":
        """Interpolate `matrix(y, x)`, y and x from -1 to 1, down and to the right.

        Raises NotDetermined: the matrix changes too fast over the image; the message begins with `what`.
        """
        trials = np.random.default_rng(0).uniform(-1, 1, (8, 2))
        true = np.stack([matrix(y, x) for y, x in trials])
        worst = np.inf
        for nodes in NODES:
            axis = chebyshev.chebpts1(nodes)
            samples = np.stack([matrix(y, x) for y in axis for x in axis])
            left, values, right = np.linalg.svd(samples.reshape(nodes**2, -1), full_matrices=False)
            # What is left out adds up to less than a part of the tolerance in any element of any sample.
            tail = np.sqrt(np.cumsum(values[::-1] ** 2)[::-1])
            kept = max(1, int(np.sum(tail > 0.2 * TOLERANCE * np.abs(samples).max())))
            back = np.linalg.inv(chebyshev.chebvander(axis, nodes - 1))
            grid = (left[:, :kept] * values[:kept]).T.reshape(kept, nodes, nodes)
            found = cls(
                np.ascontiguousarray(right[:kept].reshape(-1, samples.shape[-1]), dtype=np.float32),
                np.einsum("ay,kyx,bx->kab", back, grid, back),
            )
            weights = np.concatenate([found.weights(y[None], x[None]) for y, x in trials], axis=1)
            guess = np.einsum("kp,krc->prc", weights, found.stack.reshape(kept, *true.shape[1:]))
            worst = float(np.max(np.abs(guess - true)) / np.max(np.abs(true)))
            if worst < TOLERANCE:
                return found
        raise NotDetermined(
            f"{what} so fast that {NODES[-1]} nodes each way leave an error of {worst:.1g}; check its coefficients."
        )

    def weights(self, y: Array, x: Array) -> NDArray[np.float32]:
        """Weights (K, len(y) * len(x)) of the fixed matrices at rows y and columns x of the image, each -1 to 1."""
        last = self.polynomials.shape[1] - 1
        down, across = chebyshev.chebvander(y, last), chebyshev.chebvander(x, last).T
        rows = np.tensordot(down, self.polynomials, axes=([1], [1]))
        return np.ascontiguousarray((rows @ across).transpose(1, 0, 2).reshape(len(self.polynomials), -1), np.float32)

    def times(self, weights: NDArray[np.float32], columns: NDArray[np.float32]) -> NDArray[np.float32]:
        """The matrix of each pixel times its column (columns, pixels): (rows, pixels)."""
        each = (self.stack @ columns).reshape(len(weights), -1, columns.shape[1])
        each *= weights[:, None]
        return np.asarray(each.sum(axis=0))
