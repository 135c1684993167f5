"""Free angles: the bound for any number of states, instruments of lower rank, motor time, what errors do."""

import numpy as np
import pytest
from typer.testing import CliRunner

from processing.calibration.free_angles import Cost, Goal, bound_of, free_design
from processing.calibration.motor_time import Speed, front, move_seconds, order_states, periods_deg
from processing.calibration.robustness import errors_of_table
from processing.calibration.state_design import AssumedNoise, score
from processing.commands.application import app
from processing.errors import ProcessError
from processing.instrument.determined_basis import determined_basis
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.yaml_file import parse_yaml

STOKES = """
kind: instrument
name: rotating-retarder Stokes polarimeter
generator: []
analyzer:
  - {kind: retarder, name: plate, axis: plate, azimuth_deg: 0, retardance_deg: 131.8}
  - {kind: polarizer, name: polarizer, azimuth_deg: 0}
"""


@pytest.fixture
def stokes():
    return parse_yaml(STOKES, InstrumentModel, "stokes.yaml")


def test_free_angles_and_retardances_come_within_one_percent_of_the_bound(rgb950):
    design = free_design(rgb950, 24, free_retardances=True)
    assert design.bound == pytest.approx(1600 / 24)
    assert 1 <= design.variance / design.bound < 1.01
    assert list(design.retardances_deg.values()) == pytest.approx([131.8, 131.8], abs=1)


def test_a_stokes_polarimeter_is_scored_by_what_it_determines(stokes):
    basis = determined_basis(stokes)
    assert basis.shape == (16, 4)
    design = free_design(stokes, 8)
    # The generator sends (1, 0, 0, 0), and a plate of 131.8 degrees covers the sphere evenly: 40 / 8.
    assert design.bound == pytest.approx(bound_of(stokes, 8)) == pytest.approx(5.0)
    assert design.variance < 1.01 * design.bound
    figures = score(stokes.rows(design.angles_deg), AssumedNoise(20_000, 3), basis, design.bound)
    assert (figures.rank, figures.full_rank) == (4, 4)
    assert np.isfinite(figures.element_stderr[:, 0]).all()
    assert np.isnan(figures.element_stderr[:, 1:]).all()
    with pytest.raises(ProcessError, match="3 states give 3 intensities"):
        free_design(stokes, 3)


def test_gradient_of_the_cost(rgb950):
    random = np.random.default_rng(1)
    cost = Cost(rgb950, 20, Goal(AssumedNoise(500, 5)), ("psg_retarder", "psa_retarder"))
    x = np.concatenate([random.uniform(0, np.pi, 40), [2.3, 2.2]])
    _, gradient = cost(x)
    for k in (0, 7, 25, 40, 41):
        step = np.zeros(42)
        step[k] = 1e-5
        slope = (cost(x + step)[0] - cost(x - step)[0]) / 2e-5
        # The light of a state also sets the scale of all weights, which a step of one angle moves by 1 / states.
        assert gradient[k] == pytest.approx(slope, abs=0.05 * np.abs(gradient).max())


def test_motor_time_and_variance_are_traded(rgb950):
    speed = Speed(20, 40)
    points = front(rgb950, 24, {"psg": speed, "psa": speed}, free_retardances=True)
    seconds, variance = [p.seconds for p in points], [p.design.variance for p in points]
    assert seconds == sorted(seconds, reverse=True)
    assert variance == sorted(variance)
    assert len(points) >= 3
    lab = rotating_retarders(1.0, 24, 15.0).angles_deg
    assert seconds[0] < move_seconds(np.stack([lab["psg"], lab["psa"]]), [speed, speed])


def test_a_move_takes_what_its_trapezoid_takes():
    speed = Speed(20, 40)
    # A triangle of 5 degrees: 2 sqrt(5 / 40); and 100 degrees: 100 / 20 + 20 / 40.
    assert speed.seconds(np.array([5.0, 100.0])) == pytest.approx([2 * np.sqrt(5 / 40), 5.5])
    with pytest.raises(ProcessError, match="DEG_PER_S"):
        Speed.parse("psg=fast")


def test_order_keeps_every_pose(rgb950):
    assert periods_deg(rgb950) == {"psg": 180.0, "psa": 180.0}
    angles = np.random.default_rng(2).uniform(0, 360, (2, 30))
    speeds = [Speed(20, 40)] * 2
    order = order_states(angles, np.array([180.0, 180.0]), speeds)
    assert sorted(map(tuple, np.round(order.T % 180, 6))) == sorted(map(tuple, np.round(angles.T % 180, 6)))
    assert move_seconds(order, speeds) < 0.6 * move_seconds(angles, speeds)


def test_errors_of_the_bench_are_those_of_a_wrong_model(rgb950):
    # Independent of the formula: invert intensities of a wrong bench with the declared W, for random samples.
    angles = rotating_retarders(1.0).angles_deg
    w = rgb950.rows(angles).reshape(-1, 16)
    random = np.random.default_rng(3)
    m = np.concatenate([np.ones((4000, 1)), 0.3 * random.normal(size=(4000, 15))], axis=1)
    square = 0.0
    for axis in ("psg", "psa"):
        wrong = rgb950.rows({**angles, axis: angles[axis] + 0.1}).reshape(-1, 16)
        estimate = m @ wrong.T @ np.linalg.pinv(w).T
        square += np.mean((estimate[:, 1:] - m[:, 1:]) ** 2)
    assert errors_of_table(rgb950, angles)["azimuth"] == pytest.approx(np.sqrt(square), rel=0.05)


def test_command_writes_a_plan_that_acquire_takes(configs, tmp_path):
    plan = tmp_path / "best.yaml"
    instrument = str(configs / "instruments/rgb950.yaml")
    options = ["design", instrument, "--wavelength", "662", "--states", "24"]
    done = CliRunner().invoke(app, [*options, "--optimize", "angles,retardances", "--out", str(plan)])
    assert done.exit_code == 0, done.output
    assert "the bound for 24 intensities is 66.6667" in done.output
    assert "the table as it is, 24 states" in done.output
    assert "to change at the bench: the table, and plates of these retardances" in done.output
    from acquisition.capture.plan import MeasurementPlan

    states = MeasurementPlan.load(plan).states
    assert states.states == 24
    assert set(states.angles_deg({})) == {"psg", "psa"}
    wrong = CliRunner().invoke(app, [*options, "--optimize", "angles", "--speed", "arm=3"])
    assert "the instrument turns" in str(wrong.exception)


@pytest.mark.long
def test_the_labs_own_table_is_told_beside_the_best_for_its_plates(configs):
    options = ["design", str(configs / "instruments/rgb950.yaml"), "--wavelength", "662", "--optimize", "angles"]
    done = CliRunner().invoke(app, options)
    assert "equally weighted variance 71.4" in done.output
    assert "the table as it is, 40 states: 86.33" in done.output
    assert "to change at the bench: the table alone" in done.output


def test_robustness_is_told_of_what_was_optimized(configs):
    instrument = str(configs / "instruments/rotating_retarder_stokes.yaml")
    done = CliRunner().invoke(app, ["design", instrument, "--states", "6", "--optimize", "angles"])
    assert done.exit_code == 0, done.output
    assert "every turning retarder off by 1 degree" in done.output


def test_partial_instruments_need_no_table_or_wavelength(configs, tmp_path):
    instrument = str(configs / "instruments/rotating_retarder_stokes.yaml")
    # Of eight equal steps over a whole turn four would be the others again, and leave rank 3.
    done = CliRunner().invoke(app, ["design", instrument, "--states", "8"])
    assert "rotating-retarder Stokes polarimeter, 8 states\n  rank 4 of 4" in done.output
    plan = tmp_path / "plan.yaml"
    CliRunner().invoke(app, ["design", instrument, "--states", "8", "--out", str(plan)])
    assert "wavelength_nm" not in plan.read_text()


def test_states_that_cannot_determine_all_are_no_design(configs):
    # Two beams of one axis: 16 intensities of 8 states, of which no 8 states give rank 16.
    options = ["design", str(configs / "instruments/drr_wollaston.yaml"), "--states", "8"]
    refused = CliRunner().invoke(app, [*options, "--optimize", "angles"])
    assert "no 8 states" in str(refused.exception)
    # What errors of the bench would do to a matrix that is not determined means nothing.
    assert "off its zero" not in CliRunner().invoke(app, options).output
