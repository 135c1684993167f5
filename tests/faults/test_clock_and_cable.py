"""Promises 22 and 23: clocks that jump, optics that slip, shutters that stick and cables that are pulled are told."""

import dataclasses
import json
import time

import numpy as np
import pytest

from acquisition.capture import wall_clock
from acquisition.capture.repeated_state import RepeatedState
from acquisition.capture.wall_clock import Clocks, WallClock
from acquisition.errors import RunFailed
from drivers import aravis_stream
from drivers.camera_clock import CameraClock
from drivers.errors import DeviceError
from processing.storage.captures.capture import Capture
from simulators.serial.reply_faults import parse_fault


def _messages(path):
    with Capture(path) as capture:
        return json.dumps(capture.closing["messages"])


def _times_as_taken(capture):
    # A state whose frame was lost is taken after the next one: the camera's own clock tells the order.
    return capture.column("host_time_s")[np.argsort(capture.column("camera_time_ns"))]


# --- clocks -----------------------------------------------------------------------------------------------


class MachineClocks:
    """All clocks of the machine that tell the time of day, to be set at will; and a sleep."""

    def __init__(self, monkeypatch):
        self.set_s = self.slept_s = 0.0
        day, boot, take = time.time, time.clock_gettime, aravis_stream.FrameStream.take

        def gettime(clock):
            return boot(clock) + (self.slept_s if clock == time.CLOCK_BOOTTIME else 0.0)

        def stamped(stream, wait_s):
            # The library notes the time of day at which a frame came.
            arrival = take(stream, wait_s)
            if arrival is None or arrival.first_packet_s <= 0:
                return arrival
            return dataclasses.replace(arrival, first_packet_s=arrival.first_packet_s + self.set_s + self.slept_s)

        monkeypatch.setattr(time, "time", lambda: day() + self.set_s + self.slept_s)
        monkeypatch.setattr(time, "clock_gettime", gettime)
        monkeypatch.setattr(aravis_stream.FrameStream, "take", stamped)


# An hour ahead: also by `test_injected_faults.py`.
@pytest.mark.parametrize("step_s", [pytest.param(3600.0, marks=pytest.mark.long), -1.5])
def test_a_clock_that_is_set_in_mid_run_leaves_order_and_frames_right(run_with, intact, monkeypatch, step_s):
    clocks, before = MachineClocks(monkeypatch), time.time()

    def set_clock(rig, state, retake):
        if state == 7 and retake == 0:
            clocks.set_s = step_s

    error, path = run_with(set_clock, top={"retakes": 5})
    assert error is None
    assert intact(path) == 19
    with Capture(path) as capture:
        times = _times_as_taken(capture)
        assert np.all(np.diff(times) > 0)
        assert np.all((times > before) & (times < before + 120))
    assert f"the machine's clock was set {'forward' if step_s > 0 else 'back'} by {abs(step_s):.1f} s" in _messages(
        path
    )


def test_a_machine_that_slept_takes_the_state_again(run_with, intact, monkeypatch):
    clocks, visits = MachineClocks(monkeypatch), []

    def sleep(rig, state, retake):
        visits.append(state)
        if visits.count(7) == 1 and state == 7:
            # In the exposure that follows, not before it.
            trigger = rig.camera._do_trigger

            def slept():
                trigger()
                clocks.slept_s = 600.0
                rig.camera._do_trigger = trigger

            rig.camera._do_trigger = slept

    error, path = run_with(sleep, top={"retakes": 5})
    assert error is None
    assert visits.count(7) > 1
    assert intact(path) == 19
    assert "the machine slept for 600.0 s" in _messages(path)
    with Capture(path) as capture:
        times = _times_as_taken(capture)
        assert np.all(np.diff(times) > 0)
        # The sleep is in them: the lamp went on ageing.
        assert times[-1] - times[0] > 600


def test_a_clock_that_is_only_slewed_is_no_news(monkeypatch):
    clocks = Clocks(1e9, 1000.0, 1000.0)
    monkeypatch.setattr(wall_clock, "read_clocks", lambda: clocks)
    clock = WallClock()
    for _ in range(200):
        clocks = Clocks(clocks.unix_s + 1.0005, clocks.with_sleep_s + 1, clocks.awake_s + 1)
        assert clock.look() is None
    assert clock.ahead_s == pytest.approx(0.1, rel=1e-3)


def test_the_camera_clock_begins_anew_when_the_host_is_set():
    """Set forward by a second, the old comparison would call every frame stale for half an hour."""
    clock = CameraClock("camera")
    first = clock.came_s(10**9, 1000.0, 0.01)
    assert first == 1000.0
    assert clock.came_s(2 * 10**9, 1002.0, 0.01) == pytest.approx(1001, abs=0.01)
    clock.forget_all()
    assert clock.came_s(3 * 10**9, 1003.0, 0.01) == 1003.0


# --- optics and shutter -----------------------------------------------------------------------------------


def test_an_optic_that_slips_on_its_shaft_is_told_by_the_repeated_state(run_with):
    def slip(rig, state, retake):
        if state == 9 and retake == 0:
            # The next command slips it; every encoder agrees with every target afterwards.
            rig.simulation.emulators["rotators"].faults.add(parse_fault("slip:20"))

    error, path = run_with(slip, plan={"repeat_first": True})
    assert error is None
    assert "an optic slipped although its encoder agrees" in _messages(path)
    error, path = run_with(plan={"repeat_first": True})
    assert error is None
    assert "repeats the pose" not in _messages(path)


def test_repeated_states_are_compared_only_where_they_repeat():
    frame = 500 + np.random.default_rng(1).normal(0, 20, (64, 80))
    repeated = RepeatedState(64)
    assert repeated.look(0, 0.01, (0.0, 0.0), frame) is None
    assert repeated.look(1, 0.01, (9.0, 0.0), 0.5 * frame) is None
    assert repeated.look(2, 0.02, (0.0, 0.0), 2 * frame) is None
    noise = np.random.default_rng(2).normal(0, 20, frame.shape)
    assert repeated.look(3, 0.01, (0.0, 0.0), frame + noise) is None
    assert "-2." in repeated.look(3, 0.01, (0.0, 0.0), 64 + 0.975 * (frame - 64))
    # It is told once.
    assert repeated.look(4, 0.01, (0.0, 0.0), 64 + 0.5 * (frame - 64)) is None
    repeated = RepeatedState(64)
    repeated.look(0, 0.01, (0.0, 0.0), frame)
    tilted = 64 + (frame - 64) * np.linspace(0.9, 1.1, 80)
    assert "from place to place by 5" in repeated.look(3, 0.01, (0.0, 0.0), tilted)


def test_a_shutter_that_sticks_open_and_says_so_is_told(run_with):
    def stick(rig, state, retake):
        if state == 5 and retake == 0:
            rig.simulation.emulators["shutter"].faults.add(parse_fault("stuck"))

    # The states are whole; that the light could not be shut off at their end is in the file.
    error, path = run_with(stick, plan={"darks": 2})
    assert error is None
    assert "blade is still" in _messages(path)


@pytest.mark.parametrize("light", [True, False])
def test_a_shutter_that_sticks_and_says_it_does_not_is_found_by_the_darks(run_with, light):
    """Open, darks are as bright as the light; shut, the light is as dark as the darks."""

    def stick(rig, state, retake):
        if state == 0 and retake == 0:
            rig.source.set_light(light)
            rig.simulation.emulators["shutter"].faults.add(parse_fault("jammed"))

    error, path = run_with(stick, plan={"darks": 2})
    assert isinstance(error, RunFailed)
    assert "dark states" in str(error)
    assert path.name.endswith(".partial")


def test_lit_darks_of_a_run_that_was_cut_are_found_when_it_goes_on(run_with):
    def stick(rig, state, retake):
        if state == 0 and retake == 0:
            rig.source.set_light(True)
            rig.simulation.emulators["shutter"].faults.add(parse_fault("jammed"))
        if state == 4:
            raise RunFailed("cut before there is a bright state")

    plan = {"darks": 2}
    _, path = run_with(stick, plan=plan)
    with Capture(path) as capture:
        assert "dark" in capture.role
    error, _ = run_with(resume=path, plan=plan)
    assert isinstance(error, RunFailed)
    assert "dark states" in str(error)


# --- cables -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("line", ["rotators", "arm", "shutter"])
def test_a_cable_that_is_pulled_ends_the_run_and_plugged_again_it_goes_on(run_with, intact, line):
    def pull(rig, state, retake):
        if state == 6:
            rig.simulation.served_ports[line].close()

    error, path = run_with(pull)
    if error is None:
        # Nothing was asked of that line any more but to shut off the light.
        assert line == "shutter"
        assert "could not be shut off" in _messages(path)
        return
    assert isinstance(error, DeviceError)
    assert path.name == "run.h5.partial"
    before = intact(path)
    assert 5 <= before < 19
    # Plugged in again, the device is found anew; it lost its reference with its power, and is homed.
    error, final = run_with(resume=path)
    assert error is None
    assert intact(final) == 19
