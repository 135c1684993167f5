"""Promises 8, 9 and 11: lost frames, a camera that vanishes, an interlock that opens."""

import threading
from dataclasses import replace

import h5py
import pytest

from acquisition.capture import session
from acquisition.capture.job import check_with_devices, prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.disc import disc_process
from acquisition.errors import RunFailed
from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from processing.commands.application import main
from processing.diagnosis.captures.read_capture import read_capture
from processing.reduction.counts_to_signal import CountCorrection
from processing.storage.captures.capture import Capture
from processing.storage.integrity.checksums import state_crc32, summed_values
from processing.storage.products.product import Product
from simulators.clock import patient_clock
from tests.commands import exit_code

#: The plan of the rig, in which more states are known than the sample has unknowns.
WHOLE = {"states": {"kind": "rotating_retarders"}, "darks": 4}


def test_lost_frames_are_taken_again_and_logged(run_with, intact):
    def act(rig, state, retake):
        # Every packet is lost while states 7 and 12 are tried for the first time.
        rig.simulation.camera.lost_ratio = 1.0 if state in (7, 12) and retake == 0 else 0.0

    error, path = run_with(act)
    assert error is None
    assert intact(path) == 19
    with Capture(path) as capture:
        assert capture.column("retakes")[[7, 12]].tolist() == [1, 1]
        assert capture.column("retakes").sum() == 2
        retaken = [text for text in capture.closing["messages"] if "taken again" in text]
        assert len(retaken) == 2


def test_frames_lost_in_every_try_end_the_run(run_with, intact):
    def act(rig, state, retake):
        rig.simulation.camera.lost_ratio = 1.0 if state == 7 else 0.0

    error, path = run_with(act)
    assert "state 7: 4 frames in a row were lost" in str(error)
    # A loss is known when the next state is under way, so each try is followed by a state that succeeds.
    assert intact(path) == 10


def test_vanished_camera_is_noticed_and_the_run_resumes(run_with, intact):
    gone_s = []

    def act(rig, state, retake):
        if state == 12 and not gone_s:
            gone_s.append(patient_clock().now_s())
            rig.simulation.camera.vanish()

    error, path = run_with(act)
    assert patient_clock().now_s() - gone_s[0] < 10
    assert error is not None
    assert "camera" in str(error)
    assert intact(path) == 12
    error, final = run_with(resume=path)
    assert error is None
    assert intact(final) == 19


class _Door(Observer):
    """Opens the door at a state, and closes it some time after the run has noticed."""

    def __init__(self, state, open_s):
        self.state, self.open_s = state, open_s
        self.shutter = None

    def act(self, rig, state, retake):
        if state == self.state:
            self.state = None
            self.shutter = rig.simulation.emulators["shutter"]
            self.shutter.trip(True)

    def warning(self, text):
        if text.startswith("interlock: the door is open"):
            threading.Thread(target=self._close).start()

    def _close(self):
        patient_clock().sleep_s(self.open_s)
        self.shutter.trip(False)


class _Count(Observer):
    def __init__(self):
        self.exposed = []

    def exposing(self, state, retake):
        self.exposed.append(state)


def test_open_door_discards_the_state_and_holds(run_with, intact):
    door = _Door(9, 0.1)
    error, path = run_with(door.act, observers=(door,))
    assert "the door is open" in str(error)
    assert "--resume" in str(error)
    assert intact(path) == 9


def test_open_door_and_a_plan_that_goes_on_by_itself(run_with, intact):
    count, door = _Count(), _Door(9, 0.5)
    error, path = run_with(door.act, plan={"continue_after_interlock": True}, observers=(count, door))
    assert error is None
    assert intact(path) == 19
    assert count.exposed.count(9) == 2
    with Capture(path) as capture:
        (event,) = capture.closing["interlocks"]
        assert event["state"] == 9
        assert "door" in event["why"]
        assert 0.45 < event["duration_s"] < 5
        # The shutter fell with the door; the state that counts has light.
        assert capture.frames(9).mean() > 100


def test_saturated_state_ends_the_run_where_the_rig_file_says_so(run_with):
    top = {"interlocks": [{"kind": "door"}, {"kind": "saturation", "limit": 0.01}]}
    error, _ = run_with(plan={"exposure_s": 0.5}, top=top)
    assert "saturated" in str(error)


def _light(path):
    with Capture(path) as capture:
        return len(capture.done)


def test_failed_lamp_and_drifting_lamp_end_the_run(run_with):
    interlocks = [{"kind": "door"}, {"kind": "lamp", "limit": 0.1}, {"kind": "drift", "limit": 0.03}]
    top = {"interlocks": interlocks}
    fails = [{"kind": "source_step", "at_index": 10, "fraction": -0.98}]
    error, path = run_with(top=top, effects=fails)
    assert "of that of the first state" in str(error)
    assert _light(path) == 10
    # Bench time runs fifty times as fast as real time: over five percent until the first pose comes again.
    plan = {"repeat_first": True}
    error, path = run_with(plan=plan, top=top, effects=[{"kind": "source_drift", "fraction_per_hour": 15.0}])
    assert "drifted by +" in str(error)
    assert _light(path) == 19
    error, path = run_with(plan=plan, top=top)
    assert error is None
    assert _light(path) == 20


def test_a_hot_camera_is_waited_for(run_with, intact):
    top = {"interlocks": [{"kind": "temperature", "limit": 50.0}]}
    looks = []

    def act(rig, state, retake):
        if state == 9 and not looks:
            looks.append(0)

            def temperature():
                looks.append(1)
                return 61.5 if len(looks) < 4 else 45.0

            rig.camera.temperature_c = temperature

    error, path = run_with(act, plan={"continue_after_interlock": True}, top=top)
    assert error is None
    assert intact(path) == 19
    with Capture(path) as capture:
        (event,) = capture.closing["interlocks"]
    assert "61.5 C" in event["why"]


def test_exposures_that_nobody_asked_for_never_enter_a_capture(run_with, intact):
    """Stray pulses while the axes turn: their frames show other angles, and are thrown away whenever they arrive.

    The bench settles as in the rig file. The clocks are compared to a few milliseconds, and a stray exposure that
    starts as late as that shows the angles of the state.
    """

    class Stray(Observer):
        rig = None

        def state_done(self, report):
            # Told while the axes are on their way to the next state.
            if self.rig is not None and report.state % 3 == 0:
                self.rig.simulation.camera.fire(unasked=True)

    stray = Stray()

    def act(rig, state, retake):
        stray.rig = rig

    error, path = run_with(act, observers=(stray,), top={"settle_s": 0.02})
    assert error is None
    assert intact(path) == 19
    with Capture(path) as capture:
        assert capture.closing["stream"]["stale_discarded"] >= 5


# --- a camera that says something false (promise 29) --------------------------------------------------------


def altered(first, alter):
    """An action that has the camera hand out something else from a state on: `alter` of a frame and the one before."""
    memory = {"state": -1, "before": None}

    def act(rig, state, retake):
        memory["state"] = state
        camera = rig.require_camera()
        if memory["before"] is None and "take" not in memory:
            memory["take"] = camera._do_frame

            def taken():
                frame = memory["take"]()
                if memory["state"] >= first and memory["before"] is not None:
                    frame = replace(frame, **alter(frame, memory["before"]))
                memory["before"] = frame
                return frame

            camera._do_frame = taken

    return act


def brighter(factor):
    return lambda frame, before: {"pixels": (64 + factor * (frame.pixels.astype(float) - 64)).astype("u2")}


def test_a_frozen_camera_gives_no_complete_capture(run_with, intact):
    error, path = run_with(altered(12, lambda frame, before: {"pixels": before.pixels}), stamp=False)
    assert "the camera or its driver is frozen" in str(error)
    with Capture(path) as capture:
        assert capture.status == "failed"
        assert len(capture.done) == 12


def test_a_camera_that_is_frozen_in_an_average_gives_no_state(run_with):
    """The frames of one state are compared with each other: their mean differs from all others."""
    frames = []

    def act(rig, state, retake):
        camera = rig.require_camera()
        if state == 12 and not frames:
            take = camera._do_frame

            def frozen():
                frames.append(take())
                return replace(frames[-1], pixels=frames[0].pixels)

            camera._do_frame = frozen

    error, _ = run_with(act, {"repeats": 2}, stamp=False)
    assert "state 12: 4 frames in a row were lost" in str(error)
    assert "the camera or its driver is frozen" in str(error)


def test_a_camera_that_is_frozen_between_captures_of_one_state_is_noticed(configs, quick_rig, tmp_path):
    """A polarization camera takes one frame for each capture, which is sound by itself."""
    config = load_rig(quick_rig(stamp=False))
    plan = MeasurementPlan.load(configs / "plans" / "stokes.yaml")
    plan = plan.with_changes(darks=0, states={"kind": "fixed", "states": 1})
    with disc_process(), open_rig(config) as rig:
        jobs = [prepare(plan.with_changes(omega_deg=omega_deg), config) for omega_deg in (35.0, 36.0)]
        check_with_devices(jobs[0], rig, tmp_path)
        assert session.take(jobs[0], rig, tmp_path / "first.h5", StopRequest()).status == "complete"
        camera, last = rig.require_camera(), rig.last_frame
        take = camera._do_frame
        camera._do_frame = lambda: replace(take(), pixels=last)
        with pytest.raises(RunFailed, match="the camera or its driver is frozen"):
            session.take(jobs[1], rig, tmp_path / "second.h5", StopRequest())


def test_a_gain_that_changes_is_known_to_reduce_and_to_diagnose(run_with, tmp_path):
    """In the product of a reduction, and in what a diagnosis reports of the capture."""
    error, path = run_with(altered(20, brighter(1.1)), plan=WHOLE, stamp=False)
    assert error is None
    with Capture(path) as capture:
        (text,) = [text for text in capture.closing["messages"] if "false frame" in text]
        assert "from state 20 on: the light is 1.1 times" in text
        assert [(evidence["kind"], evidence["state"]) for evidence in capture.closing["evidence"]] == [
            ("brightness", 20)
        ]
        assert text.partition("false frame: ")[2] in read_capture(capture, capture.instrument).evidence
    product = tmp_path / "product.h5"
    assert exit_code(main, "reduce", path, "--out", product, "--no-figure") == 0
    with Product(product) as reader:
        assert any("from state 20 on: the light is 1.1 times" in line for line in reader.facts["warnings"])


def test_frames_that_were_frozen_are_found_in_the_file_itself(run_with):
    """A capture of an older version has no record of it; its checksums are right, and its frames are not."""
    error, path = run_with(stamp=False)
    assert error is None
    with h5py.File(path, "r+") as h5:
        frames, sums = h5["entry/instrument/detector/data"], h5["entry/instrument/detector/row_crc32"]
        columns = summed_values(h5["entry"])
        for state in range(12, 19):
            frames[state], sums[state] = frames[11], sums[11]
            values = {name: column[state] for name, column in columns.items()}
            h5["entry/states/crc32"][state] = state_crc32(sums[state], values)
    with Capture(path) as capture:
        assert not capture.damaged_states()
        (text,) = [text for text in CountCorrection.of(capture).warnings if "pixel by pixel" in text]
        assert "7 states have the frame of state 11" in text
        assert text in read_capture(capture, capture.instrument).evidence


@pytest.mark.parametrize("role", ["sample", "air"])
def test_sound_captures_have_no_evidence_against_them(run_with, role):
    plan = {} if role == "sample" else {"sample": {"kind": "air", "name": "air"}, "omega_deg": 180.0}
    error, path = run_with(plan=WHOLE | plan, stamp=False)
    assert error is None
    with Capture(path) as capture:
        assert capture.closing["evidence"] == []
        assert read_capture(capture, capture.instrument).evidence == ()
