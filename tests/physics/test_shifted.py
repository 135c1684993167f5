"""Images moved by fractions of a pixel."""

import numpy as np
import pytest

from processing.shifted import noise_left, shifted_back


def picture(x, y):
    return np.sin(x / 1.5) * np.cos(y / 2.1) + 0.3 * x / 60


@pytest.mark.parametrize("shift", [(0.7, -1.3), (0.0, 0.5), (-2.2, 0.1)])
def test_a_moved_picture_comes_back(shift):
    y, x = np.mgrid[0:60, 0:60].astype(float)
    back = shifted_back(picture(x - shift[0], y - shift[1]), *shift)
    off = np.abs(back - picture(x, y))
    assert off[8:-8, 8:-8].max() < 1e-3
    assert off[3:-3, 3:-3].max() < 2e-2


def test_whole_pixels_are_exact():
    image = np.random.default_rng(0).normal(size=(30, 40)).astype(np.float32)
    assert shifted_back(image, 2.0, -1.0)[5:-5, 5:-5] == pytest.approx(
        np.roll(image, (1, -2), (0, 1))[5:-5, 5:-5], abs=1e-4
    )
    assert noise_left(2.0, -1.0) == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize("shift", [(0.5, 0.5), (0.2, -0.4)])
def test_noise_that_interpolation_leaves(shift):
    noise = np.random.default_rng(1).normal(size=(500, 500))
    assert shifted_back(noise, *shift).var() == pytest.approx(noise_left(*shift), rel=0.02)
