"""Photon transfer: gain and read noise from repeated frames; corrections from other captures."""

from pathlib import Path

import numpy as np
import pytest

from processing.calibration.photon_transfer import bad_pixels, photon_transfer, read_camera, write_camera
from processing.errors import NotDetermined, ProcessError
from processing.reduction.counts_to_signal import CountCorrection, saturation
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.product import Step

SHAPE = (120, 160)


def frames(rng: np.random.Generator, gain: float, read: float, black: float, light: np.ndarray, n: int) -> np.ndarray:
    electrons = rng.poisson(np.broadcast_to(light * gain, (n, 1, *SHAPE))) + rng.normal(0, read, (n, 1, *SHAPE))
    return np.clip(np.rint(electrons / gain + black), 0, 4095).astype(np.uint16)


def camera_capture(rng: np.random.Generator, write, gain: float = 1.7, read: float = 6.0, **more) -> Path:
    light = np.broadcast_to(np.linspace(0, 3000, SHAPE[1]), SHAPE)
    dark = frames(rng, gain, read, 80.0, np.zeros(SHAPE), 4)
    bright = frames(rng, gain, read, 80.0, light, 8)
    role = ("dark",) * 4 + ("sample",) * 8
    return write(np.concatenate([dark, bright]), {}, role=role, detector={"bits": 12}, **more)


@pytest.mark.parametrize(("gain", "read"), [(1.7, 6.0), (0.4, 1.5), (20.0, 12.0)])
def test_gain_and_read_noise_are_found(gain: float, read: float, synthetic_capture) -> None:
    path = camera_capture(np.random.default_rng(1), synthetic_capture, gain, read)
    with Capture(path) as capture:
        line = photon_transfer([capture])
    assert line.gain_e_per_count == pytest.approx(gain, abs=4 * line.gain_stderr)
    assert line.gain_stderr < 0.01 * gain
    if read / gain > 1:
        # Rounding to whole counts hides a read noise far below one count.
        assert line.read_noise_e == pytest.approx(read, rel=0.03)
    assert line.black_counts == pytest.approx(80.0, abs=0.1)
    assert line.chi_square < 2


@pytest.mark.long
def test_standard_error_of_the_gain_is_that_of_repetition(synthetic_capture) -> None:
    pulls = []
    for seed in range(40):
        path = camera_capture(np.random.default_rng(100 + seed), synthetic_capture)
        with Capture(path) as capture:
            line = photon_transfer([capture])
        pulls.append((line.gain_e_per_count - 1.7) / line.gain_stderr)
    # The scatter of 40 numbers is known to 11 %.
    assert np.std(pulls) == pytest.approx(1.0, abs=0.35)
    assert abs(np.mean(pulls)) < 0.5


def test_flicker_between_frames_is_not_noise(synthetic_capture) -> None:
    rng = np.random.default_rng(2)
    light = np.broadcast_to(np.linspace(0, 3000, SHAPE[1]), SHAPE)
    bright = np.concatenate([frames(rng, 1.7, 6.0, 80.0, light * level, 1) for level in (1.0, 1.02, 0.99, 1.01)])
    dark = frames(rng, 1.7, 6.0, 80.0, np.zeros(SHAPE), 2)
    path = synthetic_capture(
        np.concatenate([dark, bright]), {}, role=("dark",) * 2 + ("sample",) * 4, detector={"bits": 12}
    )
    with Capture(path) as capture:
        assert photon_transfer([capture]).gain_e_per_count == pytest.approx(1.7, rel=0.02)


def test_product_gives_noise_and_bad_pixels(synthetic_capture, tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    path = camera_capture(rng, synthetic_capture)
    with Capture(path) as capture:
        counts = np.stack([capture.frames(k) for k in range(12)])
    counts[:, 0, 7, 9] = 900
    role = ("dark",) * 4 + ("sample",) * 8
    path = synthetic_capture(counts, {}, role=role, detector={"bits": 12, "gain_e_per_count": 2.5})
    _, facts, simulated = write_camera([path], tmp_path / "c.h5", Step("camera", {}), False)
    assert simulated
    assert facts["bad_pixels"] == 1
    assert any("header says 2.5" in w for w in facts["warnings"])
    noise, bad = read_camera(tmp_path / "c.h5")
    assert np.argwhere(bad).tolist() == [[7, 9]]
    assert 1 / noise.slope == pytest.approx(1.7, rel=0.02)
    assert noise.variance(1000.0) == pytest.approx(1000 / 1.7 + (6 / 1.7) ** 2 + 1 / 12, rel=0.02)


def test_what_cannot_be_measured_is_said(synthetic_capture, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    dark = frames(rng, 1.7, 6.0, 80.0, np.zeros(SHAPE), 4)
    only_dark = synthetic_capture(dark, {}, role=("dark",) * 4, name="dark.h5")
    with Capture(only_dark) as capture, pytest.raises(NotDetermined, match="too little"):
        photon_transfer([capture])
    no_dark = synthetic_capture(dark, {}, name="nodark.h5")
    with Capture(no_dark) as capture, pytest.raises(ProcessError, match="no dark states"):
        photon_transfer([capture])
    angles = {"psg": np.arange(4.0) * 10}
    single = synthetic_capture(dark, angles, role=("dark", *("sample",) * 3), name="single.h5")
    with Capture(single) as capture, pytest.raises(ProcessError, match="repeat each other"):
        photon_transfer([capture])
    measured = camera_capture(rng, synthetic_capture, name="measured.h5", simulated=False)
    simulated = camera_capture(rng, synthetic_capture, name="simulated.h5")
    with pytest.raises(ProcessError, match="simulated and measured"):
        write_camera([measured, simulated], tmp_path / "c.h5", Step("camera", {}), False)


def test_dark_and_flat_of_another_capture(synthetic_capture) -> None:
    response = 1 + 0.2 * np.cos(np.arange(SHAPE[1]) / 20)
    response = np.broadcast_to(response / response.mean(), SHAPE)
    ones = np.ones((1, 1, *SHAPE))
    sample = synthetic_capture(ones * (100 + 500 * response), {}, name="sample.h5")
    dark = synthetic_capture(ones * 100, {}, role=("dark",), name="dark.h5")
    flat = synthetic_capture(ones * (100 + 2000 * response), {}, role=("flat",), name="flat.h5")
    small = synthetic_capture(ones[..., :10] * 100, {}, role=("dark",), name="small.h5")
    real = synthetic_capture(ones * 100, {}, role=("dark",), name="real.h5", simulated=False)
    with Capture(sample) as s, Capture(dark) as d, Capture(flat) as f, Capture(small) as o, Capture(real) as r:
        correction = CountCorrection.of(s, dark_from=d, flat_from=[f])
        signal = (s.frames(0) - correction.black.at(0.01)) / correction.flat.response
        np.testing.assert_allclose(signal, 500, rtol=1e-5)
        assert "dark.h5" in correction.source
        with pytest.raises(CaptureError, match="same camera and size"):
            CountCorrection.of(s, dark_from=o)
        with pytest.raises(CaptureError, match="never mixed"):
            CountCorrection.of(s, dark_from=r)
        with pytest.raises(CaptureError, match="has no flat states"):
            CountCorrection.of(s, flat_from=[d])
        with pytest.raises(CaptureError, match="bad-pixel map"):
            CountCorrection.of(s, bad=np.zeros((3, 3), bool))
        assert not bad_pixels(d).any()


@pytest.mark.parametrize(
    ("detector", "level"),
    [
        ({"bits": 12}, 4095.0),
        # Full at 64 + 8000 / 2.5 counts, less four times the read noise of 5 / 2.5 counts that spreads them.
        ({"bits": 12, "full_well_e": 8000.0, "gain_e_per_count": 2.5, "read_noise_e": 5.0}, 3256.0),
        ({"bits": 12, "full_well_e": 8000.0, "gain_e_per_count": 2.5}, 3264.0),
        ({"bits": 12, "full_well_e": 20_000.0, "gain_e_per_count": 2.5, "read_noise_e": 5.0}, 4095.0),
        ({"bits": 12, "full_well_e": 8000.0}, 4095.0),
        ({"full_well_e": 8000.0, "gain_e_per_count": 2.5}, None),
    ],
)
def test_saturation_is_where_the_full_well_begins_to_spread(synthetic_capture, detector: dict, level) -> None:
    pixels = np.array([[3255, 3256, 3264]], np.uint16)[None, None]
    path = synthetic_capture(pixels, {"psg": np.zeros(1)}, detector={"black_level_counts": 64.0, **detector})
    with Capture(path) as capture:
        assert saturation(capture) == level
        assert CountCorrection.of(capture).saturation == level
