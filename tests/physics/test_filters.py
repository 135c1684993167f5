"""Filters of images: scipy and OpenCV give the same, and parts of pixels count by their size."""

import numpy as np
import pytest

from processing.computing import filters

IMAGE = np.random.default_rng(0).normal(100, 10, (41, 53)).astype(np.float32)
ODD = np.array([0.2, -0.3, 1.0, 0.4, 0.1])


@pytest.mark.parametrize(
    "run",
    [
        lambda: filters.separable(IMAGE, ODD, ODD[1:4]),
        lambda: filters.separable(IMAGE.astype(float), ODD, ODD[1:4], "reflect"),
        lambda: filters.gaussian(IMAGE, 1.5),
        lambda: filters.box(IMAGE, 7),
    ],
)
def test_without_opencv_the_same(run, monkeypatch):
    fast = run()
    monkeypatch.setattr(filters, "cv2", None)
    slow = run()
    assert slow.dtype == fast.dtype
    assert np.allclose(slow, fast, rtol=3e-6)


def test_parts_are_means_of_their_pixels():
    means = filters.block_means(np.arange(24).reshape(4, 6), 2, 3)
    assert means.tolist() == [[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]]
    assert np.allclose(filters.block_means(np.array([[1.0, 2.0, 6.0]]), 1, 2), [[4 / 3, 14 / 3]])
