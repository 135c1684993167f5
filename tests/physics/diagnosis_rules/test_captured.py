"""Constants by which noise is told, and by which something is left out of a capture."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, decides

from processing.diagnosis.captured import black_jitter

STATES = 40


def jitters(dim: float = 0.01, pixels: int = 60, deviations: float = 20.0) -> bool:
    """Whether a black level is seen that jitters by so many standard deviations, where so many pixels are dim."""
    offsets = np.random.default_rng(0).normal(size=STATES)
    offsets -= offsets.mean()
    # Noise of dim pixels is as it should be: the median is exact, and half of them are within its scatter.
    noise = 1e-4 * np.tile([-2.0, -1.0, 0.0, 1.0, 2.0], pixels)[:pixels]
    noise = np.sort(noise) - np.median(noise)
    scatter = np.median(np.abs(noise)) / black_jitter.NORMAL_MAD
    of_median = black_jitter.MEDIAN * scatter**2 / pixels
    free = STATES - 1
    offsets *= np.sqrt(of_median * (free + deviations * np.sqrt(2 * free)) / np.sum(offsets**2))
    signal = np.ones((STATES, 1, 1, 2 * pixels))
    signal[..., pixels:] = dim + noise
    data = Some(
        signal=signal + offsets[:, None, None, None],
        usable=np.ones((1, 2 * pixels), dtype=bool),
        clipped=np.zeros((1, 2 * pixels), dtype=bool),
        row_counts=np.ones(STATES, dtype=bool),
        values_per_pixel=STATES,
    )
    return black_jitter.black_jitter(data, np.ones((STATES, 1))) is not None


@decides
def test_noise_sure(m: Patch) -> bool:
    return jitters(deviations=6.5) and not jitters(deviations=5.5)


@decides
def test_dim(m: Patch) -> bool:
    return jitters(dim=0.047) and not jitters(dim=0.053)


@decides
def test_fewest_dim(m: Patch) -> bool:
    return jitters(pixels=30) and not jitters(pixels=29)
