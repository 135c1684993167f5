"""Analysis vectors of single pixels: found from known polarization, and taken out of a frame."""

from pathlib import Path

import numpy as np
import pytest

from processing.calibration.mosaic import fit_response
from processing.errors import NotDetermined, ProcessError
from processing.instrument.model import InstrumentModel
from processing.reduction.mosaic.demosaic import demosaic
from processing.reduction.mosaic.layout import MosaicError, MosaicLayout
from processing.reduction.mosaic.pixel_response import corrected_frame, read_response
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Step
from processing.yaml_file import parse_yaml

NAMES = ("0", "45", "90", "135")
IDEAL = np.array([[0.5, 0.5 * np.cos(2 * t), 0.5 * np.sin(2 * t)] for t in np.deg2rad([0.0, 45, 90, 135])])
SHAPE = (48, 64)


@pytest.fixture
def turning(configs: Path) -> InstrumentModel:
    """The polarization camera behind a polarizer that an axis turns."""
    text = (configs / "instruments/linear_stokes.yaml").read_text(encoding="utf-8")
    return parse_yaml(text.replace("azimuth_deg: 0}\nanalyzer", "axis: polarizer}\nanalyzer"), InstrumentModel)


def sensor(rng: np.random.Generator, layout: MosaicLayout) -> np.ndarray:
    """True response (3, rows, columns): gains within 4 %, azimuths within 2 degrees, contrast 0.93 to 0.99."""
    gain = 1 + rng.normal(0, 0.04, SHAPE)
    azimuth = np.empty(SHAPE)
    for k, (r, c) in enumerate(layout.offsets):
        azimuth[r::2, c::2] = np.deg2rad(45.0 * k + 1.0)
    azimuth += np.deg2rad(rng.normal(0, 1.5, SHAPE))
    contrast = rng.uniform(0.93, 0.99, SHAPE)
    return 0.5 * gain * np.stack([np.ones(SHAPE), contrast * np.cos(2 * azimuth), contrast * np.sin(2 * azimuth)])


def test_response_is_found_and_taken_out(turning: InstrumentModel, synthetic_capture, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    layout = MosaicLayout.of(turning.mosaic or (), NAMES)
    true = sensor(rng, layout)
    angles = {"polarizer": np.arange(0, 180, 15.0)}
    light = turning.generator_states(angles)[:, :3] * 2000
    frames = np.einsum("ns,sxy->nxy", light, true)[:, None] + rng.normal(0, 0.3, (12, 1, *SHAPE))
    path = synthetic_capture(frames, angles, mosaic=turning.mosaic, sample={"kind": "air"})
    with Capture(path) as capture:
        facts = fit_response(capture, turning, tmp_path / "a.h5", Step("calibrate-mosaic", {}))
    response = read_response(tmp_path / "a.h5", SHAPE)
    np.testing.assert_allclose(response / response[0].mean() * true[0].mean(), true, atol=6e-4)
    assert facts["azimuth_deg_45"] == pytest.approx(46.0, abs=0.3)
    assert facts["gain_spread_0"] == pytest.approx(0.04, abs=0.008)
    # A smooth scene through that sensor, with and without the correction.
    y, x = np.indices(SHAPE) / 30
    s0 = 1500 + 300 * np.sin(x)
    stokes = np.stack([s0, 0.3 * s0 * np.cos(y), 0.3 * s0 * np.sin(x)])
    raw = np.einsum("sxy,sxy->xy", stokes, true).astype(np.float32)
    solve = np.linalg.pinv(IDEAL)
    inner = np.s_[:, 4:-4, 4:-4]

    def error(frame: np.ndarray) -> float:
        estimate = np.tensordot(solve, demosaic(frame, layout, "bilinear"), axes=1)
        return float(np.sqrt(np.mean((estimate - stokes)[inner] ** 2)))

    assert error(raw) > 20
    assert error(corrected_frame(raw, response, layout, IDEAL)) < 1.5
    with pytest.raises(MosaicError, match="frames of"):
        read_response(tmp_path / "a.h5", (10, 10))


def test_what_cannot_be_calibrated_is_said(turning: InstrumentModel, synthetic_capture, tmp_path: Path) -> None:
    frames = np.ones((4, 1, *SHAPE))
    for angles, sample, error, message in (
        ([0.0, 90, 0, 90], "air", NotDetermined, "rank 2"),
        ([0.0, 45, 90, 135], "unknown", ProcessError, "sample air"),
    ):
        turned = {"polarizer": np.array(angles)}
        path = synthetic_capture(frames, turned, mosaic=turning.mosaic, sample={"kind": sample})
        with Capture(path) as capture, pytest.raises(error, match=message):
            fit_response(capture, turning, tmp_path / "a.h5", Step("calibrate-mosaic", {}))
