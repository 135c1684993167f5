"""Filters of images and moves by fractions of a pixel: scipy and OpenCV give the same."""

import numpy as np
import pytest

from processing.computing import filters
from processing.diagnosis.instrument.features import derivatives_of_part, shared_noise
from processing.reduction.move_image import neighbour_noise, shifted_back

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


def picture(x, y):
    return np.sin(x / 1.5) * np.cos(y / 2.1) + 0.3 * x / 60


@pytest.mark.parametrize("shift", [(0.7, -1.3), (0.0, 0.5), (-2.2, 0.1)])
def test_a_moved_picture_comes_back(shift):
    y, x = np.mgrid[0:60, 0:60].astype(float)
    back = shifted_back(picture(x - shift[0], y - shift[1]), *shift)
    off = np.abs(back - picture(x, y))
    assert off[8:-8, 8:-8].max() < 1e-3
    assert off[3:-3, 3:-3].max() < 2e-2


def test_a_slight_blur_is_taken_off_and_one_below_zero_is_added():
    y, x = np.mgrid[0:60, 0:60].astype(float)
    sharp, wave = picture(x, y), picture(x, y) - 0.3 * x / 60
    blurred = sharp + wave * (np.exp(-0.2 / 2 * (1 / 1.5**2 + 1 / 2.1**2)) - 1)
    inner = (slice(8, -8), slice(8, -8))
    worse = np.abs(blurred - sharp)[inner].max()
    assert np.abs(shifted_back(blurred, 0.0, 0.0, 0.2) - sharp)[inner].max() < 0.15 * worse
    assert np.abs(shifted_back(sharp, 0.0, 0.0, -0.2) - blurred)[inner].max() < 0.15 * worse


def test_whole_pixels_are_exact():
    image = np.random.default_rng(0).normal(size=(30, 40)).astype(np.float32)
    assert shifted_back(image, 2.0, -1.0)[5:-5, 5:-5] == pytest.approx(
        np.roll(image, (1, -2), (0, 1))[5:-5, 5:-5], abs=1e-4
    )
    assert shared_noise(2.0, -1.0) == pytest.approx(shared_noise(0.0, 0.0), abs=1e-6)
    assert neighbour_noise(2.0, -1.0) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (0.2, -0.4)])
def test_noise_of_pixels_and_derivatives_after_moving(shift):
    moved = shifted_back(np.random.default_rng(1).normal(size=(900, 900)), *shift)
    inner = slice(20, -20)
    slopes = derivatives_of_part(moved[None], *(slice(20, n - 20) for n in moved.shape))
    parts = np.concatenate([moved[None, None, inner, inner], slopes]).reshape(6, -1)
    # The slowest of these patterns, seven pixels wide, have some ten thousand independent values.
    assert parts @ parts.T / parts.shape[1] == pytest.approx(shared_noise(*shift), abs=0.005)
    rows, columns = np.mean(moved[1:] * moved[:-1]), np.mean(moved[:, 1:] * moved[:, :-1])
    assert (rows, columns) == pytest.approx(neighbour_noise(*shift), abs=0.005)
