"""Mistakes of wiring are told in words, with the line to change, and none is seen where there is none."""

import numpy as np
import pytest
from bench_capture import bench_capture, read

from processing.computing.blas import one_blas_thread
from processing.diagnosis.instrument.diagnose import diagnose, diagnose_captures
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.diagnosis.instrument.wiring import find_train_miswiring, likeliest_arrangement
from processing.diagnosis.verdict.report import write_diagnosis_report
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from simulators.blind.emulated_instruments import BENCHES, INSTRUMENTS, SAMPLE, emulated_capture
from simulators.blind.undeclared_captures import TrueBench


def problem(folder, configs, bench, report_angles, air):
    """A capture whose file tells the angles `told`; the bench knows the true ones."""
    file = configs / "instruments/rgb950.yaml"
    model, data = read(bench_capture(folder, file, bench, air, seed=4, report_angles=report_angles), file)
    return InstrumentProblem(model, [data])


def diagnosed(tried):
    with one_blas_thread():
        return diagnose(tried, lambda line: None).diagnosis


#: What a file tells of its angles, what the message says of it, and the samples whose test is not long.
MISTAKES = (
    (lambda a: a | {"psa": -a["psa"]}, "'psa' turns the other way", ["air"]),
    (lambda a: {"psg": a["psa"], "psa": a["psg"]}, "each other's place", ["unknown"]),
    (lambda a: a | {"psg": 2 * a["psg"]}, "'psg' are told in half degrees", []),
    (lambda a: {k: 2 * v for k, v in a.items()}, "'psa' and 'psg' are told in half degrees", ["unknown"]),
    (lambda a: {k: v / 2 for k, v in a.items()}, "'psa' and 'psg' are told in units of two degrees", []),
    (lambda a: a | {"psa": a["psa"] * 4.91 / 5}, "5 instead of 4.91", ["air"]),
    (lambda a: {k: np.roll(v, 1) for k, v in a.items()}, "one early", ["unknown"]),
)


@pytest.mark.parametrize(
    ("report_angles", "word", "sample"),
    [
        pytest.param(angles, word, sample, marks=[] if sample in short else pytest.mark.long, id=f"{word}-{sample}")
        for angles, word, short in MISTAKES
        for sample in ("air", "unknown")
    ],
)
def test_a_mistake_is_told(configs, tmp_path, report_angles, word, sample):
    # Beside small faults of the optics, which are no mistake.
    air = sample == "air"
    bench = TrueBench(dg=np.deg2rad(128.0), lp=np.deg2rad(-0.2))
    mistake = likeliest_arrangement(problem(tmp_path, configs, bench, report_angles, air))
    assert mistake.message is not None
    assert word in mistake.message
    # An unknown sample takes up what tells some of them from a plate that is far off.
    assert not (air and mistake.is_open), mistake.message


@pytest.mark.parametrize("air", [True, False])
@pytest.mark.parametrize("degrees", [0.0, 1.0, 10.0])
def test_what_is_no_mistake_is_not_called_one(configs, tmp_path, air, degrees):
    bench = TrueBench(og=np.deg2rad(-17.02 + degrees), dg=np.deg2rad(127.12 + degrees))
    bench.level.append(lambda k, a: 1 + 0.02 * np.sin(k))
    assert likeliest_arrangement(problem(tmp_path, configs, bench, lambda a: a, air)).message is None


def test_a_table_of_an_unknown_sample_is_no_mistake(tmp_path):
    """Parts of 12 states with 16 unknowns each fit any mistake that mixes their rows."""
    file, bench = tmp_path / "drr_5to1.yaml", BENCHES["drr_5to1"]
    file.write_text((INSTRUMENTS / file.name).read_text())
    model = InstrumentModel.load(file)
    random = np.random.default_rng(1)
    path = emulated_capture(model.at(bench.nm), bench, SAMPLE, "unknown", file=file, random=random)
    diagnosis = diagnose_captures([path], model)[0].diagnosis
    assert (diagnosis.wiring, diagnosis.verdict) == (None, "consistent")


def test_an_effect_that_has_no_place_behind_exchanged_axes_is_no_error(configs, tmp_path):
    """A corrected file could not be diagnosed again: light does not go back from the analyzer to the generator."""
    file, place = configs / "instruments/rgb950.yaml", "retardance of psa_retarder by 1 x psg"
    model, data = read(bench_capture(tmp_path, file, TrueBench(), True, seed=4), file)
    values = {name: EffectParameter(value=0.01, unit="degree") for name in ("cos", "sin")}
    effect = AppliedEffect(kind="unlisted", element=place, parameters=values)
    model = model.model_copy(update={"effects": (effect,)})
    assert likeliest_arrangement(InstrumentProblem(model, [data])).message is None


@pytest.mark.parametrize("degrees", [18.0, 22.0])
def test_a_plate_that_is_far_off_is_no_other_wavelength(configs, tmp_path, degrees):
    """Its retardance is nearer to the one at 524 nm: that would leave a third of the residual, the plate nothing."""
    bench = TrueBench(da=np.deg2rad(94.78 + degrees))
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    assert likeliest_arrangement(problem(tmp_path, configs, bench, lambda a: a, True), declared).message is None


@pytest.mark.parametrize("air", [True, False])
def test_the_filter_of_another_wavelength_is_told(configs, tmp_path, air):
    # The plates of this bench have the retardances of 451 nm; the file says 662.
    bench = TrueBench(dg=np.deg2rad(130.01), da=np.deg2rad(143.13))
    declared = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    message = likeliest_arrangement(problem(tmp_path, configs, bench, lambda a: a, air), declared).message
    if not air:
        # Retardances are what an unknown sample absorbs: nothing is told, and nothing wrong.
        assert message is None or "451" in message
        return
    assert message is not None
    assert "the light is of 451 nm, not of 662" in message
    assert "wavelength_nm: 451" in message


@pytest.mark.parametrize(
    ("fault", "kind", "degrees"),
    [
        pytest.param({"oa": 13.41 + 28.0}, "psa_azimuth", 28.0, marks=pytest.mark.long),
        ({"dg": 127.12 - 47.0, "oa": 13.41 + 4.5}, "psg_retardance", -47.0),
        pytest.param({"lp": -0.53 - 53.0}, "analyzer_azimuth", -53.0, marks=pytest.mark.long),
    ],
)
def test_a_plate_that_is_far_off_is_found_in_air(configs, tmp_path, fault, kind, degrees):
    bench = TrueBench(**{name: np.deg2rad(value) for name, value in fault.items()})
    d = diagnosed(problem(tmp_path, configs, bench, lambda a: a, True))
    assert d.wiring is None
    assert d.correction.refused is None
    (found,) = (e.parameters for e in d.effects if e.kind == kind and e.answer == "sure")
    (value,) = found.values()
    assert value.value == pytest.approx(degrees, abs=0.1)
    assert {e.kind for e in d.effects} <= {kind, "psa_azimuth"}


def test_what_a_far_plate_does_as_well_is_told_with_the_mistake(configs, tmp_path):
    """With an unknown sample a generator that turns the other way is a plate at twice its azimuth."""
    d = diagnosed(problem(tmp_path, configs, TrueBench(), lambda a: a | {"psg": -a["psg"]}, False))
    assert "'psg' turns the other way" in d.wiring
    assert "psg_azimuth[psg_retarder] 34" in d.wiring
    assert d.verdict == "unexplained"
    # As declared M is wrong by a third, which no error of the bench without the mistake can say.
    assert d.correction.mueller is None
    write_diagnosis_report(tmp_path / "report.html", d, ())
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert 0 < page.find("First of all") < page.find("Recommendation")
    assert "Structure that no effect explains" not in page
    assert not [e for e in d.effects if e.answer == "sure"]


def test_two_plates_that_are_far_off_together_are_compared_with_a_mistake(configs, tmp_path):
    """Neither explains much alone. With an unknown sample two reversed axes are plates at twice their azimuths."""
    bench = TrueBench(og=np.deg2rad(-17.02 + 33.7), oa=np.deg2rad(13.41 - 21.2))
    message = likeliest_arrangement(problem(tmp_path, configs, bench, lambda a: a, False)).message
    assert "both axes turn the other way" in message
    assert "no mistake, but far values" in message


def test_a_quarter_turn_in_air_is_one_of_either_retarder(configs, tmp_path):
    bench = TrueBench(og=np.deg2rad(-17.02 + 90))
    message = likeliest_arrangement(problem(tmp_path, configs, bench, lambda a: a, True)).message
    assert "'psg_retarder' is a quarter turn off" in message
    assert "'psa_retarder' is a quarter turn off" in message


@pytest.mark.long
def test_axes_of_a_nominal_train_in_air_turn_against_each_other(tmp_path):
    """Which of both turns the other way, the azimuths of all plates hide."""
    file, bench = tmp_path / "drr_single_detector.yaml", BENCHES["drr_single_detector"]
    file.write_text((INSTRUMENTS / file.name).read_text())
    model, states = InstrumentModel.load(file), len(bench.angles_deg["psa"])
    as_they_were = bench.angles_deg | {"psa": -bench.angles_deg["psa"]}, np.ones(states)
    random = np.random.default_rng(5)
    path = emulated_capture(model.at(bench.nm), bench, np.eye(4), "air", file=file, random=random, wrong=as_they_were)
    wiring = diagnose_captures([path], model)[0].diagnosis.wiring
    assert wiring is not None
    assert wiring.startswith("one of these (look which is right)")
    assert all(f"axis {axis!r} turns the other way" in wiring for axis in ("psg", "psa"))


@pytest.mark.long
def test_a_mistake_is_told_where_the_train_has_nominal_values(configs, tmp_path):
    """Azimuths and retardances that `calibrate` leaves open do not mend an axis that turns the other way."""
    bench = TrueBench(rows=9, columns=9, og=np.deg2rad(-3.0), dg=np.deg2rad(120.0), oa=np.deg2rad(30.0))
    mirrored = problem(tmp_path, configs, bench, lambda a: a | {"psa": -a["psa"]}, air=True)
    nominal = ("psg_retarder.azimuth_deg", "psg_retarder.retardance_deg", "psa_retarder.azimuth_deg")
    mirrored.models = tuple(m.model_copy(update={"calibrate": nominal}) for m in mirrored.models)
    mirrored.model = mirrored.models[0]
    assert WholeBench(mirrored, lambda line: None).train_is_off
    found = find_train_miswiring(mirrored)
    assert found is not None
    assert "'psa' turns the other way" in found[0]
    straight = problem(tmp_path / "straight", configs, bench, lambda a: a, air=True)
    straight.models, straight.model = mirrored.models, mirrored.model
    assert not WholeBench(straight, lambda line: None).train_is_off
