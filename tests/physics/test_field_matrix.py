"""A matrix interpolated over the image, against the matrix itself."""

import numpy as np
import pytest

from processing.errors import NotDetermined
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.reduction.solvers.field_matrix import TOLERANCE, FieldMatrix


def test_pseudo_inverse_with_two_retardance_maps(rgb950: InstrumentModel) -> None:
    angles = rotating_retarders(0.01).angles_deg

    def pinv(y: float, x: float) -> np.ndarray:
        generator = rgb950.generator[1].model_copy(update={"retardance_deg": 127.12 + 4 * x - 2 * y + 3 * x * x})
        analyzer = rgb950.analyzer[0].model_copy(update={"retardance_deg": 94.78 + 5 * x * y - 3 * y})
        pixel = rgb950.model_copy(
            update={"generator": (rgb950.generator[0], generator), "analyzer": (analyzer, rgb950.analyzer[1])}
        )
        return np.asarray(np.linalg.pinv(pixel.rows(angles)[:, 0]))

    field = FieldMatrix.of(pinv, "W changes")
    assert len(field.polynomials) < 12  # of the 81 that a grid of 9 x 9 nodes has
    y, x = np.array([-1.0, -0.31, 0.77]), np.array([-0.9, 0.05, 0.4, 1.0])
    weights = field.weights(y, x)
    vector = np.random.default_rng(1).normal(size=40).astype(np.float32)
    columns = np.repeat(vector[:, None], 12, axis=1)
    product = field.times(weights, columns)
    for k in range(12):
        true = pinv(y[k // 4], x[k % 4])
        np.testing.assert_allclose(product[:, k], true @ vector, atol=3 * TOLERANCE * np.abs(true).max() * 40)
        guess = np.einsum("k,krc->rc", weights[:, k], field.stack.reshape(-1, 16, 40))
        assert np.abs(guess - true).max() < 2 * TOLERANCE * np.abs(true).max()


def test_a_matrix_that_changes_too_fast_is_refused() -> None:
    with pytest.raises(NotDetermined, match="W changes so fast"):
        FieldMatrix.of(lambda y, x: np.array([[np.cos(60 * x * y), np.sin(50 * x)]]), "W changes")


def test_units_do_not_matter_and_what_does_not_change_needs_one_matrix() -> None:
    def matrix(y: float, x: float) -> np.ndarray:
        return np.array([[np.cos(y + 0.5 * x), 2.0], [np.sin(x), y]])

    plain, large = FieldMatrix.of(matrix, "W changes"), FieldMatrix.of(lambda y, x: 1e4 * matrix(y, x), "W changes")
    assert len(plain.polynomials) == len(large.polynomials) < 16
    assert plain.stack.dtype == plain.weights(np.zeros(1), np.zeros(1)).dtype == np.float32
    assert len(FieldMatrix.of(lambda y, x: np.eye(3), "W changes").polynomials) == 1
