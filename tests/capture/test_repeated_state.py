"""A pose that comes again and sees another light is told; noise of a small region is not."""

import numpy as np
import pytest

from acquisition.capture.repeated_state import RepeatedState

BLACK = 64.0


def seen(first: np.ndarray, second: np.ndarray) -> str | None:
    look = RepeatedState(BLACK)
    assert look.look(0, 0.01, (0.0,), first) is None
    return look.look(1, 0.01, (0.0,), second)


def frame(shape: tuple[int, int], seed: int, slope: float = 0.0) -> np.ndarray:
    """About 400 counts of 2.6 electrons, with their noise; `slope` is the change from side to side."""
    light = 400 * (1 + slope * np.linspace(-0.5, 0.5, shape[1])) * np.ones(shape)
    return BLACK + np.random.default_rng(seed).poisson(2.6 * light) / 2.6


@pytest.mark.parametrize("shape", [(24, 32), (32, 40), (64, 80), (600, 600)])
def test_noise_is_no_change_however_small_the_region_is(shape: tuple[int, int]) -> None:
    assert [seen(frame(shape, 2 * k), frame(shape, 2 * k + 1)) for k in range(10)] == [None] * 10


@pytest.mark.parametrize("shape", [(32, 40), (600, 600)])
def test_light_that_changes_from_place_to_place_is_told(shape: tuple[int, int]) -> None:
    warning = seen(frame(shape, 1), frame(shape, 2, slope=0.2))
    assert warning is not None
    assert "state 1 repeats the pose of state 0" in warning
