"""Promise 1: killed at any instant, every state marked done is intact and the run goes on where it was."""

import random
import time

import h5py

from acquisition.capture.state_file import wait_until_free

OMEGA = ("--omega", 35)


def test_killed_at_random_and_resumed(spawn, partial_of, quick_rig, acquire, intact, content, runs, tmp_path):
    rig = quick_rig()
    code, _, err = acquire(*OMEGA, "--rig", rig, "--out", tmp_path / "whole")
    assert code == 0, err
    whole = content(next((tmp_path / "whole").glob("*.h5")))
    chance = random.Random(20260101)
    for number in range(runs):
        folder = tmp_path / f"run{number}"
        child = spawn(*OMEGA, "--rig", rig, "--out", folder)
        partial = partial_of(folder, child)
        time.sleep(chance.uniform(0.0, 2.5))
        child.kill()
        child.wait()
        wait_until_free(partial)
        # A run that was quicker than the kill is complete already.
        if partial.exists():
            before = intact(partial)
            code, _, err = acquire("--resume", partial)
            assert code == 0, err
            assert f"{44 - before} states" in err
        final = next(folder.glob("*.h5"))
        assert intact(final) == 44
        assert content(final) == whole


def test_a_kill_leaves_the_states_done_to_any_reader(spawn, partial_of, quick_rig, tmp_path):
    child = spawn(*OMEGA, "--rig", quick_rig(), "--out", tmp_path)
    partial = partial_of(tmp_path, child, states=8)
    size = partial.stat().st_size
    child.kill()
    child.wait()
    # Its disc process ends a moment later.
    wait_until_free(partial)
    with h5py.File(partial) as file:
        done = file["entry/states/done"][...]
        assert done[:8].all()
        assert not done[-1]
        assert file["entry"].attrs["status"] == b"running"
    # Nothing grew while it ran: the space was there before the first motion.
    assert partial.stat().st_size == size
