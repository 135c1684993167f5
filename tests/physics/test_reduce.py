"""Reduction of captures with known Mueller images: values, error bars, masks, provenance."""

import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from reduced_capture import STEP, reduced

from processing.errors import NotDetermined, ProcessError
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.mueller import reduce_mueller
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.images import MuellerImage
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Product

GAIN, READ_NOISE, BLACK = 2.5, 4.0, 64.0


def table(states: int = 40) -> dict[str, np.ndarray]:
    psg = 9.0 * np.arange(states)
    return {"psg": psg, "psa": 4.91 * psg}


def scene(rng: np.random.Generator, shape: tuple[int, int], level: float = 2000.0) -> np.ndarray:
    """Physical Mueller image (4, 4, rows, columns): random mixtures of two Jones matrices and a depolarizer."""
    jones = rng.normal(size=(2, *shape, 2, 2)) + 1j * rng.normal(size=(2, *shape, 2, 2))
    pure = mueller.from_jones(jones)
    pure /= pure[..., :1, :1]
    mixed = 0.5 * pure[0] + 0.3 * pure[1] + 0.2 * mueller.IDEAL_DEPOLARIZER
    return np.moveaxis(mixed * level, (-2, -1), (0, 1))


def signals(model: InstrumentModel, angles: dict[str, np.ndarray], m: np.ndarray) -> np.ndarray:
    """Noise-free intensities (states, channels, rows, columns)."""
    return np.einsum("nck,kxy->ncxy", model.rows(angles), m.reshape(16, *m.shape[2:]))


def noisy(rng: np.random.Generator, signal: np.ndarray, black: float = BLACK, bits: int = 16) -> np.ndarray:
    electrons = rng.poisson(np.maximum(signal, 0) * GAIN) + rng.normal(0, READ_NOISE, signal.shape)
    return np.clip(np.rint(electrons / GAIN + black), 0, 2**bits - 1).astype(np.uint16)


def detector(**extra: object) -> dict[str, object]:
    return {"black_level_counts": BLACK, "gain_e_per_count": GAIN, "read_noise_e": READ_NOISE} | extra


@pytest.mark.parametrize("name", ["rgb950", "drr_imaging_630nm", "drr_wollaston"])
def test_noise_free_capture_gives_back_the_scene(name: str, configs: Path, synthetic_capture) -> None:
    rng = np.random.default_rng(1)
    wavelength = {"rgb950": 662, "drr_imaging_630nm": 630, "drr_wollaston": 1300}[name]
    model = InstrumentModel.load(configs / f"instruments/{name}.yaml").at(wavelength)
    angles = {axis: rng.uniform(0, 360, 60) for axis in model.axes}
    m = scene(rng, (6, 10))
    frames = signals(model, angles, m)
    channels = tuple(c.name for c in model.channels)
    path = synthetic_capture(frames, angles, channels=channels, wavelength_nm=wavelength)
    image = reduced(path, model)
    np.testing.assert_allclose(image.values, m, atol=2e-3)
    assert np.all(image.residual_rms < 2e-3)


@pytest.mark.parametrize("case", ["plain", "dark", "flat", "exposures", "repeats", "unknown gain"])
def test_errors_are_those_of_the_noise(case: str, rgb950: InstrumentModel, synthetic_capture) -> None:
    rng = np.random.default_rng(2)
    angles, shape = table(), (40, 50)
    m = np.broadcast_to(scene(rng, (1, 1)), (4, 4, *shape))
    if case == "unknown gain":
        # One sigma for a pixel is taken from its residual: exact where all its intensities are alike.
        m = 2000.0 * np.broadcast_to(mueller.IDEAL_DEPOLARIZER[..., None, None], (4, 4, *shape))
    signal = signals(rgb950, angles, m)
    role: tuple[str, ...] = ("sample",) * 40
    exposure: np.ndarray | float = 0.01
    response = np.ones(shape)
    repeats: np.ndarray | int = 1
    constants = detector()
    if case == "exposures":
        exposure = 0.01 * np.where(np.arange(40) % 3, 1.0, 0.4)
        signal = signal * (exposure / 0.01)[:, None, None, None]
    if case == "flat":
        response = 1 + 0.5 * np.sin(np.arange(50) / 8)
        response = np.broadcast_to(response / response.mean(), shape)
    frames = noisy(rng, signal * response)
    if case == "repeats":
        repeats = 9
        # Means of nine frames that are kept to a ninth of a count, as a camera with more bits would.
        frames = np.mean([noisy(rng, signal) for _ in range(9)], axis=0)
    if case == "dark":
        frames = np.concatenate([noisy(rng, np.zeros((3, 1, *shape))), frames])
        role = ("dark",) * 3 + role
        constants = detector(black_level_counts=0.0)
    if case == "flat":
        many = np.mean([noisy(rng, 20000 * response[None, None]) for _ in range(40)], axis=0)
        frames = np.concatenate([np.rint(many).astype(np.uint16), frames])
        role = ("flat", *role)
    if case == "unknown gain":
        constants = {"black_level_counts": BLACK}
    extra = len(role) - 40
    padded = {axis: np.concatenate([np.full(extra, np.nan), v]) for axis, v in angles.items()}
    if extra and isinstance(exposure, float):
        exposure = np.full(len(role), exposure)
    path = synthetic_capture(
        frames, padded, role=role, exposure_s=exposure, repeats=repeats, detector=constants | {"bits": 16}
    )
    image = reduced(path, rgb950)
    pulls = ((image.values - m) / image.errors).reshape(16, -1)
    # 2000 pixels: the variance of one element's pulls is known to 3 % (one sigma), the mean of 16 to 1 %.
    assert np.mean(pulls**2) == pytest.approx(1, abs=0.03)
    assert np.all(np.abs(np.mean(pulls**2, axis=1) - 1) < 0.14)
    if case != "unknown gain":
        assert image.facts["median_reduced_chi_square"] == pytest.approx(1.0, abs=0.08)
    else:
        assert "residual" in image.facts["noise"]


@pytest.mark.parametrize("darks", [0, 1])
def test_covariance_is_that_of_repeated_captures(darks: int, rgb950: InstrumentModel, synthetic_capture) -> None:
    rng = np.random.default_rng(3)
    shape = (60, 100)
    # So little light that one dark frame is most of the error of m00.
    m = np.broadcast_to(scene(rng, (1, 1), level=20.0 if darks else 2000.0), (4, 4, *shape))
    frames = noisy(rng, np.concatenate([np.zeros((darks, 1, *shape)), signals(rgb950, table(), m)]))
    angles = {axis: np.concatenate([np.full(darks, np.nan), values]) for axis, values in table().items()}
    role = ("dark",) * darks + ("sample",) * 40
    image = reduced(synthetic_capture(frames, angles, detector=detector(bits=16), role=role), rgb950)
    deviation = (image.values - m).reshape(16, -1)
    scatter = np.cov(deviation)
    covariance = image.covariance().reshape(-1, 16, 16).mean(axis=0)
    sigma = np.sqrt(np.diag(covariance))
    # Correlations of 6000 samples are known to 1 / sqrt(6000) = 0.013.
    assert np.max(np.abs((scatter - covariance) / np.outer(sigma, sigma))) < 0.08


def test_black_from_dark_states_else_header_else_said(rgb950: InstrumentModel, synthetic_capture) -> None:
    m = scene(np.random.default_rng(4), (4, 6))
    frames = signals(rgb950, table(), m) + 100.0
    plain = reduced(synthetic_capture(frames, table()), rgb950)
    assert any("nothing was subtracted" in w for w in plain.facts["warnings"])
    header = reduced(synthetic_capture(frames, table(), detector={"black_level_counts": 100}), rgb950)
    assert not header.facts["warnings"]
    np.testing.assert_allclose(header.values, m, atol=3e-3)
    with_dark = np.concatenate([np.full((2, 1, 4, 6), 100.0), frames])
    angles = {axis: np.concatenate([[0.0, 0.0], v]) for axis, v in table().items()}
    dark = reduced(synthetic_capture(with_dark, angles, role=("dark",) * 2 + ("sample",) * 40), rgb950)
    np.testing.assert_allclose(dark.values, m, atol=3e-3)


def test_saturated_states_are_left_out_pixel_by_pixel(rgb950: InstrumentModel, synthetic_capture) -> None:
    rng = np.random.default_rng(5)
    m = np.broadcast_to(scene(rng, (1, 1), level=1500), (4, 4, 30, 40)).copy()
    # A blinding half: its brightest states pass the top of 12 bits.
    m[..., :20] *= 7
    frames = noisy(rng, signals(rgb950, table(), m), bits=12)
    clipped = (frames >= 4095).sum(axis=(0, 1))
    assert 0 < clipped[:, :20].mean() < 20
    image = reduced(synthetic_capture(frames, table(), detector=detector(bits=12)), rgb950)
    assert np.array_equal((image.mask & Mask.SATURATED) != 0, clipped > 0)
    pulls = (image.values - m) / image.errors
    assert np.nanmean(pulls**2) == pytest.approx(1.0, abs=0.05)
    assert any("saturated" in w for w in image.facts["warnings"])


def test_a_capture_that_is_saturated_everywhere_leaves_no_file(rgb950: InstrumentModel, synthetic_capture) -> None:
    path = synthetic_capture(np.full((40, 1, 4, 6), 4095, np.uint16), table(), detector=detector(bits=12))
    with pytest.raises(CaptureError, match="Nothing was written"):
        reduced(path, rgb950)
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("usable_states", [5, 0])
@pytest.mark.filterwarnings("error")
def test_pixels_without_enough_states_are_not_determined(
    rgb950: InstrumentModel, synthetic_capture, usable_states
) -> None:
    m = scene(np.random.default_rng(6), (4, 6))
    frames = np.rint(signals(rgb950, table(), m)).astype(np.uint16)
    frames[usable_states:, 0, 1, 2] = 4095
    image = reduced(synthetic_capture(frames, table(), detector=detector(bits=12, black_level_counts=0)), rgb950)
    assert image.mask[1, 2] == Mask.SATURATED | Mask.NOT_DETERMINED
    assert np.all(np.isnan(image.values[..., 1, 2]))
    assert np.isfinite(image.values[..., 1, 3]).all()


def test_bad_and_not_finite_pixels_are_flagged_and_nan(rgb950: InstrumentModel, synthetic_capture) -> None:
    frames = signals(rgb950, table(), scene(np.random.default_rng(7), (4, 6)))
    frames[3, 0, 0, 0] = np.nan
    path = synthetic_capture(frames, table(), detector=detector(black_level_counts=0))
    bad = np.zeros((4, 6), bool)
    bad[2, 5] = True
    with Capture(path) as capture:
        correction = CountCorrection.of(capture, bad=bad)
    image = reduced(path, rgb950, correction=correction)
    assert image.mask[0, 0] == Mask.NOT_FINITE
    assert image.mask[2, 5] == Mask.BAD
    assert np.isnan(image.values[..., 0, 0]).all()
    assert np.isnan(image.values[..., 2, 5]).all()
    assert np.isfinite(image.values).sum() == 16 * 22


def test_nothing_but_nan_is_an_error(rgb950: InstrumentModel, synthetic_capture) -> None:
    path = synthetic_capture(np.full((40, 1, 4, 6), np.nan), table())
    with pytest.raises(CaptureError, match="24 not finite of 24 pixels"):
        reduced(path, rgb950)


def test_rank_deficient_table_names_rank_and_what_is_lost(rgb950: InstrumentModel, synthetic_capture) -> None:
    psg = 9.0 * np.arange(40)
    path = synthetic_capture(np.ones((40, 1, 4, 6)), {"psg": psg, "psa": 5 * psg})
    # A ratio of exactly 5 with 40 equal steps over one turn has rank 12 (docs/conventions.md).
    with pytest.raises(NotDetermined, match=r"rank 12, and 16 are needed"):
        reduced(path, rgb950)
    fixed = synthetic_capture(np.ones((40, 1, 4, 6)), {"psg": 0 * psg, "psa": 4.91 * psg})
    with pytest.raises(NotDetermined, match=r"rank 4.*m01"):
        reduced(fixed, rgb950)


def test_states_not_done_do_not_exist(rgb950: InstrumentModel, synthetic_capture) -> None:
    m = scene(np.random.default_rng(8), (4, 6))
    frames = signals(rgb950, table(), m)
    done = np.ones(40, int)
    done[30:] = 0
    frames[30:] = 1e6
    image = reduced(synthetic_capture(frames, table(), done=done), rgb950)
    assert image.facts["states"] == 30
    np.testing.assert_allclose(image.values, m, atol=3e-3)


def test_read_back_angles_count_and_not_the_planned_ones(rgb950: InstrumentModel, synthetic_capture) -> None:
    rng = np.random.default_rng(9)
    m = scene(rng, (4, 6))
    real = {axis: v + rng.normal(0, 0.5, 40) for axis, v in table().items()}
    image = reduced(synthetic_capture(signals(rgb950, real, m), real), rgb950)
    np.testing.assert_allclose(image.values, m, atol=3e-3)


def test_product_keeps_origin_and_says_simulated(rgb950: InstrumentModel, synthetic_capture) -> None:
    path = synthetic_capture(signals(rgb950, table(), scene(np.random.default_rng(11), (4, 6))), table(), omega_deg=35)
    out = path.with_suffix(".product.h5")
    reduced(path, rgb950)
    with Product(out) as product:
        assert product.simulated
        assert product.header.omega_deg == 35
        assert [s.name for s in product.steps] == ["reduce"]
        assert product.steps[0].arguments == STEP.arguments
        assert product.facts["condition_number"] == pytest.approx(7.14, abs=0.01)
    with Capture(path) as capture, pytest.raises(ProcessError, match="exists"):
        reduce_mueller(capture, rgb950, out, (STEP,))


def test_missing_axis_is_named(rgb950: InstrumentModel, synthetic_capture) -> None:
    path = synthetic_capture(np.ones((40, 1, 4, 6)), {"psg": table()["psg"]})
    with pytest.raises(CaptureError, match=r"turns psa.*angles of: psg"):
        reduced(path, rgb950)


def test_an_axis_that_turned_and_that_the_model_lacks_is_named(rgb950, configs, synthetic_capture) -> None:
    path = synthetic_capture(
        np.ones((40, 1, 4, 6)), table() | {"lamp": np.full(40, 7.0), "shutter": 90.0 * (np.arange(40) > 0)}
    )
    with pytest.raises(CaptureError, match=r"states turn shutter \(90 degrees\).*has no element on that axis"):
        reduced(path, rgb950)
    fixed = InstrumentModel.load(configs / "instruments/rotating_retarder_stokes.yaml").at(662)
    with pytest.raises(CaptureError, match=r"turn psg \(351 degrees\), shutter"):
        reduced(path, fixed)


SLOW_CHILD = """
import sys, time
import subprocess
import sys
from pathlib import Path
import processing.reduction.mueller as r
from processing.storage.captures.capture import Capture
from processing.storage.products.product import Step
r.BLOCK_PIXELS = 4 * 8
def slowly(done, total):
    print(done, flush=True)
    time.sleep(0.05)
with Capture(sys.argv[1]) as capture:
    step = (Step("reduce", {"capture": "capture.h5"}),)
    r.reduce_mueller(capture, capture.instrument, Path(sys.argv[2]), step, progress=slowly)
"""


def test_killed_reduction_leaves_a_partial_file_that_is_resumed(
    rgb950: InstrumentModel, configs: Path, synthetic_capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(12)
    frames = noisy(rng, signals(rgb950, table(), scene(rng, (160, 8))))
    text = (configs / "instruments/rgb950.yaml").read_text(encoding="utf-8")
    path = synthetic_capture(frames, table(), detector=detector(), instrument_yaml=text)
    out = path.with_name("killed.h5")
    child = subprocess.Popen([sys.executable, "-c", SLOW_CHILD, str(path), str(out)], stdout=subprocess.PIPE, text=True)
    assert child.stdout is not None
    while int(child.stdout.readline()) < 40:
        pass
    child.kill()
    child.wait()
    child.stdout.close()
    assert not out.exists()
    with h5py.File(out.with_name("killed.h5.partial")) as h5:
        done = int(h5["entry/rows_done"][()])
    assert 30 <= done < 160
    monkeypatch.setattr("processing.reduction.mueller.BLOCK_PIXELS", 4 * 8)
    read: list[int] = []
    real = Capture.read_block

    def watched(self: Capture, states: np.ndarray, rows: slice, block: np.ndarray) -> None:
        read.append(rows.start)
        real(self, states, rows, block)

    with monkeypatch.context() as patch, Capture(path) as capture:
        patch.setattr(Capture, "read_block", watched)
        reduce_mueller(capture, rgb950, out, (STEP,))
    assert min(read) == done
    expected = reduced(path, rgb950)
    resumed = MuellerImage.load(out)
    np.testing.assert_array_equal(resumed.values, expected.values)
    np.testing.assert_array_equal(resumed.errors, expected.errors)
    np.testing.assert_array_equal(resumed.mask, expected.mask)
    assert resumed.facts == expected.facts
