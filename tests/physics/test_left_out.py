"""Cosmic rays, bad pixels and bad frames are found before anything is fitted, named, and left out of a reduction."""

import json
from pathlib import Path

import numpy as np
import pytest
from bench_capture import bench_capture

from processing.diagnosis.captures import binning
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.captures.screening import screen_capture
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.reduction.exclusions import Exclusions
from processing.reduction.mueller import reduce_mueller
from processing.steps.reduction import Reduction
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Product
from processing.yaml_file import dump_yaml
from simulators.blind.detector_cases import DETECTOR
from simulators.blind.undeclared_captures import TrueBench, state_angles

STATES, SIDE = 46, 40


def taken(folder: Path, configs: Path, bench: TrueBench, seed: int, air: bool) -> Path:
    return bench_capture(folder, configs / "instruments/rgb950.yaml", bench, air, STATES, seed)


def screened_capture(path: Path, configs: Path) -> CaptureData:
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    with Capture(path) as capture:
        return screen_capture(read_capture(capture, model), model, lambda line: None)


def small_faults(bench: TrueBench) -> None:
    """A bench as it is: nothing quite where it should be, a source that is not quite steady, an image that wanders."""
    bench.og += np.deg2rad(0.5)
    bench.da += np.deg2rad(1.0)
    bench.level.append(lambda k, a: 1 + 0.01 * np.sin(1.7 * k**2))
    bench.shift.append(lambda k, a: (0.3 * np.cos(a["psa"]), 0.3 * np.sin(a["psa"])))


@pytest.mark.parametrize("air", [True, False])
def test_nothing_is_left_out_of_a_bench_with_faults_of_the_optics(configs, tmp_path, air):
    bench = TrueBench(rows=SIDE, columns=SIDE)
    small_faults(bench)
    assert not screened_capture(taken(tmp_path, configs, bench, 3, air), configs).left_out


@pytest.mark.parametrize("air", [True, False])
@pytest.mark.parametrize("state", [0, 17])
def test_a_frame_that_belongs_to_nothing_is_found_among_faults(configs, tmp_path, air, state):
    bench = TrueBench(rows=SIDE, columns=SIDE)
    small_faults(bench)
    bench.level.append(lambda k, a: 0.75 if k == state else 1.0)
    data = screened_capture(taken(tmp_path, configs, bench, 3, air), configs)
    assert list(data.left_out.frames) == [state]
    assert not data.row_counts[state]
    assert data.left_out.frames[state] > 0.1


@pytest.mark.parametrize("air", [True, False])
@pytest.mark.parametrize("pair", [(11, 12), (4, 30)])
def test_two_frames_in_each_others_place_are_found_among_faults(configs, tmp_path, air, pair):
    """Gains and angles of single states would describe them, and be called by those names."""
    bench = TrueBench(rows=SIDE, columns=SIDE)
    small_faults(bench)
    bench.order = np.arange(STATES)
    bench.order[list(pair)] = pair[::-1]
    left_out = screened_capture(taken(tmp_path, configs, bench, 3, air), configs).left_out
    assert tuple(left_out.frames) == left_out.exchanged == pair
    assert min(left_out.frames.values()) > 0.1


def test_cosmic_rays_and_hot_pixels_are_found_and_left_out(configs, tmp_path):
    bench = TrueBench(rows=SIDE, columns=SIDE)
    small_faults(bench)
    truth = np.zeros((STATES, SIDE, SIDE), dtype=bool)

    def spoil(electrons, random):
        after = electrons.copy()
        for frame, struck in zip(after, truth, strict=True):
            for y, x in random.integers(0, SIDE, (3, 2)):
                frame[y, x] += random.uniform(2e3, 1e4)
                struck[y, x] = True
        after[:, 8, 30] += 4000 * random.uniform(0.5, 1.5, STATES)
        return after

    bench.noise.append(spoil)
    data = screened_capture(taken(tmp_path, configs, bench, 5, air=False), configs)
    assert [8, 30] in data.left_out.pixels.tolist()
    hits = {(n, y, x) for n, _, y, x in data.left_out.hits.tolist()}
    true = {(n, y, x) for n, y, x in np.argwhere(truth).tolist() if (y, x) != (8, 30)}
    bad = {tuple(p) for p in data.left_out.pixels.tolist()}
    # A pixel that was struck several times may be called bad.
    assert len([t for t in true if t not in hits and t[1:] not in bad]) <= 0.03 * len(true)
    assert len(hits - true) <= 0.01 * len(true)
    assert not data.usable[truth.any(axis=0)][3:].all()


def test_hits_are_found_pixel_by_pixel_where_means_are_fitted(configs, tmp_path, monkeypatch):
    monkeypatch.setattr(binning, "MOST_FITTED", STATES * SIDE**2 // 4)
    bench = TrueBench(rows=SIDE, columns=SIDE)

    def strike(electrons, random):
        electrons = electrons.copy()
        electrons[7, 21, 10] += 2000
        return electrons

    bench.noise.append(strike)
    data = screened_capture(taken(tmp_path, configs, bench, 5, air=False), configs)
    assert data.binned == 2
    assert data.signal.shape == (STATES, 1, SIDE // 2, SIDE // 2)
    assert data.left_out.hits.tolist() == [[7, 0, 21, 10]]
    assert data.left_out.pitch == 1
    assert not data.usable[10, 5]


def test_cosmic_rays_are_found_where_it_is_dark(configs, tmp_path):
    """The noise of an intensity is that of its light, not that of what struck it."""
    bench = TrueBench(rows=SIDE, columns=SIDE)
    bench.light.append(lambda k, e: np.where(np.arange(SIDE) < SIDE // 2, 0.004, 1.0) * e)
    struck = np.argwhere(np.random.default_rng(2).random((STATES, SIDE, SIDE // 2)) < 0.004)

    def strike(electrons, random):
        electrons = electrons.copy()
        electrons[tuple(struck.T)] += random.uniform(1e3, 1e4, len(struck))
        return electrons

    bench.noise.append(strike)
    data = screened_capture(taken(tmp_path, configs, bench, 5, air=False), configs)
    hits = {(n, y, x) for n, _, y, x in data.left_out.hits.tolist()}
    true = set(map(tuple, struck.tolist()))
    assert len(true - hits) <= 0.02 * len(true)
    assert not hits - true
    assert not len(data.left_out.pixels)


def mean_error(image: MuellerImage, good: np.ndarray) -> float:
    """Largest error of an element of M/m00 of air, mean over the image."""
    with np.errstate(invalid="ignore"):
        mean = (image.values / image.values[0, 0])[..., good].mean(axis=-1)
    return float(np.abs(mean - np.eye(4)).max())


@pytest.mark.parametrize("weighted", [False, True])
def test_a_reduction_leaves_out_what_a_diagnosis_names(configs, tmp_path, weighted):
    bench = TrueBench(rows=SIDE, columns=SIDE)
    DETECTOR["bad_frame"](bench, np.random.default_rng(2), STATES)
    path = taken(tmp_path, configs, bench, 5, air=True)
    result = tmp_path / "result.json"
    with Capture(path) as capture:
        name = capture.name
    bad = screened_capture(path, configs).left_out.frames
    entry = {"capture": name, "states": list(bad), "hits": [[3, 0, 11, 12]], "pixels": [[4, 5]]}
    result.write_text(json.dumps({"left_out": [entry]}))
    plain = MuellerImage.load(Reduction(path, weighted=weighted).make(tmp_path / "plain.h5"))
    clean = MuellerImage.load(Reduction(path, weighted=weighted, leave_out=result).make(tmp_path / "clean.h5"))
    assert clean.w.shape[0] == STATES - 1
    assert clean.mask[4, 5] == Mask.BAD
    assert clean.mask[11, 12] == Mask.STRUCK
    good = clean.mask == 0
    assert mean_error(clean, good) < 0.1 * mean_error(plain, good)


def test_a_struck_intensity_does_not_count(configs, tmp_path):
    path = taken(tmp_path, configs, TrueBench(rows=8, columns=8), 5, air=True)
    hits = np.array([[3, 0, 4, 5]])
    with Capture(path) as capture:
        model = capture.instrument
        reduce_mueller(capture, model, tmp_path / "a.h5", (), left_out=Exclusions(hits=hits))
    with Capture(path) as capture:
        frames = np.stack([capture.frames(k)[0, 4, 5] for k in range(STATES)]).astype(float) - 100
    w = model.rows(state_angles(STATES, False, False))
    states = np.delete(np.arange(STATES), 3)
    expected = np.linalg.lstsq(w.reshape(STATES, 16)[states], frames[states], rcond=None)[0]
    estimate = MuellerImage.load(tmp_path / "a.h5").values[:, :, 4, 5].reshape(16)
    assert estimate == pytest.approx(expected, rel=1e-3, abs=1e-3 * expected[0])


def test_stokes_of_a_mosaic_leave_out_states_and_struck_pixels(synthetic_capture, configs, tmp_path) -> None:
    """A frame of other light, a hit and a bad pixel, as `diagnose --json` tells them, do not reach the Stokes image."""
    model = InstrumentModel.load(configs / "instruments" / "linear_stokes.yaml")
    frames = np.full((5, 8, 12), 1000, dtype=np.uint16)
    frames[3] = 3000
    frames[1, 2:4, 4:6] = 4000
    frames[:, 6, 9] = 0
    header = {"instrument_yaml": dump_yaml(model), "mosaic": model.mosaic}
    path = synthetic_capture(frames[:, None], {"psg": np.zeros(5)}, **header)
    with Capture(path) as capture:
        name = capture.name
    entry = {"capture": name, "states": [3], "hits": [[1, 0, 2, 4]], "pixels": [[6, 8]], "pitch": 2}
    result = tmp_path / "result.json"
    result.write_text(json.dumps({"left_out": [entry]}))
    result_file = Reduction(path, demosaic="superpixel", leave_out=result).make(tmp_path / "s.h5")
    with Product(result_file) as product:
        s0, mask = product.get("s0"), product.get("pixel_flags")
    lost = np.zeros((4, 6), dtype=bool)
    lost[1, 2] = lost[3, 4] = True
    np.testing.assert_array_equal(mask == Mask.BAD, lost)
    np.testing.assert_array_equal(np.isnan(s0), lost)
    assert np.ptp(s0[~lost]) < 1e-3 * s0[~lost].mean()


def test_effects_count_the_states_that_a_diagnosis_saw(configs, tmp_path):
    """A slip from state 9 on, a level of the source in each state: without state 4 they stay where they are."""
    gains = 0.05 * np.random.default_rng(1).standard_normal(STATES)
    bench = TrueBench(rows=8, columns=8)
    bench.angles.append(lambda k, a: a | {"psg": a["psg"] + np.deg2rad(2.0) * (k >= 9)})
    bench.level.append(lambda k, a: 1 + gains[k])
    path = taken(tmp_path, configs, bench, 5, air=True)
    slip, flicker = (
        AppliedEffect(kind=kind, element=element, parameters={name: EffectParameter(value=value, unit="1")})
        for kind, element, name, value in (
            ("rotation_slip", "psg@9", "slip", 2.0),
            ("source_flicker", None, "states", tuple(gains.tolist())),
        )
    )
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    declared = model.model_copy(update={"effects": (slip, flicker)})
    errors = []
    for left_out in (Exclusions(), Exclusions(states=(4,))):
        with Capture(path) as capture:
            reduce_mueller(capture, declared, tmp_path / "m.h5", (), left_out=left_out, overwrite=True)
        image = MuellerImage.load(tmp_path / "m.h5")
        errors.append(mean_error(image, image.mask == 0))
    assert errors[1] == pytest.approx(errors[0], abs=1e-3)
