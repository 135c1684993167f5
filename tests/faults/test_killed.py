"""Promise 1: killed at any instant, every state marked done is intact; `capture_life.py` resumes the run."""

import h5py

from acquisition.capture.state_file import wait_until_free

OMEGA = ("--omega", 35)


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
