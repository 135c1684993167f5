"""Promises 6 and 7: what lies outside limits or in a forbidden pose is refused as a whole, and nothing moves."""

import math

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from acquisition.capture.checks import check_devices
from acquisition.capture.job import prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import PlanRefused
from acquisition.rig.config import load_rig
from acquisition.rig.forbidden_poses import find_forbidden
from acquisition.rig.open_rig import open_rig
from acquisition.rig.parts import ForbiddenPose
from drivers.errors import LimitError
from tests.rig_files import with_values

LOW, HIGH = -90.0, 400.0


@pytest.fixture
def limited_rig(small_rig):
    """A homed rig whose generator axis has limits, with one forbidden box of two axes."""
    path = small_rig(
        top={
            "endless": [],
            "forbidden": [
                {"why": "table", "ranges_deg": {"arm": [-10, 5]}, "homing_may_pass": True},
                {"why": "cable", "ranges_deg": {"arm": [100, 120], "psg": [200, 250]}, "homing_may_pass": True},
            ],
        }
    )
    with_values(path, {"axes.psg.limits_deg": [LOW, HIGH]}, path)
    with open_rig(load_rig(path), with_camera=False) as rig:
        rig.home(rig.unhomed())
        rig.move({"arm": 90.0})
        yield rig


angle = st.one_of(
    st.floats(-2000, 2000, allow_nan=False),
    st.sampled_from([0.0, LOW, HIGH, LOW - 1e-3, HIGH + 1e-3, 5.0, 100.0, 180.0, 180.001, 225.0]),
)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(omega=angle, psg=st.lists(angle, min_size=1, max_size=6))
def test_random_plans_are_refused_as_a_whole_or_wholly_allowed(limited_rig, omega, psg):
    rig = limited_rig
    before = rig.simulation.true_angles_deg()
    # The state table's rank is another matter: a Stokes plan has none.
    plan = MeasurementPlan().with_changes(
        mode="stokes", omega_deg=omega, states={"kind": "table", "angles": {"psg": psg}}, darks=0
    )
    outside = not 0 <= omega <= 180 or any(not LOW <= angle <= HIGH for angle in psg)
    in_box = -10 <= omega <= 5 or (100 <= omega <= 120 and any(200 <= angle <= 250 for angle in psg))
    try:
        job = prepare(plan, rig.config)
        refused = [check for check in check_devices(job.table, rig) if not check.passed]
        for k in range(len(job.table)):
            # Never clipped: what was asked is what would be done.
            assert job.table.angles_deg["psg"][k] == psg[k]
            assert job.table.angles_deg["arm"][k] == omega
    except PlanRefused:
        refused = ["plan"]
    margin = 1e-3
    if outside and not any(math.isclose(a, b, abs_tol=margin) for a in (omega, *psg) for b in (0, 180, LOW, HIGH)):
        assert refused
    if in_box:
        assert refused
    if not refused:
        assert not in_box
        assert 0 - margin <= omega <= 180 + margin
        assert all(LOW - margin <= angle <= HIGH + margin for angle in psg)
    assert rig.simulation.true_angles_deg() == before


def test_a_target_just_outside_is_refused_not_clipped(limited_rig):
    for axis, target in (
        ("psg", HIGH + 0.01),
        ("psg", LOW - 0.01),
        ("arm", 180.01),
        ("psg", math.nan),
        ("arm", math.inf),
    ):
        before = limited_rig.simulation.true_angles_deg()
        with pytest.raises(LimitError):
            limited_rig.move({axis: target})
        assert limited_rig.simulation.true_angles_deg() == before


def test_a_box_between_two_poses_is_in_the_way():
    box = ForbiddenPose(why="post", ranges_deg={"arm": (40, 50)})
    assert find_forbidden([box], {"arm": 30}, {"arm": 60}) is box
    assert find_forbidden([box], {"arm": 30}, {"arm": 39}) is None
    # From inside, where homing may have left it, the way out is open, and only that.
    assert find_forbidden([box], {"arm": 45}, {"arm": 60}) is None
    assert find_forbidden([box], {"arm": 45}, {"arm": 46}) is box
    two = ForbiddenPose(why="cable", ranges_deg={"arm": (40, 50), "sample": (0, 10)})
    assert find_forbidden([two], {"arm": 30, "sample": 20}, {"arm": 60, "sample": 20}) is None
    # An axis whose place is not known is taken to be anywhere.
    assert find_forbidden([two], {"arm": 30}, {"arm": 60}) is two
