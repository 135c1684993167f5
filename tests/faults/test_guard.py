"""Promise 17: when `acquire` is killed or frozen, a process beside it shuts the light and stops the axes."""

import json
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from acquisition.errors import AcquisitionError
from acquisition.rig import alarms
from acquisition.rig.config import load_rig
from acquisition.rig.guard import Guard, Journal, with_held_ports
from acquisition.rig.open_rig import open_rig
from processing.storage.captures.capture import Capture
from processing.yaml_file import dump_yaml
from simulators.rig.served_rig import serve
from simulators.serial.reply_faults import parse_fault


@pytest.fixture
def served(quick_rig, tmp_path, monkeypatch):
    """A rig whose emulators live in this process, so that they outlast the program that is killed."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    alarms = tmp_path / "told.txt"
    hook = tmp_path / "hook.sh"
    hook.write_text(f'#!/bin/sh\necho "$1" >> {alarms}\n')
    hook.chmod(0o755)
    # Emulators of another program keep their own time: on a busy machine they answer late.
    patient = {"reply_s": 60}
    axes = {
        "psg": {"kind": "zaber", "port": "sim:rotators", "address": 1} | patient,
        "psa": {"kind": "zaber", "port": "sim:rotators", "address": 2} | patient,
        "arm": {"kind": "smc100", "port": "sim:arm", "address": 1, "limits_deg": [0, 180]} | patient,
    }
    source = {"kind": "sc10", "port": "sim:shutter", "blade_s": 60} | patient
    top = {"alert": [str(hook)], "alert_every_s": 1, "axes": axes, "source": source}
    rig = quick_rig("behind.yaml", clock_speed=4, top=top)
    with serve(rig, tmp_path / "served.yaml", "red_sphere") as simulation:
        yield simulation, tmp_path / "served.yaml", alarms


def _lit(simulation):
    return simulation.light()


def _moving(simulation):
    return any(axis.is_moving() for emulator in simulation.emulators.values() for axis in emulator.axes)


def _until(condition, child=None):
    # How long it takes: docs/promises.md.
    while not condition():
        assert child is None or child.poll() is None, child.communicate()
        time.sleep(0.01)


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGSTOP])
def test_killed_or_frozen_the_light_is_shut_and_the_axes_stop(
    kind, spawn, acquire, partial_of, plan_file, served, intact, tmp_path
):
    simulation, rig, alarms = served
    child = spawn("--omega", 35, "--plan", plan_file, "--rig", rig, "--out", tmp_path / "out")
    partial = partial_of(tmp_path / "out", child, states=5)
    _until(lambda: _lit(simulation) and _moving(simulation), child)
    child.send_signal(kind)
    _until(lambda: not _lit(simulation) and not _moving(simulation))
    journal = tmp_path / "out" / "guard.jsonl"
    _until(lambda: "axes at rest" in journal.read_text())
    events = [json.loads(line)["event"] for line in journal.read_text().splitlines()]
    assert events[0] == "guard watches"
    assert {"light shut", "axes at rest"} <= set(events)
    _until(lambda: alarms.exists() and "light shut, axes at rest" in alarms.read_text())
    assert child.wait() == -signal.SIGKILL
    # What was done is there, and the rig is free again.
    assert intact(partial) >= 5
    simulation.clock.speed = 50
    acquire.made("--resume", partial)
    assert "guard rests" in journal.read_text()


@pytest.fixture
def watched_rig(served):
    """The served rig, open in this process, with a guard that watches it."""
    simulation, rig, alarms = served
    with open_rig(load_rig(rig), with_camera=False) as live:
        live.start_guard(rig.parent / "guard.jsonl")
        yield live, simulation, alarms


def _guard_of(rig):
    return rig.guarding.process.pid


def test_no_light_before_a_guard_watches_and_the_light_goes_off_with_the_guard(watched_rig):
    rig, simulation, _ = watched_rig
    rig.source.set_light(True)
    assert _lit(simulation)
    journal = Path(rig.guarding.journal)
    _until(lambda: journal.exists() and "guard watches" in journal.read_text())
    for number, kind in enumerate((signal.SIGKILL, signal.SIGSTOP), start=1):
        before = _guard_of(rig)
        os.kill(before, kind)
        _until(lambda: not _lit(simulation))
        _until(lambda number=number: rig.light_losses() >= number)
        if kind == signal.SIGSTOP:
            os.kill(before, signal.SIGCONT)
        rig.source.set_light(True)
        assert _lit(simulation)
    news = " ".join(rig.guard_news())
    assert "killed by signal 9" in news
    assert "stopped or silent" in news


def test_a_capture_survives_its_guard(spawn, partial_of, plan_file, served, intact, tmp_path):
    simulation, rig, _ = served
    child = spawn("--omega", 35, "--plan", plan_file, "--rig", rig, "--out", tmp_path / "out")
    partial_of(tmp_path / "out", child, states=5)
    (guard,) = _guards_of(child.pid)
    os.kill(guard, signal.SIGKILL)
    journal = tmp_path / "out" / "guard.jsonl"
    _until(lambda: "guard restarted" in journal.read_text(), child)
    simulation.clock.speed = 50
    _, err = child.communicate()
    assert child.returncode == 0, err
    assert "the guard was lost (it was killed by signal 9)" in err
    (path,) = (tmp_path / "out").glob("*.h5")
    assert intact(path) == 19
    with Capture(path) as capture:
        assert any("the guard was lost" in text for text in capture.closing["messages"])


def _guards_of(pid):
    children = Path(f"/proc/{pid}/task").glob("*/children")
    pids = {int(number) for file in children for number in file.read_text().split()}
    return [number for number in pids if b"acquisition.rig.guard" in Path(f"/proc/{number}/cmdline").read_bytes()]


@pytest.mark.parametrize("fault", ["silent", pytest.param("garbled", marks=pytest.mark.long)])
def test_a_light_that_acquire_cannot_shut_is_shut_by_the_guard(spawn, partial_of, plan_file, served, tmp_path, fault):
    """The shutter's line answers with noise or nothing; when it is well again the guard shuts the light."""
    simulation, rig, alarm_file = served
    config = load_rig(rig)
    rig.write_text(dump_yaml(config.model_copy(update={"source": config.source.model_copy(update={"reply_s": 1.0})})))
    child = spawn("--omega", 35, "--plan", plan_file, "--rig", rig, "--out", tmp_path / "out")
    partial_of(tmp_path / "out", child, states=5)
    _until(lambda: _lit(simulation), child)
    shutter = simulation.emulators["shutter"]
    shutter.faults.add(parse_fault(fault))
    child.send_signal(signal.SIGINT)
    child.send_signal(signal.SIGTERM)
    _, err = child.communicate()
    assert child.returncode != 0
    assert alarms.ACKNOWLEDGE in err
    # The alarm repeats, and stays when the line is well and the light is off.
    _until(lambda: alarm_file.exists() and alarm_file.read_text().count("THE LIGHT IS NOT SHUT") >= 2)
    shutter.faults.clear()
    _until(lambda: not _lit(simulation))
    (alarm,) = alarms.unacknowledged()
    alarms.acknowledge(alarm)
    _until(lambda: "alarm acknowledged" in (tmp_path / "out" / "guard.jsonl").read_text())


@pytest.mark.parametrize(
    ("port", "fault"), [("rotators", "garbled"), pytest.param("arm", "silent", marks=pytest.mark.long)]
)
def test_an_axis_whose_stop_is_not_confirmed_is_stopped_by_the_guard(
    spawn, partial_of, plan_file, served, tmp_path, port, fault
):
    simulation, rig, alarm_file = served
    config = load_rig(rig)
    axes = {name: entry.model_copy(update={"reply_s": 1.0}) for name, entry in config.axes.items()}
    rig.write_text(dump_yaml(config.model_copy(update={"axes": axes})))
    child = spawn("--omega", 35, "--plan", plan_file, "--rig", rig, "--out", tmp_path / "out")
    partial_of(tmp_path / "out", child, states=5)
    _until(lambda: _lit(simulation), child)
    line = simulation.emulators[port]
    line.faults.add(parse_fault(fault))
    child.send_signal(signal.SIGINT)
    child.send_signal(signal.SIGTERM)
    _, err = child.communicate()
    assert child.returncode != 0
    assert not _lit(simulation)
    assert "does not answer whether it rests" in err
    assert "AN AXIS MAY MOVE" in err
    assert "THE LIGHT MAY BE ON" not in err
    _until(lambda: alarm_file.exists() and alarm_file.read_text().count("AXES NOT AT REST") >= 2)
    line.faults.clear()
    journal = tmp_path / "out" / "guard.jsonl"
    _until(lambda: "axes at rest" in journal.read_text())
    (alarm,) = alarms.unacknowledged()
    alarms.acknowledge(alarm)
    _until(lambda: "alarm acknowledged" in journal.read_text())


def test_a_guard_writes_to_a_port_that_somebody_holds(watched_rig):
    """What dies slowly, or waits in the kernel, holds its ports: the guard has them already."""
    rig, simulation, _ = watched_rig
    rig.source.set_light(True)
    held = with_held_ports(rig.config, rig._lines.descriptors())
    assert Guard(held, os.getpid(), Journal(None)).try_light() is None
    assert not _lit(simulation)


def test_what_was_noted_before_the_journal_is_closed_is_written(tmp_path, monkeypatch):
    """The process that writes may begin late on a busy machine, even after the guard has ended."""
    late = tmp_path / "late"
    late.write_text(f'#!/bin/sh\nsleep 0.3\nexec {sys.executable} "$@"\n')
    late.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(late))
    journal = Journal(tmp_path / "guard.jsonl")
    journal.note("guard rests")
    journal.close()
    written = tmp_path / "guard.jsonl"
    _until(lambda: written.exists() and "guard rests" in written.read_text())


@pytest.mark.parametrize("link", [Path.symlink_to, Path.hardlink_to])
def test_a_link_in_the_place_of_the_journal_is_not_followed(served, tmp_path, link):
    """The folder of the captures may be somebody else's."""
    (tmp_path / "victim").write_text("precious")
    link(tmp_path / "guard.jsonl", tmp_path / "victim")
    journal = Journal(tmp_path / "guard.jsonl")
    journal.note("guard watches")
    journal.close()
    assert (tmp_path / "victim").read_text() == "precious"
    with pytest.raises(AcquisitionError, match=r"guard.jsonl cannot be written"):
        open_rig(load_rig(served[1])).start_guard(tmp_path / "guard.jsonl")


def test_a_folder_of_alarms_of_another_user_is_not_used(monkeypatch, tmp_path):
    """Where /run has no folder of the user it is in /tmp, and anybody may have made it."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    alarms.give_alarm("bench", "theirs")
    monkeypatch.setattr(os, "getuid", lambda: 4711)
    assert alarms.unacknowledged() == []
    assert "belongs to another user" in alarms.keep("record", "end.json", "{}")
    with pytest.raises(PermissionError):
        alarms.give_alarm("bench", "ours")


def test_acknowledge_is_a_command(acquire, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = alarms.give_alarm("bench", "THE LIGHT IS NOT SHUT")
    code, out, err = acquire("acknowledge")
    assert code == 0
    assert "ALARM since" in err
    assert "rig bench: THE LIGHT IS NOT SHUT" in out
    assert not path.exists()
