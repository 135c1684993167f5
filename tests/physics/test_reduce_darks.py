"""The black of each exposure: matched darks, offset plus dark current through others, and what is told."""

import numpy as np
import pytest

from processing.calibration.known_sample import part_of
from processing.calibration.train import fit_trains
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.maps import xi0
from processing.polarization import triply_degenerate
from processing.reduction.black import Black
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.mosaic.merge import merge
from processing.reduction.mueller import reduce_mueller
from processing.reduction.mueller_reduction import Choice
from processing.reduction.noise import NoiseModel
from processing.reduction.sample_states import sample_states
from processing.reduction.stokes import reduce_stokes
from processing.reflectance.base import normalized_mueller
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.images import MuellerImage, difference_errors, element_gradient
from processing.storage.products.product import Product, Step
from processing.yaml_file import dump_yaml
from simulators.bench.bench import DETECTOR, FixedScene, SimulatedBench
from simulators.bench.effects.base import with_element

ANGLES = {"psg": np.arange(6.0)}
ROLE = ("dark", "dark", "sample", "sample", "sample", "sample")
STEP = (Step("reduce", {}),)
SHAPE = (48, 60)
TRUE = {"xi0": 0.6, "m00": 2000.0}
SHORT_S, LONG_S = 0.005, 0.04
MUELLER = np.diag([1.0, 0.3, -0.25, 0.2])
MUELLER[0, 1] = MUELLER[1, 0] = 0.15


@pytest.mark.parametrize(
    ("exposure_s", "rate", "warning"),
    [
        ([0.1, 0.1, 0.1, 0.1, 0.1, 0.1], 500.0, None),
        ([0.1, 0.1, 0.1, 0.4, 0.4, 0.4], 500.0, "Take darks at the exposures of the sample"),
        ([0.1, 0.4, 0.1, 0.4, 0.2, 0.4], 500.0, None),
        ([0.1, 0.4, 0.1, 0.4, 0.1, 0.8], 500.0, "0.8 s is extrapolated from darks of 0.1 to 0.4 s, by 2e+02 counts"),
        ([0.1, 0.4, 0.1, 0.4, 0.1, 0.8], 1.0, None),
    ],
)
def test_what_is_told_of_the_darks(synthetic_capture, exposure_s, rate, warning) -> None:
    exposure = np.array(exposure_s)
    frames = np.broadcast_to((64 + rate * exposure)[:, None, None, None], (6, 1, 4, 6)).astype(np.uint16)
    with Capture(synthetic_capture(frames, ANGLES, role=ROLE, exposure_s=exposure)) as capture:
        correction = CountCorrection.of(capture)
        if warning is None:
            for k in range(2, 6):
                np.testing.assert_allclose(correction.black.at(exposure[k]), capture.frames(k), atol=1)
    # The frames hold no light, which is told as well.
    warnings = " ".join(text for text in correction.warnings if "no brighter" not in text)
    assert (warning in warnings) if warning else not warnings


@pytest.mark.parametrize(
    ("level", "noise", "stderr", "told"),
    [(4.0, 4.3, 0.029, True), (0.0, 2.0, 0.019, True), (-0.5, 0.8, 0.026, True), (20.0, 3.0, 0.019, False)],
)
def test_darks_that_are_cut_off_at_zero_have_the_black_of_their_noise(
    synthetic_capture, level, noise, stderr, told
) -> None:
    """Their mean alone is too high by 0.4, 0.8 and 0.6 counts."""
    random = np.random.default_rng(1)
    frames = np.full((6, 1, 100, 120), 200, dtype=np.uint16)
    frames[:2] = np.clip(np.round(random.normal(level, noise, (2, 1, 100, 120))), 0, None)
    with Capture(synthetic_capture(frames, ANGLES, role=ROLE)) as capture:
        correction = CountCorrection.of(capture)
        assert correction.black.at(np.nan).mean() == pytest.approx(level, abs=3 * stderr)
    assert any("cut off at zero" in text for text in correction.warnings) is told


def test_line_through_other_exposures_and_its_error() -> None:
    """Many draws of noisy darks at two exposures: bias and variance of the black between them."""
    rng = np.random.default_rng(1)
    noise = NoiseModel(0.4, 2.0, 0.0, "")
    exposure, frames = np.array([0.1, 0.4]), np.array([2.0, 6.0])
    truth = 60 + 300 * exposure
    means = truth[:, None, None, None] + rng.normal(size=(2, 1, 200, 200)) * np.sqrt(2.0 / frames)[:, None, None, None]
    black = Black(means.astype(np.float32), exposure, frames, frames, np.full(2, 2.0), np.full(2, 0.01))
    for t in (0.02, 0.2, 0.4, 0.6):
        error = black.at(t) - (60 + 300 * t)
        expected = black.weights(t)[0] ** 2 @ black.mean_variance(noise)
        assert abs(error.mean()) < 4 * np.sqrt(expected / error.size)
        assert error.var() == pytest.approx(expected, rel=0.03)


def bench(instrument: InstrumentModel, level: np.ndarray, flux: float, dark_current: float, mueller: np.ndarray):
    scene = FixedScene(np.broadcast_to(level[None, :, None, None] * mueller, (*SHAPE, 4, 4)))
    return SimulatedBench(
        scene,
        instrument,
        662,
        rows=SHAPE[0],
        columns=SHAPE[1],
        detector=DETECTOR,
        flux_e_per_s=flux,
        dark_current_e_per_s=dark_current,
        seed=3,
    )


def bracketed(synthetic_capture, model: InstrumentModel, stand: SimulatedBench, dark_s: list, angles: dict, **header):
    """A capture of both exposures in each pose, with darks of the exposures `dark_s`, from the bench."""
    n, d = len(next(iter(angles.values()))), len(dark_s)
    turned = {axis: np.concatenate([np.zeros(d), np.repeat(values, 2)]) for axis, values in angles.items()}
    exposure = np.concatenate([dark_s, np.tile([SHORT_S, LONG_S], n)])
    frames = np.stack(
        [
            stand.expose({axis: v[k] for axis, v in turned.items()}, exposure[k], k, light=float(k >= d))
            for k in range(d + 2 * n)
        ]
    )
    role = ("dark",) * d + ("sample",) * (2 * n)
    header |= {"detector": DETECTOR, "instrument_yaml": dump_yaml(model), "mosaic": model.mosaic}
    return synthetic_capture(frames[:, None], turned, role=role, exposure_s=exposure, **header)


@pytest.mark.parametrize("weighted", [False, True], ids=["plain", "weighted"])
@pytest.mark.parametrize(
    "dark_s", [[SHORT_S, LONG_S] * 4, [0.004] * 4 + [0.08] * 4], ids=["matched darks", "interpolated"]
)
def test_bracket_with_dark_current_has_unit_pulls(synthetic_capture, configs, tmp_path, dark_s, weighted) -> None:
    """Dark current of 500 e/s, from hardly any light to saturation at the long exposure: reduced chi-square 1."""
    model = InstrumentModel.load(configs / "instruments" / "rgb950.yaml")
    flux, level = 4e6, np.geomspace(0.005, 1, SHAPE[1])
    stand = bench(model.at(662), level, flux, 500.0, MUELLER)
    path = bracketed(synthetic_capture, model, stand, dark_s, dict(rotating_retarders(1.0).angles_deg))
    with Capture(path) as capture:
        facts = reduce_mueller(capture, model.at(662), tmp_path / "m.h5", STEP, choice=Choice(weighted=weighted))
    assert [w for w in facts["warnings"] if "saturated" not in w] == []
    image = MuellerImage.load(tmp_path / "m.h5")
    truth = flux * LONG_S / DETECTOR.gain_e_per_count * MUELLER[:, :, None, None] * level
    pull = (image.values - truth) / image.errors
    saturated = (image.mask & 1) != 0
    assert 0.2 < saturated.mean() < 0.6
    with Product(tmp_path / "m.h5") as product:
        chi_square = product.get("reduced_chi_square")
    for part in (saturated, ~saturated & (level > 0.03), ~saturated & (level <= 0.03)):
        assert chi_square[part].mean() == pytest.approx(1, abs=0.03)
        assert np.std(pull[..., part]) == pytest.approx(1, abs=0.03)
        # Leaving out what saturates favours low counts at the edge by a tenth of a standard error.
        assert abs(pull[..., part].mean(axis=-1)).max() < 0.2


def test_bracketed_mosaic_uses_the_long_exposure_where_it_can(synthetic_capture, configs, tmp_path) -> None:
    model = InstrumentModel.load(configs / "instruments" / "linear_stokes.yaml")
    rows, light = model.at(662).rows({})[0], model.at(662).generator_states({})[0]
    flux, level = 4e6, np.repeat(np.geomspace(0.005, 1, SHAPE[1] // 2), 2)
    stand = bench(model.at(662), level, flux, 500.0, MUELLER)
    path = bracketed(synthetic_capture, model, stand, [SHORT_S, LONG_S] * 4, {"psg": np.zeros(4)})
    noise = NoiseModel.of(DETECTOR, integer=True)
    with Capture(path) as capture:
        merged = merge(capture, sample_states(capture), CountCorrection.of(capture), noise)
        reduce_stokes(capture, model.at(662), tmp_path / "s.h5", STEP, method="superpixel")
    layout = MosaicLayout.of(model.mosaic, [c.name for c in model.channels])
    truth = np.zeros(SHAPE)
    for k, (r, c) in enumerate(layout.offsets):
        truth[r::2, c::2] = flux * LONG_S / DETECTOR.gain_e_per_count * (rows[k] @ MUELLER.ravel()) * level[c::2]
    saturated = (merged.mask & 1) != 0
    assert 0.1 < saturated.mean() < 0.6
    assert not (merged.mask & 8).any()
    pull = (merged.signal - truth) / np.sqrt(merged.shot * truth + merged.floor)
    for part in (saturated, ~saturated & (level > 0.03), ~saturated & (level <= 0.03)):
        assert pull[part].std() == pytest.approx(1, abs=0.07)
        assert abs(pull[part].mean()) < 0.15
    with Product(tmp_path / "s.h5") as product:
        s0, error = product.get("s0"), product.get("s0_errors")
        assert np.isfinite(s0).all()
    expected = flux * LONG_S / DETECTOR.gain_e_per_count * level[::2] * (MUELLER[0] @ light)
    assert ((s0 - expected) / error).std() == pytest.approx(1, abs=0.08)


def test_calibration_leaves_out_exposures_that_saturate(synthetic_capture, configs) -> None:
    """Air at two exposures, the long one clipped in the bright states, with a strong dark current."""
    model = InstrumentModel.load(configs / "instruments" / "rgb950.yaml")
    stand = bench(model.at(662), np.ones(SHAPE[1]), 1e6, 500.0, np.eye(4))
    angles = dict(rotating_retarders(1.0).angles_deg)
    path = bracketed(synthetic_capture, model, stand, [SHORT_S, LONG_S] * 4, angles, sample={"kind": "air"})
    off = with_element(model.at(662), "psg_retarder", retardance_deg=125.0)
    with Capture(path) as capture:
        frames = np.stack([capture.frames(k) for k in range(8, 88)])
        assert 0.2 < np.mean(frames >= 4095 - 64) < 0.5
        part = part_of(capture, off, slice(None), slice(None))
        fit = fit_trains([part], ["psg_retarder.retardance_deg"])[0]
    truth = next(e for e in model.at(662).elements() if e.name == "psg_retarder").retardance_deg
    assert fit.values[0] == pytest.approx(truth, abs=5 * fit.stderr[0] + 0.01)
    assert fit.residual_over_mean < 1e-3


def test_hot_pixel_of_a_flat_is_a_bad_pixel(synthetic_capture) -> None:
    flat = np.full((2, 1, 40, 50), 2000, np.uint16)
    flat[:, 0, 7, 9] = 4095
    role = {"role": ("flat", "flat"), "detector": {"bits": 12, "black_level_counts": 64.0}}
    with Capture(synthetic_capture(flat, {"psg": np.zeros(2)}, **role)) as capture:
        correction = CountCorrection.of(capture)
    assert np.argwhere(correction.bad).tolist() == [[7, 9]]
    flat[:, 0, :20] = 4095
    over = synthetic_capture(flat, {"psg": np.zeros(2)}, name="over.h5", **role)
    with Capture(over) as capture, pytest.raises(CaptureError, match="every flat state is saturated"):
        CountCorrection.of(capture)


@pytest.mark.parametrize("gain", [1.0, None])
@pytest.mark.parametrize("darks", [1, 3])
def test_noise_of_few_darks_is_in_the_errors_of_all_results(
    gain, darks, synthetic_capture, configs, tmp_path, monkeypatch
) -> None:
    """With one dark of 30 e, m00 was off by 1.7 to 4 of its errors, xi0 by up to 1.6, a difference by 0.77."""
    random = np.random.default_rng(3)
    plain = InstrumentModel.load(configs / "instruments/linear_mueller.yaml")
    other = plain.with_values({"analyzer": {"azimuth_deg": 2.0}})
    angles = {"psg": np.repeat([0.0, 50, 100, 150], 5), "psa": np.tile(np.arange(5) * 36.0, 4)}
    m0 = normalized_mueller(np.array([[1.0, 0.1], [0.2j, -0.6]]))
    sample = triply_degenerate.mueller_matrix(m0, 0.6, 2000.0)
    light = plain.rows(angles).reshape(-1, 16) @ sample.reshape(16)
    mean = np.concatenate([np.zeros(darks), light])[:, None, None, None]
    frames = random.poisson(mean, (len(mean), 1, 30, 40)) + random.normal(200, 30, (len(mean), 1, 30, 40))
    path = synthetic_capture(
        frames.astype(np.float32),
        {name: np.concatenate([np.zeros(darks), values]) for name, values in angles.items()},
        role=("dark",) * darks + ("sample",) * len(light),
        detector={"gain_e_per_count": gain, "read_noise_e": 30.0},
    )
    images = []
    for k, model in enumerate((plain, other)):
        with Capture(path) as capture:
            reduce_mueller(capture, model, tmp_path / f"{k}.h5", STEP)
        images.append(MuellerImage.load(tmp_path / f"{k}.h5"))
    monkeypatch.setattr(xi0, "dominant_model", lambda *_: np.tile(m0, (30, 40, 1, 1)))
    out = tmp_path / "x.h5"
    xi0.xi0_of_partial(tmp_path / "0.h5", "geometry", "material", out, step=STEP[0], overwrite=False)
    with Product(out) as product:
        values = {name: (product.get(name) - true, product.get(f"{name}_errors")) for name, true in TRUE.items()}
    values["M"] = (images[0].values - sample[..., None, None])[:3, :3], images[0].errors[:3, :3]
    off = np.subtract(*(image.values[1, 1].astype(float) / image.values[0, 0] for image in images))
    values["a difference"] = off - off.mean(), difference_errors(images, [element_gradient(i, 5) for i in images])
    for name, (error, claimed) in values.items():
        assert np.sqrt(np.mean(np.square(error / claimed))) == pytest.approx(1, abs=0.1), name


@pytest.mark.parametrize("darks", [0, 1, 4])
def test_a_stokes_image_without_a_gain_has_errors_of_its_own_noise(darks, synthetic_capture, configs, tmp_path) -> None:
    """They came from the demosaiced closure, which is smoother than the frame: 95 % intervals covered 35 to 60 %."""
    random = np.random.default_rng(darks)
    model = InstrumentModel.load(configs / "instruments/linear_stokes.yaml").at(662)
    light = np.where(np.arange(120) < 60, 40.0, 2000.0) * np.ones((96, 1))
    layout = MosaicLayout.of(model.mosaic, [channel.name for channel in model.channels])
    expected = np.zeros((1 + darks, 1, 96, 120))
    for row, (r, c) in zip(model.rows({})[0], layout.offsets, strict=True):
        expected[darks, 0, r::2, c::2] = 2 * (row @ MUELLER.reshape(16)) * light[r::2, c::2]
    frames = (random.poisson(expected) + random.normal(0, 5, expected.shape)) / 2 + 100
    role, detector = ("dark",) * darks + ("sample",), {"black_level_counts": 0 if darks else 100}
    path = synthetic_capture(frames.astype(np.float32), {}, mosaic=model.mosaic, role=role, detector=detector)
    with Capture(path) as capture:
        facts = reduce_stokes(capture, model, tmp_path / "s.h5", STEP)
    assert any("the noise is estimated from the channels' closure" in text for text in facts["warnings"])
    inside = np.abs(np.abs(np.arange(120) - 59.5) - 30) < 26
    true = (MUELLER @ [1, 1, 0, 0])[:3] / 2
    with Product(tmp_path / "s.h5") as product:
        for k in range(3):
            pulls = (product.get(f"s{k}") - true[k] * light) / product.get(f"s{k}_errors")
            for half in (inside & (np.arange(120) < 60), inside & (np.arange(120) > 60)):
                assert np.std(pulls[4:-4, half]) == pytest.approx(1, abs=0.1), (k, half.argmax())
