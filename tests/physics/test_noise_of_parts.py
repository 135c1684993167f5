"""The noise of a residual, against the covariance of every feature of every row written out."""

import numpy as np
import pytest

from processing.diagnosis.instrument.projection import Projected

FEATURES, ROWS, COLUMNS = 5, 7, 3


@pytest.mark.parametrize("derivatives", [0, 2])
def test_noise_reaches_the_residual_through_the_fitted_image_where_a_feature_is_a_derivative(derivatives):
    random = np.random.default_rng(2)
    around = np.arange(FEATURES) >= FEATURES - derivatives
    root = random.normal(size=(ROWS, FEATURES, FEATURES))
    noise, a = root @ root.transpose(0, 2, 1), random.normal(size=(ROWS, COLUMNS))
    z, c = random.normal(size=(FEATURES, ROWS, 4)), random.normal(size=(FEATURES, ROWS))
    part = Projected(z[None], noise[None], a[None], c[None], around=around)

    hat = a @ np.linalg.pinv(a)
    outside = np.eye(ROWS) - hat
    # (rows of the counts, features, rows of the noise)
    onto = np.stack([c[f][:, None] * (hat if around[f] else np.eye(ROWS)) for f in range(FEATURES)], axis=1)
    onto_residual = np.einsum("ij,jfl->ifl", outside, onto)
    mean = np.einsum("igl,lfg->ifl", onto_residual, noise)
    assert part.expected[0] == pytest.approx(np.sum(onto_residual * mean))

    da, dc = random.normal(size=(2, 1, ROWS, COLUMNS)), random.normal(size=(2, 1, FEATURES, ROWS))
    moved = [
        np.stack([dc[j, 0, f][:, None] * (hat if around[f] else np.eye(ROWS)) for f in range(FEATURES)], axis=1)
        - np.einsum("ij,jfl->ifl", da[j, 0] @ np.linalg.pinv(a), onto)
        for j in range(2)
    ]
    _, pull, _ = part.slopes(da, dc)
    assert pull == pytest.approx([np.sum(mean * each) for each in moved])
