"""What a diagnosis says of sources and detectors: jumps, bends, gains and noise that are not as stated."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench_capture import bench_capture, read

from processing.diagnosis.captures.screening import screen_capture
from processing.diagnosis.instrument.diagnose import diagnose, diagnose_captures
from processing.diagnosis.instrument.features import features
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument_file import write_instrument
from processing.diagnosis.search.space import Space
from processing.instrument.model import InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from processing.yaml_file import dump_yaml
from simulators.blind.real_bench import RoundSample
from simulators.blind.undeclared_captures import TrueBench, declared_bench

STATES, RESUMED, PIXELS, NM, SIDE = 40, 22, 64, 662.0, 64


@pytest.mark.parametrize(("air", "fraction"), [(False, -0.04), (True, 0.0)])
def test_a_jump_between_two_runs_is_found_and_none_where_there_is_none(configs, tmp_path, monkeypatch, air, fraction):
    bench, file = TrueBench(rows=16, columns=16), configs / "instruments/rgb950.yaml"
    bench.level.append(lambda k, a: 1 + fraction * (k >= RESUMED))
    path = bench_capture(tmp_path, file, bench, air, STATES, seed=11)
    with Capture(path) as capture:
        resumed = (np.arange(len(capture.done)) >= len(capture.done) - STATES + RESUMED).astype(np.int64)
    monkeypatch.setattr(Capture, "run_of_states", resumed)
    diagnosis = diagnose_captures([path], InstrumentModel.load(file))[0].diagnosis
    if fraction:
        assert diagnosis.verdict == "explained"
        assert [e.kind for e in diagnosis.effects if e.confident] == ["source_jump"]
        jump = diagnosis.effects[0].parameters["run_2"]
        assert jump.value == pytest.approx(fraction, abs=4 * jump.stderr)
        assert jump.stderr < 0.002
    else:
        assert not diagnosis.effects


BEND = 0.03


@pytest.mark.long
def test_a_bend_beside_other_faults_is_not_taken_for_several(configs: Path, tmp_path: Path) -> None:
    """A variance of the counts that is 2 % off, of 100 000 values, is more than most causes explain."""
    file = configs / "instruments/rgb950.yaml"
    bench = declared_bench(InstrumentModel.load(file).at(NM), NM, PIXELS, False, electrons=20_000.0)
    bench.transfer.append(lambda electrons: electrons * (1 - BEND * electrons / bench.full_well))
    bench.da += np.deg2rad(1.2)
    bench.path = (np.deg2rad(0.3), np.deg2rad(-0.4))
    bench.fast_slow_g = (1.0, 0.995)
    bench.level.append(lambda k, angles: 1 - 0.004 * k / STATES)
    path = bench_capture(tmp_path, file, bench, seed=2, scene=RoundSample)
    diagnosis = diagnose_captures([path], InstrumentModel.load(file))[0].diagnosis
    effects = {effect.kind: effect for effect in diagnosis.effects}
    assert set(effects) == {"detector_nonlinearity", "retarder_diattenuation", "source_drift"}
    assert effects["retarder_diattenuation"].answer == effects["source_drift"].answer == "sure"
    # A tone curve of its own size can do as well; which of the two it is one picture of a sphere need not tell.
    bend = effects["detector_nonlinearity"]
    assert bend.confident
    assert set(bend.indistinguishable_from) <= {"tone_curve"}
    lost = bend.parameters["lost_at_full_scale"]
    assert lost.value == pytest.approx(BEND, abs=4 * lost.stderr)


def test_the_slope_of_a_feature_is_its_derivative_at_dark_signals_too() -> None:
    """What noise adds to a feature is subtracted by these slopes; half of the counts of a dark pixel are negative."""
    u = np.array([-1.3e-2, -2e-4, 0.0, 3e-4, 9.5e-4, 1.2e-3, 0.04, 0.7])
    step = 1e-8
    place = np.linspace(-1, 1, len(u)), np.linspace(0.5, -1, len(u))
    _, slope = features(u, *place)
    exact = (features(u + step, *place)[0] - features(u - step, *place)[0]) / (2 * step)
    np.testing.assert_allclose(slope, exact, rtol=1e-5, atol=1e-5)


def captured(folder, configs, bench, scene=None):
    """A capture as `diagnose` reads it: of air, or of an unknown sample."""
    file = configs / "instruments/rgb950.yaml"
    return read(bench_capture(folder, file, bench, scene is None, STATES, 11, scene=scene), file)


def said(model, *captures):
    """What `diagnose` says of captures, by kind whether a name is sure."""
    diagnosis = diagnose(InstrumentProblem(model, list(captures)), lambda line: None).diagnosis
    return diagnosis, {e.kind: e.answer for e in diagnosis.effects if e.confident}


@pytest.mark.long
@pytest.mark.parametrize("times", [0.965, 1.04])
def test_a_gain_that_is_stated_some_percent_wrong_hides_no_cause(configs, tmp_path, times):
    """Four percent of the variance of 160 000 intensities is eleven standard deviations of their sum of squares."""
    bench = TrueBench(rows=SIDE, columns=SIDE)
    bench.dg += np.deg2rad(0.4)
    bench.ellipticity = np.deg2rad(0.5)
    bench.level.append(lambda k, a: 1 + 0.01 * k / (STATES - 1))
    model, data = captured(tmp_path, configs, bench)
    diagnosis, sure = said(model, replace(data, slope=times * data.slope, floor=times * data.floor))
    assert diagnosis.verdict == "explained"
    assert {"psg_retardance", "source_drift"} <= set(sure)
    assert diagnosis.error_after.chi2_reduced == pytest.approx(1.0, abs=0.01)


@pytest.mark.long
def test_an_offset_is_no_other_read_noise(configs, tmp_path):
    """A ball before a dark wall: what is added to all counts takes photon noise along in what is expected of them."""
    bench = TrueBench(rows=SIDE, columns=SIDE, read_noise=3.0)
    bench.da += np.deg2rad(0.5)
    bench.stored.append(lambda counts: counts + 60)
    model, ball = captured(tmp_path / "ball", configs, bench, RoundSample)
    _, air = captured(tmp_path, configs, bench)
    lines = []
    ball, air = (screen_capture(d, model, lines.append) for d in (ball, air))
    assert any("variance of a pixel" in line for line in lines)
    diagnosis, sure = said(model, ball, air)
    assert diagnosis.noise.verdict == "as_declared"
    assert {"psa_retardance", "detector_offset"} <= set(sure)


def test_an_offset_that_nothing_else_shows_leaves_the_noise_of_the_light(configs, tmp_path):
    """Behind it the dark wall scatters otherwise than its counts say, and the ball as before."""
    bench = TrueBench(rows=SIDE, columns=SIDE, read_noise=3.0)
    bench.stored.append(lambda stored: stored + 60)
    model, data = captured(tmp_path, configs, bench, RoundSample)
    problem, empty = InstrumentProblem(model, [data]), Space(())
    problem.level_noise(empty, np.zeros(0))
    (leveled,) = problem.still
    assert leveled.slope == pytest.approx(data.slope, rel=0.015)


GAINS = {"45": 0.93, "90": 1.22, "135": 0.84}


@pytest.mark.long
def test_four_channels_of_unequal_gain_behind_a_flickering_source(configs, tmp_path):
    """40 exposures of air in four channels: what is left is the noise of 0.1 %, and the file holds the gains."""
    random = np.random.default_rng(3)
    nominal = InstrumentModel.load(configs / "instruments/mosaic_polarimeter.yaml")
    listed = tuple(f"{name}.gain" for name in GAINS)
    nominal = nominal.model_copy(update={"mosaic": None, "calibrate": listed, "free_source": True})
    true = nominal.with_values({name: {"gain": gain} for name, gain in GAINS.items()}).at(662)
    angles = 9.0 * np.arange(40)
    signal = true.rows({"psg": angles}) @ np.eye(4).reshape(16) * 10_000
    signal = signal * random.uniform(0.9, 1.1, (40, 1)) * (1 + 1e-3 * random.standard_normal(signal.shape))
    names = ",".join(f"channel_{c.name}" for c in true.channels)
    lines = [f"state,psg_deg,{names}"]
    lines += [f"{k},{a},{','.join(map(str, row))}" for k, (a, row) in enumerate(zip(angles, signal, strict=True))]
    states, instrument = tmp_path / "air.csv", tmp_path / "four.yaml"
    states.write_text("\n".join(lines) + "\n", encoding="utf-8")
    instrument.write_text(dump_yaml(nominal), encoding="utf-8")
    air = tmp_path / "air.h5"
    import_capture(
        ImportRequest(states=states, out=air, wavelength_nm=662, instrument=instrument, sample=read_sample("air"))
    )
    diagnosis = diagnose_captures([air], nominal)[0].diagnosis
    assert diagnosis.error_after.rms_percent == pytest.approx(0.1, abs=0.03)
    write_instrument(tmp_path / "new.yaml", nominal, diagnosis)
    written = InstrumentModel.load(tmp_path / "new.yaml").at(662)
    for name, gain in GAINS.items():
        assert written.value_of(f"{name}.gain") == pytest.approx(gain, abs=0.002)


@pytest.mark.parametrize("frames", [1, pytest.param(8, marks=pytest.mark.long)])
def test_a_list_of_states_without_a_column_of_an_axis(frames, configs, tmp_path):
    random = np.random.default_rng(0)
    scene = 200 + 100 * np.sin(np.arange(64) / 9)[:, None] * np.cos(np.arange(64) / 7)
    # Channels 90 45 / 135 0 of linear light, the one of 45 degrees with a gain of 1.03.
    light = 16 * scene * np.tile([[0.4, 0.55 * 1.03], [0.5, 0.65]], (32, 32))
    counts = np.round(random.poisson(light * 40, (frames, 64, 64)) / 40).astype(np.uint16)
    np.save(tmp_path / "frames.npy", counts)
    states, instrument = tmp_path / "states.csv", configs / "instruments/linear_stokes.yaml"
    states.write_text("state\n" + "".join(f"{k}\n" for k in range(frames)), encoding="utf-8")
    request = ImportRequest(
        states=states,
        stack=str(tmp_path / "frames.npy"),
        out=tmp_path / "c.h5",
        wavelength_nm=550,
        instrument=instrument,
        sample=read_sample("unknown"),
    )
    import_capture(request)
    diagnosis = diagnose_captures([request.out], InstrumentModel.load(instrument))[0].diagnosis
    assert diagnosis.error_before.chi2_reduced > 3
    assert diagnosis.error_after.chi2_reduced < 1.1
