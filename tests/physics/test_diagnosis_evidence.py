"""What a diagnosis tells: consistency, combinations, directions that stay uncertain, and its files."""

from types import SimpleNamespace as Some

import numpy as np
import pytest
from bench_capture import bench_capture

from processing.commands import diagnose
from processing.commands.loaded_late import diagnose_summary
from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument.mueller_error import MOST_STORED, MuellerErrors, leading_directions
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.likely_set import likely_set
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets
from processing.diagnosis.search.space import Space
from processing.diagnosis.verdict.answer import ties
from processing.effect import Parameter
from processing.instrument.model import InstrumentModel
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from simulators.blind.undeclared_captures import TrueBench, state_angles

STATES = 18


@pytest.fixture
def judged(tmp_path, configs):
    instrument = configs / "instruments/rgb950.yaml"

    def diagnosed(scatter: float, sigma: float | None):
        """One pixel in air, its intensities off by random amounts of so many times their mean."""
        angles = state_angles(STATES, False, False)
        w = InstrumentModel.load(instrument).at(662).rows(angles).reshape(STATES, 16)
        light = 1000 * w @ np.eye(4).reshape(16)
        light = light + scatter * light.mean() * np.random.default_rng(2).standard_normal(STATES)
        column, value = ("", "") if sigma is None else (",sigma", f",{sigma * light.mean()}")
        lines = [f"state,psg_deg,psa_deg,channel_camera{column}"]
        pairs = zip(angles["psg"], angles["psa"], light, strict=True)
        lines += [f"{k},{g},{a},{y}{value}" for k, (g, a, y) in enumerate(pairs)]
        states = tmp_path / "states.csv"
        states.write_text("\n".join(lines) + "\n", encoding="utf-8")
        request = ImportRequest(
            states=states, out=tmp_path / "c.h5", wavelength_nm=662, instrument=instrument, sample=read_sample("air")
        )
        import_capture(request)
        return diagnose_captures([tmp_path / "c.h5"], InstrumentModel.load(instrument))[0].diagnosis

    return diagnosed


@pytest.mark.long
def test_one_pixel_without_noise_that_scatters_widely(judged):
    d = judged(0.3, None)
    assert d.verdict in ("undetermined", "unexplained")
    if d.verdict == "undetermined":
        assert "sigma" in d.recommendation


def test_one_pixel_that_scatters_far_more_than_its_noise(judged):
    assert judged(0.3, 0.005).verdict == "unexplained"


def test_one_pixel_that_is_as_precise_as_it_says(judged):
    d = judged(0.0005, 0.0005)
    assert d.verdict == "consistent"
    assert d.error_before.chi2_reduced == pytest.approx(1.0, abs=0.8)


def test_a_sum_that_is_known_is_told_and_what_is_known_alone_is_not():
    # Leaks of two polarizers, of which air shows the sum to 0.0002; an azimuth beside them.
    along, across = np.array([1, 1, 0]) / np.sqrt(2), np.array([1, -1, 0]) / np.sqrt(2)
    covariance = 0.0002**2 / 2 * np.outer(along, along) + 0.004**2 * np.outer(across, across)
    covariance[2, 2] = 0.01**2
    values = np.array([0.001, 0.002, 0.3])
    (tie,) = ties(values, covariance, np.array([0.01, 0.01, 1.0]), [("a", "1"), ("b", "1"), ("c", "degree")])
    assert tie.weights == pytest.approx({"a": 1, "b": 1})
    assert tie.value == pytest.approx(0.003)
    assert tie.stderr == pytest.approx(0.0002)
    assert abs(tie.open_by["a"]) == pytest.approx(0.004 / np.sqrt(2))
    assert tie.open_by["a"] == pytest.approx(-tie.open_by["b"])


def test_values_of_other_units_are_weighed_in_units_of_the_first():
    # One degree does what 0.02 of light does.
    along, across = np.array([1.0, 0.02]), np.array([1.0, -0.02])
    covariance = 1e-4 * np.outer(along, along) + np.outer(across, across)
    (tie,) = ties(np.array([0.5, 0.01]), covariance, np.array([1.0, 0.02]), [("a", "degree"), ("b", "1")])
    assert tie.unit == "degree"
    assert tie.weights == pytest.approx({"a": 1, "b": 50})
    assert tie.value == pytest.approx(1.0)
    assert tie.stderr == pytest.approx(0.02)


def test_independent_values_are_not_tied():
    assert not list(ties(np.ones(4), np.diag([1.0, 2.0, 3.0, 4.0]), np.ones(4), [(name, "1") for name in "abcd"]))


def test_files_are_written_although_nobody_reads_the_words(configs, tmp_path, monkeypatch):
    """`diagnose --write FILE | head` wrote no file."""
    capture = bench_capture(
        tmp_path, configs / "instruments/rgb950.yaml", TrueBench(rows=16, columns=16), True, 24, seed=3
    )

    def closed(*_, **__):
        raise BrokenPipeError

    monkeypatch.setattr(diagnose_summary, "show", closed)
    with pytest.raises((SystemExit, BrokenPipeError)):
        diagnose.main([str(capture), "--write", str(tmp_path / "new.yaml")])
    assert InstrumentModel.load(tmp_path / "new.yaml").systematic


def test_directions_hold_what_another_capture_will_have_too():
    """Values of a source in every state are large here and nothing there; a retardance is small, and here to stay."""
    size = 41
    covariance, lasts = np.diag([*np.full(40, 1.0), 0.01]), np.arange(size) == 40
    covariance[40, 0] = covariance[0, 40] = 0.05
    stored = leading_directions(covariance, np.eye(size), lasts)[1][:, :MOST_STORED]
    product = stored @ stored.T
    assert product[40, 40] == pytest.approx(0.01, rel=0.05)
    # What they share with it belongs to it.
    assert product[40, 0] == pytest.approx(0.05, rel=0.1)


def test_without_anything_that_lasts_the_largest_come_first():
    size, _ = leading_directions(np.diag([1.0, 4.0]), np.eye(2), np.zeros(2, dtype=bool))
    assert size[0] == pytest.approx(4 * size[1])


def test_what_varies_over_the_image_is_asked_for_beside_all_groups():
    """A flicker and a field hide one another: the unit without the flicker says that the field is nothing."""
    random = np.random.default_rng(31)
    design = 100 * np.hstack([np.eye(60), random.standard_normal((60, 3))])
    data = design[:, :60] @ random.standard_normal(60)
    form = Quadratic(float(data @ data - 60), -design.T @ data, design.T @ design)
    sets = Sets(form, [Group(np.arange(60)), *(Group(np.array([k])) for k in (60, 61, 62))], Noise(True, 20.0, 22.0))
    state = likely_set(sets)
    posterior = Some(samples=Some(best=state), sets=sets)
    assert state.unit > 1000
    assert WholeBench.least_unit(Some(whole=Some(noise_known=True)), posterior) < 10
    assert WholeBench.least_unit(Some(whole=Some(noise_known=False)), posterior) == state.unit


def test_what_is_found_and_not_used_is_uncertain_as_a_whole():
    """A path that was found and is not applied: the correction of the drift changes M by less than the path does."""
    drift, path = (
        Candidate(type("E", (), {"kind": k})(), "", (Parameter("p", "1", -9.0, 9.0, 1.0),)) for k in ("drift", "path")
    )
    space = Space((drift, path))
    direction = (np.array([0, 1]), np.eye(2))
    none = np.zeros((0, 2, 2))
    errors = MuellerErrors(space, np.array([1.0, 4.0]), np.diag([0.01, 0.09]), np.zeros((16, 2, 2)), (direction,), none)
    used = Some(space=Space((drift,)), fit=Some(values=np.array([1.0])))
    assert errors.corrected_values(used).tolist() == [1.0, 0.0]
    change = errors.change(*direction[:1], errors.corrected_values(used), direction[1])
    assert change.before == pytest.approx(np.sqrt(17.1))
    assert change.after == pytest.approx(np.sqrt(16.1))
