"""Error bars without a known gain: from the residuals of all pixels, and from a pixel's own where they differ."""

import numpy as np
import pytest

from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Product, Step

SHAPE, READ, LIGHT = (24, 32), 3.0, 600.0


def pulls(synthetic_capture, configs, out, states, angles_deg, is_unlike=None, is_masked=None):
    """Errors of a Stokes image over its error bars (4, rows, columns); of `is_unlike` pixels the light flickers."""
    random = np.random.default_rng(states)
    rows = [(mueller.polarizer(0.0) @ mueller.retarder(np.deg2rad(a), np.deg2rad(131.8)))[0] for a in angles_deg]
    light = np.array([1.0, 0.3, -0.2, 0.4])[:, None, None] * np.broadcast_to(LIGHT * np.linspace(0.5, 2, 32), SHAPE)
    frames = random.poisson(np.tensordot(rows, light, axes=1)) + random.normal(0, READ, (states, *SHAPE)) + 100
    if is_unlike is not None:
        frames[:, is_unlike] *= random.uniform(0.7, 1.3, (states, np.sum(is_unlike)))
    if is_masked is not None:
        frames[:, is_masked] = 100
    frames = np.round(frames).astype(np.uint16)[:, None]
    path = synthetic_capture(frames, {"psa": angles_deg}, detector={"black_level_counts": 100, "bits": 16})
    model = InstrumentModel.load(configs / "instruments/rotating_retarder_stokes.yaml").at(662)
    with Capture(path) as capture:
        facts = reduce_mueller(capture, model, out, (Step("reduce", {}),))
    assert "the gain is not known" in facts["noise"]
    with Product(out) as product:
        return (product.get("mueller")[:, 0] - light) / product.get("mueller_errors")[:, 0]


@pytest.mark.parametrize("states", [5, 6, 16])
def test_few_states_without_a_gain_have_intervals_that_cover(states, synthetic_capture, configs, tmp_path):
    """Of each pixel's own residual, 95 % intervals of six states covered 81 %, those of five 71 %."""
    off = pulls(synthetic_capture, configs, tmp_path / "m.h5", states, 4 + 180 / states * np.arange(states))
    assert np.mean(np.abs(off) < 1.96, axis=(1, 2)) == pytest.approx(np.full(4, 0.95), abs=0.03)
    assert np.sqrt(np.mean(off**2, axis=(1, 2))) == pytest.approx(np.ones(4), abs=0.1)


def test_pixels_whose_light_is_not_constant_have_errors_of_their_own(synthetic_capture, configs, tmp_path):
    """With the line of all pixels alone, theirs covered 30 % and those of all others 100 %."""
    is_unlike = np.random.default_rng(1).random(SHAPE) < 0.05
    angles_deg = 4 + 7.5 * np.arange(24)
    off = pulls(synthetic_capture, configs, tmp_path / "m.h5", 24, angles_deg, is_unlike)
    assert np.mean(np.abs(off[:, is_unlike]) < 1.96) == pytest.approx(0.95, abs=0.05)
    assert np.mean(np.abs(off[:, ~is_unlike]) < 1.96) == pytest.approx(0.95, abs=0.03)


def test_a_background_without_counts_leaves_the_errors_of_the_rest(synthetic_capture, configs, tmp_path):
    """Frames that were masked before they came: where there is neither light nor noise, nothing tells a share."""
    is_masked = np.zeros(SHAPE, bool)
    is_masked[:, :12] = True
    off = pulls(synthetic_capture, configs, tmp_path / "m.h5", 16, 4 + 11.25 * np.arange(16), is_masked=is_masked)
    assert np.mean(np.abs(off[:, ~is_masked]) < 1.96) == pytest.approx(0.95, abs=0.03)
