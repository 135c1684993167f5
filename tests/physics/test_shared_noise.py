"""Means of demosaiced pixels in the bins of a table: neighbours share noise, and the error of a mean knows it."""

import numpy as np
import pytest

from processing.reduction.mosaic.demosaic import demosaic
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.mosaic.noise import neighbour_correlation, stokes_covariance
from processing.reflectance.shared_noise import shared_variance

ANALYZERS = 0.5 * np.array([[1.0, 1, 0], [1, 0, 1], [1, -1, 0], [1, 0, -1]])
LAYOUT = MosaicLayout.of((("90", "45"), ("135", "0")), ("0", "45", "90", "135"), ANALYZERS)
SOLVE = np.linalg.pinv(ANALYZERS)
LIGHT, READ = np.array([4000.0, 600, -300]), 2.3


def test_it_is_the_sum_over_all_pairs_of_a_bin():
    rng = np.random.default_rng(1)
    bins, stderr = rng.integers(-1, 3, size=(9, 7)), rng.uniform(1, 2, size=(9, 7))
    stderr[2, 3] = np.nan
    correlation = rng.uniform(0.1, 0.5, size=(5, 5))
    correlation = (correlation + correlation[::-1, ::-1]) / 2
    correlation[2, 2] = 1
    expected = np.zeros((9, 7))
    for y, x in np.ndindex(9, 7):
        for v, u in np.ndindex(9, 7):
            near = abs(v - y) <= 2 and abs(u - x) <= 2
            if near and bins[y, x] == bins[v, u] >= 0 and np.isfinite(stderr[y, x] * stderr[v, u]):
                expected[y, x] += correlation[2 + v - y, 2 + u - x] * stderr[y, x] * stderr[v, u]
    np.testing.assert_allclose(shared_variance(bins, stderr, correlation), expected)


@pytest.mark.parametrize("method", ["superpixel", "bilinear", "difference", "oriented"])
@pytest.mark.parametrize("block", [(1, 2), (2, 2), (4, 5)])
def test_pulls_of_means_have_unit_variance(method, block):
    size = (160, 200)
    rng = np.random.default_rng(4)
    expected = np.empty(size)
    for level, (r, c) in zip(ANALYZERS @ LIGHT, LAYOUT.offsets, strict=True):
        expected[r::2, c::2] = level
    frame = (rng.poisson(expected) + rng.normal(0, READ, size)).astype(np.float32)
    channels = demosaic(frame, LAYOUT, method)
    s1 = np.tensordot(SOLVE[1], channels, axes=1)
    variance = np.maximum(channels, 0) + np.float32(READ**2)
    stderr = np.sqrt(stokes_covariance(variance, LAYOUT, method, SOLVE, frame=frame)[1])
    correlation = neighbour_correlation(LAYOUT, method, tuple(map(tuple, SOLVE.tolist())))
    y, x = np.indices(s1.shape)
    bins = (y // block[0]) * 1000 + x // block[1]
    shared = shared_variance(bins, stderr, correlation)

    def means(values: np.ndarray) -> np.ndarray:
        blocks = values[: s1.shape[0] // block[0] * block[0], : s1.shape[1] // block[1] * block[1]]
        return blocks.reshape(-1, block[0], blocks.shape[1] // block[1], block[1]).mean(axis=(1, 3))

    pull = (means(s1) - LIGHT[1]) / np.sqrt(means(shared) / (block[0] * block[1]))
    naive = (means(s1) - LIGHT[1]) / np.sqrt(means(stderr**2) / (block[0] * block[1]))
    assert np.sqrt(np.mean(pull**2)) == pytest.approx(1, abs=0.1)
    if method != "superpixel":
        assert np.sqrt(np.mean(naive**2)) > 1.2
