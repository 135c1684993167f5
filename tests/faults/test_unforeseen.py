"""Promise 28: whatever ends a run, its end has a record: in the file, the log, the index, and for whoever is called."""

import json
import os
import signal

import filelock
import pytest

from acquisition.capture import session
from acquisition.capture.operator import Operator
from acquisition.disc import disc
from acquisition.errors import Unforeseen
from processing.storage.captures.capture import Capture


def test_an_error_that_nobody_foresaw_is_recorded_and_the_capture_goes_on(run_with, intact):
    rigs = []

    def act(rig, state, retake):
        rigs.append(rig)
        if state == 5:
            raise ValueError("injected")

    error, path = run_with(act)
    assert isinstance(error, Unforeseen)
    assert "ValueError" in str(error)
    assert path.name == "run.h5.partial"
    assert not rigs[0].simulation.light()
    with Capture(path) as capture:
        assert capture.status == "failed"
        assert "injected" in capture.closing["failure"]
        assert "test_unforeseen.py" in capture.closing["traceback"]
    error, final = run_with(resume=path)
    assert error is None
    assert intact(final) == 19


@pytest.fixture
def night(acquire, small_rig, tmp_path):
    """Runs a campaign of one capture with so many retries; returns exit code, what was said, index and log."""
    alarms = tmp_path / "told.txt"
    hook = tmp_path / "hook.sh"
    hook.write_text(f'#!/bin/sh\necho "$1" >> {alarms}\n')
    hook.chmod(0o755)
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        "kind: plan\nmode: stokes\nwavelength_nm: 662\nomega_deg: 35\nsample: {name: red_sphere}\n"
        "states: {kind: fixed, states: 3}\nexposure_s: 0.001\ndarks: 1\n"
    )

    def run(retries):
        (tmp_path / "night.yaml").write_text(
            f"kind: campaign\nname: night\nplans: {{stokes: {plan}}}\nsamples: [{{name: red_sphere}}]\n"
            f"wavelengths_nm: [662]\nomega_deg: [35]\nretries: {retries}\nretry_wait_s: 0\n"
        )
        rig = small_rig("rig.yaml", top={"notify": {"command": [str(hook)]}})
        code, out, err = acquire("--campaign", tmp_path / "night.yaml", "--rig", rig, "--out", tmp_path)
        folder = tmp_path / "night"
        (entry,) = json.loads((folder / "index.json").read_text()).values()
        events = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
        return code, out + err, entry, events, alarms.read_text() if alarms.exists() else ""

    return run


def test_the_plans_retries_are_used(night, monkeypatch):
    take, tries = session.take, []

    def fail_once(*arguments, **options):
        tries.append(1)
        if len(tries) == 1:
            raise ValueError("injected")
        return take(*arguments, **options)

    monkeypatch.setattr(session, "take", fail_once)
    code, text, entry, events, _ = night(retries=1)
    assert code == 0, text
    assert entry["status"] == "complete"
    (failed,) = [event for event in events if event["event"] == "capture failed"]
    assert "Traceback" in failed["traceback"]


@pytest.mark.parametrize("somebody_was_faster", [False, True])
def test_a_campaign_whose_disc_process_was_killed_takes_its_folder_again(
    night, monkeypatch, tmp_path, somebody_was_faster
):
    take, tries, lock = session.take, [], filelock.FileLock(tmp_path / "night" / ".lock")

    def killed_once(*arguments, **options):
        tries.append(1)
        if len(tries) == 1:
            os.kill(disc().pid, signal.SIGKILL)
            if somebody_was_faster:
                lock.acquire(timeout=60)
        result = take(*arguments, **options)
        with pytest.raises(filelock.Timeout):
            lock.acquire(timeout=0)
        return result

    monkeypatch.setattr(session, "take", killed_once)
    code, text, *_ = night(retries=1)
    lock.release()
    if somebody_was_faster:
        assert code == 1
        assert "another program runs the campaign" in text
        assert len(tries) == 1
    else:
        # The end of the process is seen before the capture begins, or by the capture, which is then tried again.
        assert code == 0, text


@pytest.mark.parametrize("where", [(session, "take"), (Operator, "prepare")])
def test_a_night_that_ends_by_any_error_says_so_everywhere(night, monkeypatch, where):
    def fail(*arguments, **options):
        raise KeyError("injected")

    monkeypatch.setattr(*where, fail)
    code, text, entry, events, alarms = night(retries=0)
    assert code == 1
    assert "an unforeseen error ended the run: KeyError: 'injected'" in text
    assert "Traceback" not in text
    assert entry["status"] == "failed"
    assert events[-1]["event"] == "campaign failed"
    assert "Traceback" in events[-1]["traceback"]
    assert "KeyError" in alarms


def test_a_stop_between_captures_leaves_nothing_running(night, monkeypatch):
    def stop(*arguments, **options):
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "take", stop)
    code, _, entry, _, _ = night(retries=3)
    assert code == 130
    assert entry["status"] == "stopped"
