"""Promise 18: a rig file that cannot be meant is refused before anything opens, with every mistake at once."""

import functools
import math
import operator
import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from acquisition.capture.job import prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError, PlanRefused
from acquisition.rig.clearance import RESOLUTION_MM, find_clash, footprint, gap_mm
from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.solids import Solids
from processing.yaml_file import ConfigError
from tests.rig_files import change_yaml, with_values

ZABER = {"kind": "zaber", "port": "sim:rotators"}

#: What is changed in the rig file, and what the refusal must name.
MISTAKES = {
    "range high first": ({"forbidden": [{"why": "x", "ranges_deg": {"arm": [5, -10]}}]}, ("forbidden", "Swap")),
    "range not a number": ({"forbidden": [{"why": "x", "ranges_deg": {"arm": [5, math.nan]}}]}, ("finite",)),
    "range of nothing": ({"forbidden": [{"why": "x", "ranges_deg": {}}]}, ("forbidden",)),
    "forbidden unknown axis": ({"forbidden": [{"why": "x", "ranges_deg": {"amr": [0, 1]}}]}, ("amr", "arm is meant")),
    "limit not a number": ({"axes.arm.limits_deg": [0, math.nan]}, ("axes.arm", "limits_deg", "finite")),
    "limit infinite": ({"axes.arm.limits_deg": [0, math.inf]}, ("limits_deg", "finite")),
    "limits high first": ({"axes.arm.limits_deg": [180, 0]}, ("limits_deg", "Swap")),
    "park outside limits": ({"park_deg": {"arm": 181}}, ("park_deg.arm", "outside the limits")),
    "park forbidden": ({"park_deg": {"arm": 2}}, ("park_deg", "forbidden pose")),
    "park not a number": ({"park_deg": {"arm": math.nan}}, ("park_deg.arm", "finite")),
    "park unknown axis": ({"park_deg": {"army": 90}}, ("park_deg.army", "no axis")),
    "tolerance infinite": ({"axes.psg.tolerance_deg": math.inf}, ("tolerance_deg",)),
    "tolerance of a turn": ({"axes.psg.tolerance_deg": 360}, ("tolerance_deg",)),
    "settling infinite": ({"settle_s": math.inf}, ("settle_s",)),
    "settling of a year": ({"settle_s": 3e7}, ("settle_s",)),
    "one address twice": ({"axes.psa": {**ZABER, "address": 1}}, ("axes.psa", "address 1", "as psg")),
    "no address twice": ({"axes.psa": ZABER, "axes.psg": ZABER}, ("axes.psa", "as psg")),
    "two protocols on a line": ({"axes.arm.port": "sim:rotators"}, ("axes.arm.port", "one protocol")),
    "source on an axis's line": ({"source.port": "sim:arm"}, ("source.port", "one protocol")),
    "axis called by a number": ({"axes": {4: {**ZABER, "address": 1}}}, ("axes.4", "text")),
    "backlash misspelt": ({"backlash_deg": {"amr": 1}}, ("backlash_deg.amr", "no axis")),
    "home_order misspelt": ({"home_order": ["amr", "psg"]}, ("home_order", "no axis")),
    "home_order twice": ({"home_order": ["arm", "arm"]}, ("home_order", "twice")),
    "endless misspelt": ({"endless": ["psg", "pas"]}, ("endless", "no axis")),
    "pose misspelt": ({"modes.stokes.pose_deg": {"psgg": 1}}, ("pose_deg", "no axis")),
    "homing may hit": (
        {"forbidden": [{"why": "post", "ranges_deg": {"arm": [-10, 5]}}]}, ("homing", "homing arm", "post"),
    ),
    "homing may hit a turn on": (
        {"forbidden": [{"why": "post", "ranges_deg": {"arm": [710, 725]}}]}, ("homing", "homing arm", "post"),
    ),
    "homing way not told": (
        {"homing": {}, "forbidden": [{"why": "post", "ranges_deg": {"arm": [300, 310]}}]}, ("homing arm", "post"),
    ),
    "one interlock twice": ({"interlocks": [{"kind": "drift", "limit": 0.1}] * 2}, ("interlocks", "twice")),
    "drift never kept": ({"interlocks": [{"kind": "drift"}]}, ("interlocks", "limit")),
    "solid on unknown axis": ({"solids.parts.0.turns_with": "amr"}, ("turns_with", "no axis")),
    "solid without size": ({"solids.parts.0.size_mm": [160, 0, 240]}, ("size_mm",)),
    "park hits a solid": ({"solids.parts.2.centre_mm": [600, 0, 0]}, ("park_deg", "source head", "camera")),
    "wavelength not a number": ({"wavelengths_nm": [451, math.nan]}, ("wavelengths_nm",)),
    "exposure high first": ({"exposure_s": [10, 0.1]}, ("exposure_s", "Swap")),
    "fold misspelt": ({"fold_deg": {"psaa": 180}}, ("fold_deg.psaa", "psa is meant")),
    "truth as a number": ({"settle_s": True}, ("settle_s", "a number, not true")),
    "truth in a section": ({"backlash_deg": {"arm": True}}, ("backlash_deg.arm", "a number, not true")),
    "lamp always kept": ({"interlocks": [{"kind": "lamp"}]}, ("interlocks.0", "limit 0 is always kept")),
    "drift in percent": ({"interlocks": [{"kind": "drift", "limit": 2}]}, ("interlocks.0", "fraction")),
    "door with a limit": ({"interlocks": [{"kind": "door", "limit": 0.5}]}, ("interlocks.0", "no limit")),
    "temperature of an oven": ({"interlocks": [{"kind": "temperature", "limit": 400}]}, ("interlocks.0", "400")),
    "pose at no wavelength": ({"modes.stokes.pose_deg.psg": {662: 17, 948: 13}}, ("pose_deg.psg", "948 nm")),
    "black below the counts": ({"detector.black_level_counts": -64}, ("black_level_counts", "0 to 4095")),
    "black above the counts": ({"detector.black_level_counts": 5000}, ("black_level_counts", "0 to 4095")),
    "no wavelength": ({"wavelengths_nm": []}, ("wavelengths_nm", "1 or more")),
    "no mode": ({"modes": {}}, ("modes", "1 or more")),
    "no name": ({"name": ""}, ("name",)),
    "no port": ({"axes.arm.port": ""}, ("axes.arm.port", "no port")),
    "network port without number": ({"axes.arm.port": "socket://10.0.0.5"}, ("axes.arm.port", "ADDRESS:NUMBER")),
    "axis called detector": ({"axes.detector": {**ZABER, "address": 3}}, ("axes.detector", "another name")),
    "axis as a path": ({"axes.a/b": {**ZABER, "address": 3}}, ("axes.a/b", "no name for an axis")),
    "a million axes": ({"simulator.ports.rotators.axes": 10**6}, ("rotators.axes", "99")),
    "emulator nowhere": ({"axes.arm.port": "sim:amr"}, ("axes.arm.port", "simulator.ports")),
}  # fmt: skip


@pytest.fixture
def changed(configs, tmp_path):
    """The simulated rig with values at dotted keys replaced."""

    return lambda changes: with_values(configs / "rigs" / "simulated.yaml", changes, tmp_path / "rig.yaml")


@pytest.mark.parametrize("name", MISTAKES)
def test_what_cannot_be_meant_is_refused(changed, name):
    changes, words = MISTAKES[name]
    with pytest.raises(ConfigError) as refused:
        load_rig(changed(changes))
    for word in words:
        assert word in str(refused.value), refused.value
    # File and line in front of every mistake.
    assert all(re.match(r".*rig\.yaml:\d+: ", line) for line in str(refused.value).splitlines())


@pytest.mark.parametrize("key", ["name", "camera", "axes.arm.port", "modes.drr.instrument", "simulator.axes.psa.port"])
def test_what_is_missing_is_named(configs, tmp_path, key):
    def without(tree):
        *above, last = key.split(".")
        del functools.reduce(operator.getitem, above, tree)[last]

    file = change_yaml(configs / "rigs" / "simulated.yaml", without, tmp_path / "rig.yaml")
    with pytest.raises(ConfigError, match=rf"rig\.yaml:\d+: {re.escape(key)}: is missing"):
        load_rig(file)


def test_a_transcript_needs_a_folder(changed, tmp_path):
    (tmp_path / "wires").write_text("mine")
    with pytest.raises(ConfigError, match=r"rig\.yaml: wire_log: .*wires is a file"):
        load_rig(changed({"wire_log": "wires"}))


def test_all_mistakes_come_at_once(changed):
    """Mistakes of a value and mistakes between sections do not hide each other."""
    changes = {
        "axes.arm.limits_deg": [0, math.nan], "settle_s": math.inf, "park_deg": {"army": 90},
        "endless": ["psg", "pas"], "axes.psa": {**ZABER, "address": 1}, "exposure_s": [10, 0.1],
    }  # fmt: skip
    with pytest.raises(ConfigError) as refused:
        load_rig(changed(changes))
    text = str(refused.value)
    for word in ("limits_deg", "settle_s", "army", "pas", "address 1", "exposure_s"):
        assert word in text, text


def test_every_command_refuses_it_before_anything_opens(changed, acquire):
    rig = changed({"forbidden": [{"why": "x", "ranges_deg": {"arm": [5, -10]}}]})
    for command in (("--omega", 35, "--dry-run"), ("--omega", 35), ("doctor",), ("home",), ("move", "arm", 90)):
        code, _, errors = acquire(*command, "--rig", rig)
        assert (code, "Swap" in errors, "Traceback" in errors) == (2, True, False), (command, errors)


def test_homing_by_hand_looks_where_the_others_stand(small_rig):
    """Allowed in the order of the rig file, where the arm is out of the way by then; refused alone."""
    post = {"why": "cable", "ranges_deg": {"arm": [100, 120], "psg": [200, 250]}}
    path = small_rig(top={"forbidden": [post], "homing": {"arm": {"passes_deg": [-1, 90], "ends_deg": 0}}})
    with open_rig(load_rig(path), with_camera=False) as rig:
        rig.home(rig.homing_order())
        rig.move({"psg": 180.0})
        rig.move({"arm": 110.0})
        before = rig.simulation.true_angles_deg()
        with pytest.raises(AcquisitionError, match="homing psg may meet a forbidden pose"):
            rig.home(["psg"])
        assert rig.simulation.true_angles_deg() == before


# --- solids -----------------------------------------------------------------------------------------------

ARM = {"name": "arm", "shape": "box", "size_mm": [40, 100, 200], "centre_mm": [0, 0, 300], "turns_with": "arm"}
POST = {"name": "post", "shape": "cylinder", "radius_mm": 20, "height_mm": 100, "centre_mm": [300, 0, 0]}


def solids(*parts, margin=10.0):
    return Solids.model_validate({"margin_mm": margin, "parts": parts})


def test_a_post_on_the_way_is_found_although_both_ends_are_free():
    parts = solids(ARM, POST)
    assert find_clash(parts, {"arm": (45, 45)}) is None
    assert find_clash(parts, {"arm": (135, 135)}) is None
    clash = find_clash(parts, {"arm": (45, 135)})
    assert {clash.first.name, clash.second.name} == {"arm", "post"}
    # The arm's edge nears the post's by 10 mm: half width 20 + margin 10 + radius 20, at about 300 mm.
    assert 75 < clash.angle_deg < 90 - math.degrees(math.atan(40 / 320))
    # Nobody knows where an axis without a reference stands.
    assert find_clash(parts, {}) is not None
    # Above it is free.
    assert find_clash(solids(ARM, {**POST, "centre_mm": [300, 120, 0]}), {"arm": (0, 360)}) is None


@settings(max_examples=20, deadline=None, derandomize=True)
@given(
    st.tuples(*[st.floats(-300, 300)] * 2),
    st.tuples(*[st.floats(5, 200)] * 2),
    st.tuples(st.floats(-180, 180), st.floats(0, 200)),
    st.sampled_from(["box", "cylinder", "disc"]),
)
def test_no_pose_between_is_missed(centre, size, way, shape):
    """Against looking at every pose closely: what is nearer than the margin is found, what is further is not."""
    kinds = {
        "box": {"size_mm": [size[0], 10, size[1]]},
        "cylinder": {"radius_mm": size[0], "height_mm": 10},
        "disc": {"radius_mm": size[0], "thickness_mm": size[1]},
    }
    standing = {"name": "it", "shape": shape, "centre_mm": [centre[0], 0, centre[1]], **kinds[shape]}
    pair = solids(ARM, standing)
    low, high = way[0], way[0] + way[1]
    a, b = (footprint(part) for part in pair.parts)
    nearest = min(gap_mm(a.turned(angle), b) for angle in np.linspace(low, high, 300))
    clashes = find_clash(pair, {"arm": (low, high)}) is not None
    # Between two of these looks the arm comes at most so much nearer.
    between = math.radians(way[1] / 299) * a.reach_mm / 2
    if nearest < 10.0:
        assert clashes
    elif nearest > 10.0 + RESOLUTION_MM + between:
        assert not clashes


def test_footprints_keep_the_distance_that_can_be_worked_out():
    box, crossing, disc = (
        footprint(part)
        for part in solids(
            {"name": "a", "shape": "box", "size_mm": [20, 10, 20], "centre_mm": [0, 0, 0]},
            {"name": "b", "shape": "box", "size_mm": [100, 10, 2], "centre_mm": [0, 0, 0], "turns_with": "arm"},
            {"name": "c", "shape": "disc", "radius_mm": 5, "thickness_mm": 2, "centre_mm": [0, 0, 50]},
        ).parts
    )
    assert gap_mm(box, crossing) == 0
    assert gap_mm(box, disc) == pytest.approx(50 - 1 - 10)
    assert gap_mm(disc.turned(90), box) == pytest.approx(50 - 1 - 10)
    corner = disc.turned(45)
    # Square's corner at (10, 10) against the disc's face, 49 mm out along the diagonal.
    assert gap_mm(corner, box) == pytest.approx(49 - 10 * math.sqrt(2))


def test_no_move_brings_solids_together(small_rig, monkeypatch):
    """On an open rig, and in the check of a plan; nothing moves."""
    path = small_rig(top={"solids": {"margin_mm": 10, "parts": [ARM, POST]}, "park_deg": {}, "homing": {
        "arm": {"passes_deg": [-1, 60], "ends_deg": 0}}})  # fmt: skip
    config = load_rig(path)
    with open_rig(config, with_camera=False) as rig:
        rig.home(rig.unhomed())
        rig.move({"arm": 45.0})
        before = rig.simulation.true_angles_deg()
        with pytest.raises(AcquisitionError, match="solids 'arm' and 'post' nearer than 10 mm"):
            rig.move({"arm": 135.0})
        assert rig.simulation.true_angles_deg() == before
        # A rotator that nothing can hit moves without a question to the arm.
        monkeypatch.setattr(rig.axes["arm"], "read_position", lambda: pytest.fail("asked"))
        rig.move({"psg": 10.0})
    with pytest.raises(PlanRefused, match="solids 'arm' and 'post'"):
        prepare(MeasurementPlan(omega_deg=90), config)


def test_a_plan_from_which_parking_is_not_possible_is_refused(small_rig):
    post = {"why": "post", "ranges_deg": {"arm": [100, 110]}, "homing_may_pass": True}
    config = load_rig(small_rig(top={"forbidden": [post], "park_deg": {"arm": 90}}))
    prepare(MeasurementPlan(omega_deg=35), config)
    with pytest.raises(PlanRefused, match="way to the park pose"):
        prepare(MeasurementPlan(omega_deg=150), config)


def test_every_kind_tells_the_axes_of_one_line_apart():
    """Two axes that an emulator has on one line are no mistake."""
    from simulators.rig.controller_kinds import axis_configs, served_kinds
    from simulators.serial.serve_options import ServeOptions

    for kind, make in served_kinds().items():
        try:
            entries = axis_configs(make(ServeOptions(axes=2)), "socket://x:1")
        except ValueError:
            # One axis a line.
            continue
        places = [(entry.port, entry.place()) for entry in entries]
        assert len(set(places)) == len(places), kind
