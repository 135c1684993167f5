"""Benches with many small faults: what is written, what the judge says of answers that are known, and one diagnosis.

`python benchmarks/real_benches.py DIR` runs the suite.
"""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel, SystematicError
from simulators.blind.bench_judge import WIRING_WORDS, BenchJudgement, matters_of, names_of, wiring_of
from simulators.blind.bench_oracle import read_oracle
from simulators.blind.bench_run import judge_bench
from simulators.blind.bench_table import MATTERS, is_worse, reliability, sure_and_wrong, table
from simulators.blind.mueller_error import Reduced, coverage_of, error_of
from simulators.blind.real_bench import GROUPS, MOSAIC, RGB950, RealBench, TrueFault, make_bench, read_truth
from simulators.blind.reliability_diagram import draw
from simulators.blind.undeclared_captures import TrueScene, declared_bench, digitize, expose, state_angles

SMALL = 24
#: Of a bench whose sources drift and flicker.
SEED = 16


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    from tests.conftest import ROOT

    folder = tmp_path_factory.mktemp("benches")
    return folder, make_bench(folder, SEED, ROOT / "configs", pixels=SMALL)


def counts(path):
    with h5py.File(path) as h5:
        return h5["entry/instrument/detector/data"][:, 0].astype(float)


def test_bench_has_its_faults_in_every_capture_and_its_truth_apart(bench):
    folder, truth = bench
    assert 6 <= len({f.kind for f in truth.faults}) <= 10
    assert next(read_truth(folder)) == truth
    captures = {f.capture for f in truth.faults if f.kind == "source_flicker"}
    assert captures == {"sphere", "flat", "air"}
    assert len({str(f.parameters) for f in truth.faults if f.kind == "source_drift"}) == 3
    for path in (folder / truth.name).iterdir():
        with h5py.File(path) as h5:
            header = h5["entry"].attrs["header_json"]
        assert not any(f.kind in header for f in truth.faults)


def test_intervals_hold_what_the_instrument_file_leaves_uncertain(bench, configs):
    """Declared values are off by more than noise; with a retardance that may be off by five degrees they are within."""
    folder, truth = bench
    truth_folder = folder / "truth" / truth.name
    declared = InstrumentModel.load(configs / "instruments" / truth.instrument)
    five = {"retardance": EffectParameter(value=5.0, unit="degree")}
    uncertain = tuple(
        (AppliedEffect(kind=f"{axis}_retardance", element=f"{axis}_retarder", parameters=five),)
        for axis in ("psg", "psa")
    )
    error = SystematicError(directions=uncertain, rms_over_m00=0.1, wavelength_nm=truth.wavelength_nm)
    exact = np.load(truth_folder / "validation.npy").astype(float)
    noise, full = (
        coverage_of(truth_folder / "validation_noisy.h5", declared.model_copy(update={"systematic": s}), exact)
        for s in ((), (error,))
    )
    assert full.patches > noise.patches + 0.05
    assert full.pixels > noise.pixels


@pytest.mark.long
def test_same_seed_gives_the_same_bench(bench, tmp_path, configs):
    folder, truth = bench
    assert make_bench(tmp_path, SEED, configs, pixels=SMALL) == truth
    np.testing.assert_array_equal(
        counts(tmp_path / truth.name / "sphere.h5"), counts(folder / truth.name / "sphere.h5")
    )


def test_noise_is_the_difference_from_the_twin_without_noise(bench):
    folder, truth = bench
    noisy, quiet = (counts(f / truth.name / "air.h5") for f in (folder, folder / "truth"))
    gain = 0.5
    expected = (quiet - 100) / gain + (3.0 / gain) ** 2
    assert np.mean((noisy - quiet) ** 2 / expected) == pytest.approx(1.0, abs=0.02)


def test_true_values_mend_the_validation_sample(bench, configs):
    folder, truth = bench
    truth_folder = folder / "truth" / truth.name
    declared = InstrumentModel.load(configs / "instruments" / truth.instrument)
    exact = np.load(truth_folder / "validation.npy").astype(float)
    effects = tuple(
        AppliedEffect(
            kind=f.kind,
            element=f.place or None,
            parameters={n: EffectParameter(value=v, unit="1") for n, v in f.parameters.items()},
            wavelength_nm=truth.wavelength_nm,
        )
        for f in truth.faults
        if f.capture is None
    )
    before = Reduced.of(truth_folder / "validation.h5", declared).error(exact)
    mended = declared.model_copy(update={"effects": effects})
    assert before > 3e-3
    assert Reduced.of(truth_folder / "validation.h5", mended).error(exact) < before / 20
    covered = Reduced.of(truth_folder / "validation_noisy.h5", mended).coverage(exact)
    # Some thousand values; the few means over patches say less.
    assert covered.pixels == pytest.approx(0.95, abs=0.02)
    assert Reduced.of(truth_folder / "validation_noisy.h5", declared).coverage(exact).patches < 0.8


@pytest.mark.parametrize(
    ("group", "kind"), [(group, kind) for group, kinds in GROUPS.items() for kind in kinds], ids=lambda name: name
)
def test_every_fault_changes_what_a_capture_file_says(group, kind, configs):
    mosaic = group.startswith("mosaic")
    polarimeter = MOSAIC if mosaic else RGB950
    model = InstrumentModel.load(configs / "instruments" / polarimeter.instrument).at(662)
    angles = state_angles(polarimeter.states, mosaic, False)

    def stored(faults):
        bench = declared_bench(model, 662.0, 16, mosaic, electrons=15_000.0)
        truths = [fault(bench, np.random.default_rng(3), polarimeter.states) for fault in faults]
        light = expose(bench, TrueScene(np.random.default_rng(4)), angles)
        angles_in_file = angles
        for change in bench.recorded:
            angles_in_file = change(angles_in_file)
        return truths, digitize(bench, light, np.random.default_rng(5)), angles_in_file, bench.declared

    (truth,), *changed = stored([GROUPS[group][kind]])
    assert truth.kind == kind
    _, counts, angles_in_file, declared = stored([])
    equal = [np.array_equal(counts, changed[0]), str(angles_in_file) == str(changed[1]), declared == changed[2]]
    assert not all(equal)


def test_fit_of_the_truth_is_far_better_than_the_declared_instrument(bench, configs):
    folder, truth = bench
    truth_folder = folder / "truth" / truth.name
    declared = InstrumentModel.load(configs / "instruments" / truth.instrument)
    exact = np.load(truth_folder / "validation.npy").astype(float)
    assert (
        read_oracle(folder, truth, configs, "joint")
        < Reduced.of(truth_folder / "validation.h5", declared).error(exact) / 3
    )


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(("group", "seed", "role"), [("none", 1, "joint"), ("real", 5, "sphere"), ("real", 7, "air")])
def test_answer_to_a_small_bench_harms_nothing(group, seed, role, configs, tmp_path):
    judgement, result = judge_bench(tmp_path, make_bench(tmp_path, seed, configs, group, pixels=SMALL), configs, role)
    assert not sure_and_wrong(judgement)
    assert not is_worse(judgement.declared, judgement.corrected)
    # A correction that is hardly better than none says so: it may lose.
    grows = [c["after"] for c in result["correction"]["checks"] if c["name"].endswith("error of M/m00 grows")]
    assert max(grows, default=0.0) > 0.3 or not any(is_worse(*pair) for pair in judgement.own.values())
    if group == "none":
        assert result["verdict"] == "consistent"


#: Groups with one fault or none: capture that is given, and seeds. The seed goes through the faults of a group in turn.
BLIND = {
    "single": ("air", range(0, 20, 8)),
    "mosaic": ("sphere", range(0, 4, 2)),
    "outside": ("sphere", range(0, 9, 8)),
    "none": ("sphere", range(1000, 1001)),
}


@pytest.mark.long
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("group", "role", "seed"), [(group, role, seed) for group, (role, seeds) in BLIND.items() for seed in seeds]
)
def test_one_undeclared_fault_gets_its_name_or_none(group, role, seed, configs, tmp_path):
    judgement, _ = judge_bench(tmp_path, make_bench(tmp_path, seed, configs, group, pixels=SMALL), configs, role)
    assert not sure_and_wrong(judgement)
    assert not is_worse(judgement.declared, judgement.corrected)
    if group == "single":
        # In air, where the sample is known, each fault of the instrument can be seen.
        assert [m.told for m in judgement.matters if m.size > MATTERS / 3] == ["named"]
    if group == "none":
        assert judgement.verdict == "consistent"


def test_what_cannot_be_reduced_has_an_infinite_error(tmp_path, configs):
    truth = make_bench(tmp_path, list(GROUPS["wiring"]).index("ratio"), configs, "wiring", pixels=16)
    truth_folder = tmp_path / "truth" / truth.name
    declared = InstrumentModel.load(configs / "instruments" / truth.instrument)
    exact = np.load(truth_folder / "validation.npy").astype(float)
    assert error_of(truth_folder / "validation.h5", declared, exact) == np.inf
    assert np.isnan(coverage_of(truth_folder / "validation_noisy.h5", declared, exact).pixels)


def truth_of(*faults):
    return RealBench("real_0000", "real", 0, "rgb950.yaml", 662.0, faults)


def effect(kind, element=None, capture=None, also=(), **more):
    return {
        "kind": kind,
        "element": element,
        "capture": capture,
        "indistinguishable_from": also,
        "confident": True,
    } | more


def test_a_name_is_right_at_its_place_and_in_its_capture():
    truth = truth_of(
        TrueFault("rotation_slip", "psa@11", {"slip": 0.3}, "air", {"air": 4.0}),
        TrueFault("psg_extinction", "psg_polarizer", {}, None, {"sphere": 0.2, "validation": 2.0}),
    )
    result = {
        "effects": [
            effect("rotation_slip", "psa@11", "air (air.h5)"),
            effect("rotation_slip", "psa@11", "flat (flat.h5)"),
            effect("rotation_slip", "psg@11", "air (air.h5)", answer="likely", probability=0.93),
            effect("stray_light", also=("psg_extinction[psg_polarizer]",)),
            effect("source_drift", confident=False),
        ]
    }
    causes = names_of(result, truth, ("flat", "air"))
    assert [c.right for c in causes] == [True, False, False, False, False]
    assert [c.right_set for c in causes] == [True, False, False, True, False]
    assert [c.certainty for c in causes] == ["sure", "sure", "likely", "one_of", "unknown"]
    assert [m.told for m in matters_of(result, truth, ("flat", "air"))] == ["named", "in a set"]
    # What acts in another capture only is not asked of these.
    assert [m.label for m in matters_of(result, truth, ("sphere",))] == ["psg_extinction[psg_polarizer]"]


def test_sentence_about_wiring_has_to_say_what_is_wrong():
    assert set(WIRING_WORDS) == {*GROUPS["wiring"], *GROUPS["mosaic_wiring"]}
    truth = truth_of(TrueFault("psa_reversed", "", {}, None))
    (right,) = wiring_of({"wiring": "axis 'psa' turns the other way: in the instrument file, 'x': ratio: -1"}, truth)
    (wrong,) = wiring_of({"wiring": "axis 'psg' turns the other way: in the instrument file, 'x': ratio: -1"}, truth)
    assert (right.right, wrong.right) == (True, False)
    assert wiring_of({"wiring": None}, truth) == wiring_of({}, truth) == ()


def test_table_counts_what_is_worse_and_what_is_sure_and_wrong(tmp_path):
    good = BenchJudgement(
        "a", "real", "joint", "explained", 2.0, 4e-3, 1e-3, 0.9e-3, {"air": (3e-3, 1e-3)}, 0.95, 0.95, True
    )
    truth = truth_of(TrueFault("source_drift", "", {}, "air", {"air": 2.0}))
    wrong = names_of({"effects": [effect("tone_curve")]}, truth, ("air",))
    bad = replace(good, name="b", corrected=5e-3, causes=wrong)
    text = table([good, bad])
    assert "M worse than uncorrected: 1 " in text
    assert "at most 1.2 times the fit with the true set: 50.0 % of 2" in text
    assert "sure and wrong: tone_curve[]" in text
    (only,) = reliability([good, bad])
    assert (only.count, only.true) == (1, 0.0)
    assert not is_worse(1e-3, 1e-3)
    draw([good, bad], tmp_path / "reliability.png")
    assert (tmp_path / "reliability.png").stat().st_size > 5_000
