"""Promises 12 and 28: any call that leaves the program may fail, once or from then on, one or two kinds at a time.

As SQLite's tests do, a counter runs through the calls of each kind. After each run the light is off, states done are
intact and at the angles that their pixels show, and the capture goes on.
"""

import errno
import multiprocessing
import os
import random
import threading
import time

import pytest

from acquisition.capture.state_file import StateFile
from acquisition.errors import AcquisitionError
from drivers.cameras.aravis import AravisCamera
from drivers.errors import DeviceError
from drivers.motion import MotionAxis
from drivers.serial_link import SerialLink

#: Where a call leaves the program, what it may raise, and how often a run makes it, roughly.
CALLS = {
    "serial write": (SerialLink, "write", (MemoryError, KeyError), 200),
    "serial read": (SerialLink, "read_frame", (MemoryError, ValueError), 200),
    "camera trigger": (AravisCamera, "trigger", (MemoryError, ValueError), 10),
    "camera temperature": (AravisCamera, "temperature_c", (KeyError,), 10),
    "disc": (StateFile, "write_state", (MemoryError, OSError), 10),
    "disc probe": (os, "utime", (OSError,), 3),
    "thread": (threading.Thread, "start", (RuntimeError,), 6),
    # A clock does not fail: it is set, or one reading of it is wrong.
    "clock": (time, "time", (lambda now: now + 3600.0, lambda now: now - 90.0), 60),
}


class Injected:
    """Lets the calls of one kind fail from a number on, so many times; only while armed."""

    def __init__(self, patch, kind, chance):
        place, name, errors, calls = CALLS[kind]
        # The disc process counts too.
        self._armed = multiprocessing.Value("b", False)
        countdown, until = chance.randint(1, calls), chance.choice([1, 10**9])
        self._left, self._until = multiprocessing.Value("l", countdown), multiprocessing.Value("l", until)
        self.holds_the_light = place is SerialLink and until > 1
        self._error = chance.choice(errors)
        call = getattr(place, name)

        def fail(*arguments, **options):
            if self._armed.value:
                self._left.value -= 1
                if self._left.value <= 0 and self._until.value > 0:
                    self._until.value -= 1
                    if not isinstance(self._error, type):
                        return self._error(call(*arguments, **options))
                    raise self._error("injected")
            return call(*arguments, **options)

        patch.setattr(place, name, fail)

    def arm(self, armed):
        self._armed.value = armed


@pytest.mark.parametrize("kind", [*CALLS, "two at a time"])
def test_after_any_failure_the_light_is_off_and_the_capture_goes_on(run_with, intact, monkeypatch, kind, runs):
    chance = random.Random(kind)
    for _ in range(runs):
        rigs, kinds = [], [kind] if kind in CALLS else chance.sample(list(CALLS), 2)
        with monkeypatch.context() as patch:
            injected = [Injected(patch, each, chance) for each in kinds]

            def arm(rig, state, retake, injected=injected, rigs=rigs):
                rigs.append(rig)
                for each in injected:
                    each.arm(True)

            error, path = run_with(arm)
            for each in injected:
                each.arm(False)
        assert error is None or isinstance(error, AcquisitionError | DeviceError), error
        # A shutter whose line fails for good cannot be shut; the guard of a real rig has a line of its own.
        if not any(each.holds_the_light for each in injected):
            assert not rigs[0].simulation.light(), (kinds, error)
        intact(path)
        if error is not None:
            error, path = run_with(resume=path)
            assert error is None
        assert intact(path) == 19


@pytest.mark.parametrize("times", [1, 10**9])
def test_without_a_process_for_the_disc_nothing_moves_and_the_same_command_goes_on(
    acquire, quick_rig, monkeypatch, tmp_path, times
):
    failed, moved = [], []
    fork, start = os.fork, MotionAxis.start_move

    def no_fork():
        if len(failed) < times:
            failed.append(1)
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return fork()

    command = ("--omega", 35, "--mode", "stokes", "--rig", quick_rig(), "--out", tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fork", no_fork)
        patch.setattr(MotionAxis, "start_move", lambda *arguments: moved.append(1) or start(*arguments))
        code, _, err = acquire(*command)
    assert code == 1
    assert "no process can be started that writes the captures" in err
    assert "then give the same command" in err
    assert not moved
    assert not list(tmp_path.glob("*.h5*"))
    acquire.made(*command)
