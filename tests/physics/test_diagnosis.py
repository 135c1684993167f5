"""What `diagnose` must know and what it must know that it does not know, on captures made by Jones calculus."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from bench_capture import bench_capture

from processing import yaml_file
from processing.commands import diagnose as cli
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument.residual_file import read_residuals
from processing.diagnosis.instrument_file import WriteError, write_instrument
from processing.diagnosis.search.result import Diagnosis, FoundEffect
from processing.instrument.model import EffectParameter, InstrumentModel
from processing.storage.captures.schema import Sample
from simulators.blind.undeclared_captures import (
    TrueBench,
    TrueScene,
    declared_bench,
    digitize,
    expose,
    state_angles,
    write_capture,
)
from tests.commands import exit_code

STATES = 40


def capture(folder: Path, configs: Path, bench: TrueBench, air: bool, seed: int = 7) -> Path:
    return bench_capture(folder, configs / "instruments/rgb950.yaml", bench, air, STATES, seed)


def diagnosed(path: Path, configs: Path) -> Diagnosis:
    return diagnose_captures([path], InstrumentModel.load(configs / "instruments/rgb950.yaml"))[0].diagnosis


def test_jones_bench_and_mueller_model_are_the_same_instrument(configs):
    bench = TrueBench()
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(662)
    angles = state_angles(STATES, False, False)
    g = np.stack([bench.generated({k: float(np.deg2rad(v[n])) for k, v in angles.items()}, n) for n in range(STATES)])
    a = np.stack([bench.analyzed({k: float(np.deg2rad(v[n])) for k, v in angles.items()}, n)[0] for n in range(STATES)])
    assert g == pytest.approx(model.generator_states(angles), abs=1e-12)
    assert a == pytest.approx(model.analyzer_states(angles)[:, 0], abs=1e-12)


@pytest.mark.long
def test_a_retardance_error_is_invisible_with_an_unknown_sample_and_plain_with_air(configs, tmp_path):
    """docs/conventions.md, "What an unknown sample hides"."""
    wrong = np.deg2rad(127.12 + 1.0)
    unknown = diagnosed(capture(tmp_path, configs, TrueBench(dg=wrong), air=False), configs)
    assert unknown.verdict == "consistent"
    hidden = {"psg_retardance[psg_retarder]", "psa_retardance[psa_retarder]", "psg_extinction[psg_polarizer]"}
    assert hidden | {"stray_light"} <= set(unknown.unobservable)
    assert "air" in unknown.recommendation
    (tmp_path / "capture.h5").unlink()
    air = diagnosed(capture(tmp_path, configs, TrueBench(dg=wrong), air=True), configs)
    assert air.verdict == "explained"
    (effect,) = air.effects
    assert (effect.kind, effect.element) == ("psg_retardance", "psg_retarder")
    retardance = effect.parameters["retardance"]
    assert retardance.value == pytest.approx(1.0, abs=3 * retardance.stderr)
    assert retardance.stderr < 0.05


def test_a_large_fault_is_named_alone(configs, tmp_path):
    """An effect with more values fits as well, but it is no alternative: its other values are not needed."""
    bench = TrueBench(og=TrueBench().og + np.deg2rad(4))
    (effect,) = diagnosed(capture(tmp_path, configs, bench, air=True), configs).effects
    assert (effect.kind, effect.answer, effect.confident) == ("psg_azimuth", "sure", True)
    assert not effect.indistinguishable_from


@pytest.mark.long
def test_azimuths_of_analyzer_and_its_retarder_are_named_together(configs, tmp_path):
    """With an unknown sample the two cannot be told apart, and air is what separates them."""
    d = diagnosed(capture(tmp_path, configs, TrueBench(oa=np.deg2rad(13.41 + 0.4)), air=False), configs)
    (effect,) = d.effects
    kinds = {effect.kind, *(text.partition("[")[0] for text in effect.indistinguishable_from)}
    assert kinds - {"unlisted"} == {"psa_azimuth", "analyzer_azimuth"}
    assert "air" in d.recommendation


@pytest.mark.long
def test_a_state_that_is_cut_off_at_zero_is_left_out(configs, tmp_path):
    """A black level that is too low for an offset; behind crossed polarizers nothing else is left."""
    bench = TrueBench(rows=40, columns=40)
    bench.transfer.append(lambda e: e - 1100 * bench.gain)
    bench.angles.append(lambda k, a: a | {"psg": a["psg"] + np.deg2rad(0.4) * (k >= 26)})
    path = capture(tmp_path, configs, bench, air=True)
    with h5py.File(path) as h5:
        counts = h5["entry/instrument/detector/data"][:, 0]
    empty = np.flatnonzero((counts == 0).mean(axis=(1, 2)) > 0.01)
    assert 0 < empty.size < 10
    diagnosis = diagnosed(path, configs)
    assert diagnosis.captures[0].cut_off == tuple(empty)
    assert diagnosis.verdict == "explained"
    offset, slip = diagnosis.effects
    assert (offset.kind, slip.kind, slip.element) == ("detector_offset", "rotation_slip", "psg@26")
    assert offset.parameters["offset"].value == pytest.approx(-1100, abs=3.5 * offset.parameters["offset"].stderr)
    assert slip.parameters["slip"].value == pytest.approx(0.4, abs=3.5 * slip.parameters["slip"].stderr)


def test_what_each_effect_would_explain_is_part_of_the_residual_that_is_shown(configs, tmp_path):
    """Of bright and dim pixels the table had another rms than the figures above it: each effect made it larger."""
    diagnosis = diagnosed(capture(tmp_path, configs, TrueBench(), air=False, seed=4), configs)
    assert diagnosis.verdict == "consistent"
    assert len(diagnosis.ranking) == 10
    for effect in diagnosis.ranking:
        assert effect.rms_percent < diagnosis.error_before.rms_percent
        # Chance gains one for each value, here with five standard deviations.
        assert effect.evidence < effect.values + 5 * np.sqrt(2 * effect.values)


@pytest.mark.long
def test_nothing_wrong_is_consistent(configs, tmp_path):
    """What a pixel's residual shares with its own fit, through noise that differs from state to state, adds up."""
    diagnosis = diagnosed(capture(tmp_path, configs, TrueBench(rows=400, columns=400), air=False, seed=4), configs)
    assert diagnosis.verdict == "consistent"
    assert max(diagnosis.captures[0].tests_before.values()) < 4


@pytest.mark.long
def test_random_gains_in_air_are_not_given_a_name(configs, tmp_path):
    """One known sample and one channel: a gain for each state explains anything, so it explains nothing."""
    bench = TrueBench()
    gains = 1 + 0.01 * np.random.default_rng(3).standard_normal(STATES)
    bench.level.append(lambda k, a: float(gains[k]))
    d = diagnosed(capture(tmp_path, configs, bench, air=True), configs)
    assert d.verdict == "unexplained"
    assert d.effects == ()
    assert "source_flicker" in d.ranking[0].candidate


@pytest.mark.long
def test_a_small_effect_beside_an_image_that_wanders_by_a_pixel(configs, tmp_path):
    """Second derivatives of the image leave more of such a shift than the other effect explains."""
    bench = TrueBench(rows=32, columns=32, og=np.deg2rad(-17.02 + 0.5))
    bench.shift.append(lambda k, a: (0.9 * np.cos(a["psg"]), 0.9 * np.sin(a["psg"])))
    path = capture(tmp_path, configs, bench, air=False)
    diagnosis = diagnosed(path, configs)
    assert diagnosis.verdict == "explained"
    assert diagnosis.error_after.chi2_reduced == pytest.approx(1.0, abs=0.03)
    by_kind = {e.kind: e for e in diagnosis.effects}
    assert set(by_kind) == {"beam_wander", "psg_azimuth"}
    for name, true in (("x_cos", 0.9), ("x_sin", 0.0), ("y_cos", 0.0), ("y_sin", 0.9)):
        value = by_kind["beam_wander"].parameters[name]
        assert value.value == pytest.approx(true, abs=3.5 * value.stderr)
    # What is written is consistent the next time.
    write_instrument(tmp_path / "new.yaml", InstrumentModel.load(configs / "instruments/rgb950.yaml"), diagnosis)
    second = diagnose_captures([path], InstrumentModel.load(tmp_path / "new.yaml"))[0].diagnosis
    assert second.verdict == "consistent"


@pytest.mark.long
def test_a_shift_of_an_even_image_cannot_be_seen(configs, tmp_path):
    def unobservable(waves: float) -> set[str]:
        random, bench = np.random.default_rng(7), TrueBench(rows=64, columns=64)
        scene, angles = TrueScene(random), state_angles(STATES, False, False)
        scene.waves *= waves
        path = tmp_path / f"waves{waves:g}.h5"
        counts = digitize(bench, expose(bench, scene, angles), random)
        text = (configs / "instruments/rgb950.yaml").read_text()
        write_capture(path, bench, counts, angles, sample=Sample(kind="unknown"), instrument=text)
        return {name.partition(" ")[0].partition("[")[0] for name in diagnosed(path, configs).unobservable}

    shifts = {"image_drift", "beam_wander"}
    assert shifts <= unobservable(0.0)
    assert not shifts & unobservable(1.0)


@pytest.mark.long
def test_a_second_effect_beside_a_retardance_that_varies_over_the_image(configs, tmp_path):
    """Every tile has a matrix of its own then, and the counts are corrected all the same."""
    bench = TrueBench(rows=40, columns=40)
    x = np.linspace(-1, 1, 40)
    bench.field_retardance = np.deg2rad(np.broadcast_to(1.5 * x, (40, 40)))
    bench.shift.append(lambda k, a: (0.8 * k / (STATES - 1), 0.0))
    diagnosis = diagnosed(capture(tmp_path, configs, bench, air=True), configs)
    assert diagnosis.verdict == "explained"
    by_kind = {e.kind: e for e in diagnosis.effects}
    assert set(by_kind) == {"field_retardance", "image_drift"}
    for effect, x in (("field_retardance", 1.5), ("image_drift", 0.8)):
        for name, true in (("x", x), ("y", 0.0)):
            estimate = by_kind[effect].parameters[name]
            assert estimate.value == pytest.approx(true, abs=3.5 * estimate.stderr), name


def test_shifts_on_a_mosaic_are_told_in_pixels_of_the_sensor(configs, tmp_path):
    file = configs / "instruments/mosaic_polarimeter.yaml"
    random, nm = np.random.default_rng(3), 662.0
    model = InstrumentModel.load(file)
    bench = declared_bench(model.at(nm), nm, 64, mosaic=True, electrons=20_000.0)
    bench.shift.append(lambda k, a: (1.2 * k / 15, -0.7 * k / 15))
    angles = {"psg": state_angles(16, True, False)["psg"]}
    counts = digitize(bench, expose(bench, TrueScene(random), angles), random)
    path = tmp_path / "capture.h5"
    write_capture(path, bench, counts, angles, sample=Sample(kind="unknown"), instrument=file.read_text())
    (effect,) = diagnose_captures([path], model)[0].diagnosis.effects
    assert effect.kind == "image_drift"
    for name, true in (("x", 1.2), ("y", -0.7)):
        value = effect.parameters[name]
        assert value.value == pytest.approx(true, abs=3.5 * value.stderr)
        assert value.stderr < 0.2


@pytest.mark.long
def test_what_changes_in_a_part_of_the_image_is_no_source(configs, tmp_path):
    bench = TrueBench(rows=40, columns=40)
    bench.material_level.append((0, lambda k: 1 + 0.15 * (1 - np.exp(-3 * k / STATES))))
    diagnosis = diagnosed(capture(tmp_path, configs, bench, air=True), configs)
    assert not [e for e in diagnosis.effects if e.confident]
    assert diagnosis.verdict == "unexplained"


@pytest.mark.long
def test_what_is_written_is_used_and_nothing_is_overwritten(configs, tmp_path, capsys):
    path = capture(tmp_path, configs, TrueBench(dg=np.deg2rad(129.0)), air=True)
    instrument, new = configs / "instruments/rgb950.yaml", tmp_path / "new.yaml"
    report, out = tmp_path / "report.html", tmp_path / "out.json"
    call = [str(path), "--instrument", str(instrument), "--write", str(new)]
    assert exit_code(cli.main, *call, "--json", out, "--report", report, "--residuals", tmp_path / "r.npz") == 0
    assert "psg_retardance" in capsys.readouterr().out
    keys = {"verdict", "error_before", "error_after", "noise_floor_percent", "effects", "unobservable"}
    document = json.loads(out.read_text())
    assert keys | {"recommendation"} <= set(document)
    assert {"kind", "element", "parameters", "evidence", "indistinguishable_from"} <= set(document["effects"][0])
    assert {"rms_percent", "chi2_reduced", "held_out"} <= set(document["error_after"])
    page = report.read_text()
    assert page.count("data:image/png;base64,") == 2
    assert 'src="http' not in page
    assert "SIMULATED" in page
    (residuals,) = read_residuals(tmp_path / "r.npz")
    loud = {moment: np.nanmean(np.square(image.astype(float))) for moment, image in residuals.images.items()}
    assert loud["after"] < loud["before"]
    assert residuals.images["after"].shape[0] == len(residuals.per_state["after"]) == STATES
    model = InstrumentModel.load(new)
    assert model.effects[0].kind == "psg_retardance"
    assert model.effects[0].captures == (path.stem,)
    # Found at 662 nm: it is not carried over to another wavelength.
    assert [len(model.at(nm).effects) for nm in (662, 451)] == [1, 0]
    assert diagnose_captures([path], model)[0].diagnosis.verdict == "consistent"
    assert exit_code(cli.main, *call) == 2
    assert "exists" in capsys.readouterr().err
    for name, target in (("--json", out), ("--report", report)):
        content = target.read_bytes()
        assert exit_code(cli.main, *call[:3], name, target) == 2
        assert f"{target} exists and is not replaced" in capsys.readouterr().err
        assert target.read_bytes() == content


@pytest.mark.long
def test_an_instrument_file_that_is_larger_than_what_is_read_is_not_written(configs, tmp_path, monkeypatch):
    path = capture(tmp_path, configs, TrueBench(rows=8, columns=8, dg=np.deg2rad(129.0)), air=True)
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    diagnosis = diagnosed(path, configs)
    monkeypatch.setattr(yaml_file, "MOST_BYTES", 1000)
    with pytest.raises(WriteError, match="diagnose fewer captures"):
        write_instrument(tmp_path / "large.yaml", model, diagnosis)
    assert not (tmp_path / "large.yaml").exists()


@pytest.mark.parametrize(
    ("value", "stderr", "text"),
    [
        (0.0027915, 0.0022, "0.0028 ± 0.0022"),
        (-484.19, 0.65, "-484.19 ± 0.65"),
        (1234.5, 38.0, "1234 ± 38"),
        (2.0, None, "2"),
        ((0.1, -0.2), (0.01, 0.01), "2 values, -0.2 to 0.1"),
    ],
)
def test_a_value_is_told_as_far_as_it_is_known(value, stderr, text):
    assert EffectParameter(value=value, stderr=stderr, unit="1").text == text


def test_states_at_which_an_axis_may_have_slipped_are_told_in_one():
    alternatives = (
        "rotation_slip[psa@17]",
        "analyzer_azimuth",
        "rotation_slip[psa@2]",
        "rotation_slip[psg@5]",
        "psa_azimuth[p]",
    )
    names = FoundEffect(
        kind="rotation_ratio",
        element="psa",
        parameters={},
        evidence=7.0,
        indistinguishable_from=alternatives,
        scope="instrument",
        removal_chance=0.0,
        confident=True,
    ).could_be
    states = "rotation_slip[psa] from one of the states 2 to 17"
    assert names == (states, "analyzer_azimuth", "rotation_slip[psg@5]", "psa_azimuth[p]")
