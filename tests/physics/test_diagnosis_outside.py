"""What no effect of the list has a name for is not called after one that looks like it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from processing.arrays import Array
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.search.result import Diagnosis
from processing.instrument.changes import Changes, Conditions
from processing.instrument.grammar import parse_sentence
from processing.instrument.grammar import sentences as sentences_of
from processing.instrument.model import InstrumentModel
from processing.storage.captures.schema import Sample
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.importing import import_capture
from processing.yaml_file import dump_yaml
from simulators.blind.outside_list import ghost, image_lag, lamp_jump
from simulators.blind.real_bench import RoundSample
from simulators.blind.undeclared_captures import (
    TrueBench,
    TrueScene,
    declared_bench,
    digitize,
    expose,
    state_angles,
    write_capture,
)
from simulators.blind.undeclared_faults import busy_machine, etalon, lamp_beat

STATES, PIXELS, NM = 40, 32, 662.0


@pytest.fixture
def bench(configs: Path) -> TrueBench:
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(NM)
    return declared_bench(model, NM, PIXELS, False, electrons=20_000.0)


def diagnosed(folder: Path, configs: Path, bench: TrueBench, drift_counts: float = 0.0) -> Diagnosis:
    """A bright disc before a dark background, of unknown Mueller matrix; the black level may drift."""
    random, angles = np.random.default_rng(4), state_angles(STATES, False, False)
    light = expose(bench, RoundSample(random), angles)
    return diagnosed_from(folder, configs, bench, light, random=random, drift_counts=drift_counts)


def diagnosed_from(
    folder: Path,
    configs: Path,
    bench: TrueBench,
    light: Array,
    *,
    random: np.random.Generator,
    sample: str = "unknown",
    drift_counts: float = 0.0,
) -> Diagnosis:
    """The same of the light of any sample."""
    file, path = configs / "instruments/rgb950.yaml", folder / "capture.h5"
    counts = digitize(bench, light, random)
    moved = np.round(np.linspace(0, drift_counts, STATES)).reshape(-1, *(1,) * (counts.ndim - 1))
    counts = (counts + moved).astype(counts.dtype)
    angles = state_angles(STATES, False, False)
    write_capture(path, bench, counts, angles, sample=Sample(kind=sample), instrument=file.read_text())
    return diagnose_captures([path], InstrumentModel.load(file))[0].diagnosis


def sure(diagnosis: Diagnosis) -> list[str]:
    return [e.kind for e in diagnosis.effects if e.answer == "sure"]


def sentences(diagnosis: Diagnosis) -> list[str]:
    """What is named, or could be, that has no name in the list."""
    names = [f"{e.kind}[{e.element}]" for e in diagnosis.effects] + [n for e in diagnosis.effects for n in e.could_be]
    return [name.partition("[")[2].rstrip("]") for name in names if name.startswith("unlisted")]


@pytest.mark.long
def test_an_image_that_moves_is_told_from_a_ghost_that_goes_round(configs, tmp_path, bench):
    """To first order both move what is smooth; at the rim of the disc only one does."""
    turn = 2 * np.pi / STATES
    bench.shift.append(lambda k, a: (0.1 * np.cos(turn * k), 0.1 * np.sin(turn * k)))
    assert sure(diagnosed(tmp_path, configs, bench)) == ["beam_wander"]
    bench.shift.clear()
    ghost(bench, np.random.default_rng(6), STATES)
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert "beam_wander" in [e.kind for e in diagnosis.effects]
    assert not sure(diagnosis)


@pytest.mark.long
def test_an_image_that_moves_twice_a_turn_is_corrected_without_a_name(configs, tmp_path, bench):
    turn = 4 * np.pi / STATES
    bench.shift.append(lambda k, a: (0.15 * np.cos(turn * k), 0.15 * np.sin(turn * k)))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert [e.element for e in diagnosis.applied()] == ["shift right and shift down of image by 2 x psg"]


@pytest.mark.long
def test_a_focus_that_follows_a_plate_is_corrected_without_a_name(configs, tmp_path, bench):
    turn = 2 * np.pi / STATES
    bench.light.append(lambda k, e: gaussian_filter(e, np.sqrt(0.15 * (1 + np.cos(turn * k))), mode="nearest"))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert "blur of image by 1 x psg" in [e.element for e in diagnosis.applied()]


@pytest.mark.long
def test_a_cloud_before_the_lamp_is_no_fault_of_a_plate(configs, tmp_path, bench):
    bench.level.append(lambda k, a: 1 - 0.02 * np.exp(-(((k - 18) / 4) ** 2)))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert "gain of source wandering" in sentences(diagnosis)


@pytest.mark.long
def test_light_that_moves_over_a_disc_is_no_image_that_moves(configs, tmp_path, bench):
    x = np.linspace(-1, 1, PIXELS)
    bench.light.append(lambda k, e: e * (1 + 0.03 * x * (k / (STATES - 1) - 0.5)))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert sentences(diagnosis) == ["brightness right and brightness down of image over time"]
    assert not {"image_drift", "beam_wander"} & {e.kind for e in diagnosis.applied() if e.probability > 0.5}


@pytest.mark.long
def test_a_black_level_that_drifts_is_no_bent_response(configs, tmp_path, bench):
    diagnosis = diagnosed(tmp_path, configs, bench, drift_counts=200)
    assert not sure(diagnosis)
    # Warming is an exponential course that is nearly straight.
    assert sentences(diagnosis)[0] == "offset of detector over time"
    assert all(sentence.startswith("offset of detector ") for sentence in sentences(diagnosis))


@pytest.mark.parametrize(
    ("sentence", "values"),
    [
        ("diattenuation and diattenuation at 45 degrees of exit by 4 x hwp", [0.0, 0.004, 0.006, 0.0]),
        pytest.param("circular diattenuation of exit over time", [0.02], marks=pytest.mark.long),
    ],
)
def test_optics_before_a_prism_are_corrected_where_axes_turn_by_a_quarter(configs, tmp_path, sentence, values):
    """Beams move over a window and over the prism; of two channels only the ratio counts."""
    file, table = tmp_path / "dual.yaml", tmp_path / "states.csv"
    model = InstrumentModel.load(configs / "instruments/dual_beam_charis.yaml").with_values(
        {"image_rotator": {"retardance_deg": 100.0}}
    )
    file.write_text(dump_yaml(model.model_copy(update={"calibrate": (), "belongs_to": {}})))
    model, random = InstrumentModel.load(file), np.random.default_rng(7)
    turn = np.arange(64) % 8, np.arange(64) // 8
    angles = {"hwp": 11.25 * turn[0], "image_rotator": 45 + 12.5 * turn[1]}
    changes = Changes(Conditions.of(angles, ("left", "right")))
    parse_sentence(sentence).apply(changes, model, np.array(values))
    light = 1e5 * random.uniform(0.9, 1.1, (64, 1)) * (model.rows(angles, changes) @ np.eye(4).ravel())
    counts = light + 10 * random.standard_normal(light.shape)
    rows = np.column_stack([*angles.values(), counts, np.full(64, 10)]).tolist()
    lines = [f"{n}," + ",".join(map(str, row)) for n, row in enumerate(rows)]
    table.write_text("\n".join(["state,hwp_deg,image_rotator_deg,channel_left,channel_right,sigma", *lines]))
    request = ImportRequest(table, tmp_path / "air.h5", 1500, instrument=file, sample=Sample(kind="air"))
    import_capture(request)
    diagnosis = diagnose_captures([tmp_path / "air.h5"], model)[0].diagnosis
    assert not sure(diagnosis)
    assert sentence in sentences(diagnosis)
    assert diagnosis.error_after.chi2_reduced < 1.5 < diagnosis.error_before.chi2_reduced


def test_every_sentence_is_read_back_from_its_text(configs):
    """The text is the place of the effect in an instrument file; a knocked analyzer is among them."""
    angles = state_angles(STATES, False, False)
    conditions = Conditions.of({axis: np.rad2deg(angle) for axis, angle in angles.items()})
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(NM)
    candidates = sentences_of(model, conditions)
    for sentence in candidates:
        assert parse_sentence(sentence.text) == sentence
    assert "azimuth of analyzer from state 5" in [s.text for s in candidates]


def test_a_sentence_is_the_less_likely_the_more_there_are_of_its_kind(configs):
    angles = state_angles(STATES, False, False)
    conditions = Conditions.of({axis: np.rad2deg(angle) for axis, angle in angles.items()})
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(NM)
    prices = {s.text: s.price(conditions) for s in sentences_of(model, conditions)}
    lag = prices["lag of detector"]
    assert prices["stray of detector by 4 x psg"] > prices["stray of detector by 2 x psg"] == lag
    for kind in ("gain of source from state", "gain of source beating"):
        group = [price for text, price in prices.items() if text.startswith(kind)]
        assert np.exp(lag - np.array(group)).sum() == pytest.approx(1, abs=0.1)


def test_light_that_is_reflected_inside_a_plate_passes_it_three_times(configs):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(NM)
    angles = {axis: np.rad2deg(angle) for axis, angle in state_angles(STATES, False, False).items()}
    changes = Changes(Conditions.of(angles))
    parse_sentence("inner reflection of psa_retarder").apply(changes, model, np.array([0.01]))
    thrice = [
        e.model_copy(update={"retardance_deg": 3 * e.retardance_deg}) if e.name == "psa_retarder" else e
        for e in model.analyzer
    ]
    ghost = model.model_copy(update={"analyzer": tuple(thrice)})
    assert model.rows(angles, changes) == pytest.approx(
        0.99 * model.rows(angles) + 0.01 * ghost.rows(angles), abs=1e-12
    )


@pytest.mark.long
def test_a_plate_whose_retardance_changes_twice_a_turn_is_not_called_a_transmission(configs, tmp_path, bench):
    turn = 4.91 * 2 * np.pi / STATES
    bench.retardance.append(lambda k, a: (0.0, np.deg2rad(1.5) * np.cos(2 * turn * k - 0.4)))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert "retardance of psa_retarder by 2 x psa" in sentences(diagnosis)
    bench.retardance.clear()
    bench.level.append(lambda k, a: 1 + 0.01 * np.cos(turn * k - 0.4) + 0.005 * np.cos(2 * turn * k))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert sure(diagnosis) == ["retarder_transmission"]


@pytest.mark.long
def test_optics_that_differ_from_part_to_part_are_not_called_by_their_name(configs, tmp_path, bench):
    """A magnification that follows the plate moves the rim alone; nothing of a train does."""
    y, x = np.mgrid[:PIXELS, :PIXELS] - (PIXELS - 1) / 2
    bench.shift.append(lambda k, a: tuple(0.01 * np.cos(2 * a["psg"]) * place for place in (x, y)))
    assert not sure(diagnosed(tmp_path, configs, bench))


@pytest.mark.long
def test_a_sample_that_turns_is_not_angles_of_an_axis(configs, tmp_path, bench):
    """Its azimuth drifts with all plates and polarizers; single angles of the analyzer can stand for that."""
    bench.turned.append(lambda k: np.deg2rad(-0.8) * (k / (STATES - 1) - 0.5))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert "azimuth of sample over time" in sentences(diagnosis)


@pytest.mark.long
def test_frames_that_are_read_with_the_next_ones_are_not_angles_of_an_axis(configs, tmp_path, bench):
    image_lag(bench, np.random.default_rng(5), STATES)
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert "lag of detector" in sentences(diagnosis)


@pytest.mark.long
def test_a_lamp_that_drifts_while_the_machine_is_busy(configs, tmp_path):
    """The states come unevenly, and the host stamps them late: the camera's clock shows by how much."""
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml").at(NM)
    bench, random = declared_bench(model, NM, 96, False, electrons=20_000.0), np.random.default_rng(7)
    times = busy_machine(bench, random, STATES)
    bench.late_s = random.exponential(0.5, STATES)
    bench.level.append(lambda k, a: 1 + 0.1 * (times[k] - 0.5))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert [e.kind for e in diagnosis.effects] == [e.kind for e in diagnosis.applied()] == ["source_drift"]


@pytest.mark.long
def test_a_lamp_that_jumps_is_no_source_that_drifts(configs, tmp_path, bench):
    lamp_jump(bench, np.random.default_rng(3), STATES)
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert not sure(diagnosis)
    assert any(sentence.startswith("gain of source from state") for sentence in sentences(diagnosis))
    bench.level.clear()
    bench.level.append(lambda k, a: 1 + 0.01 * k / (STATES - 1))
    assert sure(diagnosed(tmp_path, configs, bench)) == ["source_drift"]


@pytest.mark.long
@pytest.mark.parametrize(("fault", "seed"), [(etalon, 9002), (lamp_beat, 9003)])
def test_a_wave_of_any_frequency_is_no_fault_of_the_plate(fault, seed, configs, tmp_path, bench):
    """Two waves of the grid, or the plate's own, explain a part of a wave between them."""
    fault(bench, np.random.default_rng(seed), STATES)
    assert set(sure(diagnosed(tmp_path, configs, bench))) <= {"source_flicker"}


@pytest.mark.long
def test_a_name_beside_a_fault_without_one_is_likely(configs, tmp_path, bench):
    """An unknown mechanism has more parts than its sentence, and effects of the list describe them as well."""
    turn = 2 * np.pi / STATES
    bench.shift.append(lambda k, a: (0.1 * np.cos(turn * k), 0.1 * np.sin(turn * k)))
    assert sure(diagnosed(tmp_path, configs, bench)) == ["beam_wander"]
    bench.retardance.append(lambda k, a: (0.0, np.deg2rad(1.5) * np.cos(2 * 4.91 * turn * k - 0.4)))
    diagnosis = diagnosed(tmp_path, configs, bench)
    assert {e.kind: e.answer for e in diagnosis.effects} == {"unlisted": "unlisted", "beam_wander": "likely"}
    assert diagnosis.verdict == "explained"


@pytest.mark.long
@pytest.mark.parametrize("sample", ["air", "unknown"])
def test_light_of_two_directions_in_a_plate_is_no_plate_that_is_turned(sample, configs, tmp_path, bench):
    """An unknown sample takes up all of it but what an azimuth does as well; air shows its parts, which are many."""
    random, angles = np.random.default_rng(4), state_angles(STATES, False, False)
    scene = TrueScene(random, np.eye(4)) if sample == "air" else RoundSample(random)
    tilted = replace(bench, og=bench.og + 0.6)
    light = 0.97 * expose(bench, scene, angles) + 0.03 * expose(tilted, scene, angles)
    diagnosis = diagnosed_from(tmp_path, configs, bench, light, random=random, sample=sample)
    assert not sure(diagnosis)
    assert any("psg_retarder" in sentence for sentence in sentences(diagnosis))
    assert diagnosis.applied()
