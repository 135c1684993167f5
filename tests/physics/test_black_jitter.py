"""What light does in dim pixels is no black level that jitters, however it differs from what it does in bright ones."""

import numpy as np
import pytest
from steady_capture import steady_capture

from processing.diagnosis.captures.noise import black_jitter

STATES, SIDE, SIGMA = 20, 60, 1e-4


def capture(offset, misfit):
    """A bright surface under a dim background that grows brighter downwards, each with a misfit of its own."""
    random = np.random.default_rng(3)
    bright, dim = np.sqrt(STATES) * np.linalg.qr(random.normal(size=(STATES, 2)))[0].T
    light = np.full((SIDE, SIDE), 0.5)
    light[:20] = np.linspace(0.003, 0.009, 20)[:, None]
    lit = light > 0.1
    signal = light * (1 + misfit * np.where(lit, bright[:, None, None], dim[:, None, None]))
    signal = signal + offset * random.normal(size=(STATES, 1, 1)) + SIGMA * random.normal(size=signal.shape)
    return steady_capture(signal, SIGMA)


@pytest.mark.parametrize(("offset", "misfit", "is_jitter"), [(0.0, 0.0, False), (0.0, 0.2, False), (3e-4, 0.0, True)])
def test_an_offset_is_the_same_in_darker_and_brighter_dim_pixels(offset, misfit, is_jitter):
    assert (black_jitter(capture(offset, misfit), np.ones((STATES, 1))) is not None) == is_jitter


@pytest.mark.parametrize("seed", range(4))
def test_whole_counts_of_a_steady_camera_are_no_jitter(seed):
    """The median of whole counts jumps by one where their mean moves by a part of one."""
    random, light = np.random.default_rng(seed), 1 + 0.2 * np.sin(np.arange(STATES))
    counts = np.full((SIDE, SIDE), 2000.0)
    counts[:2] = 20.5
    counts = counts * light[:, None, None] + 1.5 * random.normal(size=(STATES, SIDE, SIDE))
    assert black_jitter(steady_capture(np.rint(counts) / 4095, 1.5 / 4095), light[:, None]) is None


def in_counts(black, read_noise):
    """The same surface as whole counts of twelve bits, on a `black` (N,) level in counts."""
    counts = 4095 * capture(0.0, 0.0).signal[:, 0] + black[:, None, None]
    return np.rint(counts + read_noise * np.random.default_rng(4).normal(size=counts.shape)) / 4095


def test_a_drift_in_whole_counts_leaves_its_steps():
    """The drift is a fault and stays for the fit; the steps beside it belong to no cause."""
    drift = 8 * np.arange(STATES) / (STATES - 1)
    data = steady_capture(in_counts(np.rint(drift), 1.0), 1.0 / 4095)
    jitter = black_jitter(data, np.ones((STATES, 1)))
    assert jitter is not None
    steps = np.rint(drift) - 4095 * jitter[0]
    line = np.polyval(np.polyfit(drift, steps, 1), drift)
    assert np.std(steps - line) < np.std(np.rint(drift) - drift) / 2
    assert np.ptp(line) == pytest.approx(8, abs=0.5)
