"""Promises 6 and 30: no way leads through a forbidden place, whatever the turn, and what the dry run passes is run."""

import random

import numpy as np
import pytest

from acquisition.campaign.plan import CampaignCapture
from acquisition.campaign.run import check_all
from acquisition.capture import session
from acquisition.capture.checks import refuse_failed
from acquisition.capture.job import check_with_devices, job_of, prepare
from acquisition.capture.partial_file import mark_not_taken
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError, PlanRefused
from acquisition.rig.config import load_rig
from acquisition.rig.forbidden_poses import find_forbidden
from acquisition.rig.open_rig import open_rig
from acquisition.rig.parts import ForbiddenPose
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from drivers.axis_types import Limits
from drivers.errors import DeviceError

#: Motors so fast that a move over several turns takes a moment.
FAST = {"speed_deg_s": 50_000, "acceleration_deg_s2": 1e7}
PORTS = {"rotators": {"kind": "zaber", "axes": 2, **FAST}, "arm": {"kind": "smc100", "axes": 1, **FAST}}
MOVES = 40


def pose(why="x", **ranges):
    return {"why": why, "ranges_deg": ranges, "homing_may_pass": True}


@pytest.fixture
def rig_with(quick_rig):
    def make(*forbidden, **top):
        settings = {"forbidden": list(forbidden), "solids": None, "park_deg": {}, "backlash_deg": {}} | top
        return load_rig(quick_rig(top=settings, ports=PORTS | {"shutter": {"kind": "sc10"}}))

    return make


def meets(box, start, end):
    """Whether the ranges between start and end have a pose of the box in common: looked for angle by angle."""
    for axis, (low, high) in box["ranges_deg"].items():
        way = np.linspace(start[axis], end[axis], 20_001)
        if not ((way - low) % 360.0 <= high - low).any():
            return False
    return True


def random_pose(draw):
    axes = draw.sample(["psg", "psa", "arm"], draw.choice([1, 1, 2, 3]))
    edges = {}
    for axis in axes:
        low = draw.uniform(-400, 760) if axis != "arm" else draw.uniform(-20, 170)
        edges[axis] = [low, low + draw.uniform(1, 60 if len(axes) == 1 else 150)]
    return pose(**edges)


def test_random_moves_over_several_turns_enter_no_forbidden_place(rig_with, runs):
    """By default two rigs; UMOV_FAULT_RUNS=50 tries 2,000 moves."""
    driven = refused = 0
    for seed in range(max(2, runs)):
        draw = random.Random(seed)
        boxes = [random_pose(draw) for _ in range(draw.randint(1, 3))]
        with open_rig(rig_with(*boxes, endless=draw.choice([[], ["psg", "psa"]])), with_camera=False) as rig:
            rig.home(rig.unhomed())
            steps = watch(rig)
            for _ in range(MOVES):
                axes = draw.sample(["psg", "psa", "arm"], draw.choice([1, 1, 2, 3]))
                targets = {axis: draw.uniform(0, 180) if axis == "arm" else draw.uniform(-1100, 1100) for axis in axes}
                move = rig.move if draw.random() < 0.7 else rig.go
                steps.clear()
                before = rig.simulation.true_angles_deg()
                try:
                    move(targets)
                    driven += 1
                except AcquisitionError:
                    refused += 1
                    assert rig.simulation.true_angles_deg() == before, (seed, targets)
                for start, end in steps:
                    for box in boxes:
                        # Homing may have left it inside; how it comes out is tested below.
                        if not meets(box, start, start):
                            assert not meets(box, start, end), (seed, box, start, end)
    assert driven > 10 * runs
    assert refused > 10 * runs


@pytest.mark.parametrize(
    ("start", "end", "limits", "free"),
    [
        (41, 39, None, True),
        (41, 60, None, False),  # the long way, through nearly all of it
        (49, 60, None, True),
        (401, 399, None, True),  # the same a turn on
        (41, -400, None, False),  # out by the near edge, but into it again a turn below
        (41, 39.9 - 355, None, False),
        (41, 60, (41, 180), True),  # the near edge cannot be reached
    ],
)
def test_a_forbidden_range_is_left_the_short_way(start, end, limits, free):
    box = ForbiddenPose.model_validate(pose(arm=[40, 50]))
    reach = None if limits is None else {"arm": Limits(*limits)}
    assert (find_forbidden([box], {"arm": start}, {"arm": end}, reach) is None) == free


def test_out_of_a_box_of_two_axes_one_of_them_moves():
    box = ForbiddenPose.model_validate(pose(arm=[40, 50], psg=[0, 90]))
    inside = {"arm": 42, "psg": 10}
    assert find_forbidden([box], inside, {"arm": 30, "psg": 10}) is None
    assert find_forbidden([box], inside, {"arm": 42, "psg": -5}) is None
    assert find_forbidden([box], inside, {"arm": 30, "psg": 80}) is box
    assert find_forbidden([box], inside, {"arm": 42, "psg": 100}) is box
    # A reading just inside of an edge is a pose on the edge.
    assert find_forbidden([box], {"arm": 40.01, "psg": 10}, {"arm": 39, "psg": 80}) is None


def test_a_move_by_hand_is_refused_in_every_turn(rig_with):
    with open_rig(rig_with(pose(psg=[80, 100])), with_camera=False) as rig:
        rig.home(rig.unhomed())
        for target in (90, -265, 450, -630, 5000 * 360 - 270):
            with pytest.raises((AcquisitionError, DeviceError), match=r"forbidden|limits"):
                rig.move({"psg": target})
            assert abs(rig.simulation.true_angles_deg()["psg"]) < 1e-3


def plan_of(angles):
    states = {"kind": "table", "angles": angles}
    return MeasurementPlan().with_changes(mode="stokes", states=states, darks=0, exposure_s=0.001)


def watch(rig):
    """The ways that the rig drives from now on: true angles at the start, targets at the end."""
    steps = []
    start_moves = rig.start_moves

    def start(targets):
        before = rig.simulation.true_angles_deg()
        motions = start_moves(targets)
        steps.append((before, before | dict(targets)))
        return motions

    rig.start_moves = start
    return steps


def test_an_endless_axis_unwinds_where_the_way_ahead_is_forbidden(rig_with, tmp_path):
    """What passes the dry run of a campaign passes its second capture too."""
    config = rig_with(pose(psg=[340, 350]), endless=["psg", "psa"])
    turn = [float(angle) for angle in range(0, 331, 22)]
    with open_rig(config) as rig:
        for number in range(3):
            job = prepare(plan_of({"psg": turn, "psa": turn}), config)
            refuse_failed(check_with_devices(job, rig, tmp_path))
            result = session.take(job, rig, tmp_path / f"{number}.h5", StopRequest())
            assert result.status == "complete"
            assert result.worst_angle_deg < 0.01


@pytest.mark.parametrize(
    ("endless", "second", "passes"), [([], 20.0, True), ([], 180.0, False), (["psg"], 180.0, True)]
)
def test_the_dry_run_looks_at_the_way_between_captures(rig_with, tmp_path, endless, second, passes):
    config = rig_with(pose(psg=[80, 100]), endless=endless)
    jobs = []
    for number, psg in enumerate((0.0, second)):
        plan = plan_of({"psg": [psg, psg + 5.0]})
        jobs.append((CampaignCapture(number=number, name=f"{number}.h5", plan=plan), prepare(plan, config)))
    with open_rig(config) as rig:
        _, checks = check_all(jobs, rig, tmp_path)
        assert [check.title for check in checks if not check.passed] == ([] if passes else ["first move"])
        if passes:
            for capture, job in jobs:
                refuse_failed(check_with_devices(job, rig, tmp_path))
                assert session.take(job, rig, tmp_path / capture.name, StopRequest()).status == "complete"


# Round a box of two rotators: up on one side, across, and down on the other.
AROUND = {"psg": [10.0, 10, 10, 10, 60, 110, 110, 110, 110], "psa": [10.0, 60, 90, 130, 130, 130, 90, 60, 10]}
BLOCK = pose(psg=[20, 100], psa=[-5, 120])


@pytest.mark.parametrize("stopped_at", [1, 4, 6])
def test_resume_goes_to_the_first_missing_state_by_an_allowed_way(rig_with, tmp_path, stopped_at):
    config = rig_with(BLOCK, endless=[])
    job = prepare(plan_of(AROUND), config)
    stop = StopRequest()

    class StopThere(Observer):
        def state_done(self, report):
            if report.state == stopped_at:
                stop.request()

    with open_rig(config) as rig:
        refuse_failed(check_with_devices(job, rig, tmp_path))
        session.take(job, rig, tmp_path / "run.h5", stop, observers=[StopThere()])
        steps = watch(rig)
        path = next(tmp_path.glob("run.h5*"))
        resumed_job = job_of(path, config)
        refuse_failed(check_with_devices(resumed_job, rig, tmp_path))
        result = session.resume(resumed_job, rig, path, StopRequest())
    assert (result.status, result.states_done) == ("complete", 9)
    assert not any(meets(BLOCK, *step) for step in steps)


def test_states_missing_here_and_there_are_reached_round_the_box(rig_with, tmp_path):
    """After `acquire repair` the states to take are not neighbours."""
    config = rig_with(BLOCK, endless=[])
    job = prepare(plan_of(AROUND), config)
    with open_rig(config) as rig:
        refuse_failed(check_with_devices(job, rig, tmp_path))
        session.take(job, rig, tmp_path / "run.h5", StopRequest())
        partial = mark_not_taken(tmp_path / "run.h5", [1, 8])
        steps = watch(rig)
        result = session.resume(job_of(partial, config), rig, partial, StopRequest())
    assert (result.status, result.states_done) == ("complete", 9)
    assert not any(meets(BLOCK, *step) for step in steps)


def test_a_plan_that_passes_through_a_range_a_turn_on_is_refused(rig_with):
    with pytest.raises(PlanRefused, match="forbidden"):
        prepare(plan_of({"psg": [370.0, 500.0]}), rig_with(pose(psg=[80, 100])))
