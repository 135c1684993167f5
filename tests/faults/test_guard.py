"""Promise 17: when `acquire` is killed or frozen, a process beside it shuts the light and stops the axes."""

import json
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from acquisition.rig.config import load_rig
from acquisition.rig.guard import Guard, Journal
from simulators.rig.served_rig import serve


@pytest.fixture
def served(quick_rig, tmp_path):
    """A rig whose emulators live in this process, so that they outlast the program that is killed."""
    told = tmp_path / "told.txt"
    hook = tmp_path / "hook.sh"
    hook.write_text(f'#!/bin/sh\necho "$1" >> {told}\n')
    hook.chmod(0o755)
    # Emulators of another program keep their own time: on a busy machine they answer late.
    patient = {"reply_s": 60}
    axes = {
        "psg": {"kind": "zaber", "port": "sim:rotators", "address": 1} | patient,
        "psa": {"kind": "zaber", "port": "sim:rotators", "address": 2} | patient,
        "arm": {"kind": "smc100", "port": "sim:arm", "address": 1, "limits_deg": [0, 180]} | patient,
    }
    source = {"kind": "sc10", "port": "sim:shutter", "blade_s": 60} | patient
    top = {"settle_s": 0.0, "alert": [str(hook)], "axes": axes, "source": source}
    rig = quick_rig("behind.yaml", clock_speed=4, top=top)
    with serve(rig, tmp_path / "served.yaml", "red_sphere") as simulation:
        yield simulation, tmp_path / "served.yaml", told


def _lit(simulation):
    return simulation.light()


def _moving(simulation):
    return any(axis.is_moving() for emulator in simulation.emulators.values() for axis in emulator.axes)


def _until(condition, child=None):
    # How long it takes is measured by benchmarks/guard_time.py.
    while not condition():
        assert child is None or child.poll() is None, child.communicate()
        time.sleep(0.01)


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_killed_or_frozen_the_light_is_shut_and_the_axes_stop(kind, spawn, partial_of, served, intact, tmp_path):
    simulation, rig, told = served
    child = spawn("--omega", 35, "--rig", rig, "--out", tmp_path / "out")
    partial = partial_of(tmp_path / "out", child, states=5)
    _until(lambda: _lit(simulation) and _moving(simulation), child)
    child.send_signal(kind)
    _until(lambda: not _lit(simulation) and not _moving(simulation))
    journal = tmp_path / "out" / "guard.jsonl"
    _until(lambda: "axes at rest" in journal.read_text())
    events = [json.loads(line)["event"] for line in journal.read_text().splitlines()]
    assert events[0] == "guard watches"
    assert {"light shut", "axes at rest"} <= set(events)
    _until(lambda: told.exists() and "light shut, axes at rest" in told.read_text())
    assert child.wait() == -signal.SIGKILL
    # What was done is there, and the rig is free again.
    assert intact(partial) >= 5
    child = spawn("--resume", partial)
    _, err = child.communicate()
    assert child.returncode == 0, err
    assert "guard rests" in journal.read_text()


def test_a_guard_tells_of_a_failure_and_rests(tmp_path, served):
    """Beats, a failure and the word to rest: nothing is shut and no port is opened."""
    _, rig, told = served
    guard = subprocess.Popen([sys.executable, "-m", "acquisition.rig.guard"], stdin=subprocess.PIPE, text=True)
    log = tmp_path / "guard.jsonl"
    first = {"rig": rig.read_text(), "pid": os.getpid(), "log": str(log)}
    guard.communicate(json.dumps(first) + "\nbeat 1\nfailed a device broke\nrest\n")
    assert guard.returncode == 0
    _until(lambda: told.exists() and "a device broke" in told.read_text())
    assert [json.loads(line)["event"] for line in log.read_text().splitlines()] == [
        "guard watches", "alert", "guard rests",
    ]  # fmt: skip


def test_the_light_is_shut_however_late_its_port_is_free(served):
    """What dies slowly holds the port for longer than anybody should wait before calling for help."""
    simulation, rig, told = served
    config = load_rig(rig)
    with open(config.source.port, "rb") as port:
        holder = subprocess.Popen(["sleep", "600"], stdin=port)
    guard = Guard(config, holder.pid, Journal(None), config.alert)
    with ThreadPoolExecutor(1) as beside:
        light = beside.submit(guard._shut_light)
        _until(lambda: told.exists() and "could not be shut yet" in told.read_text())
        assert not light.done()
        holder.kill()
        holder.wait()
        assert light.result() == "light shut"
    assert [alert.wait() for alert in guard.alerts] == [0]
    assert not _lit(simulation)
