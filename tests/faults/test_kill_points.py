"""Promises 14 and 15: killed before any call that changes the disc, or without power there, next to nothing is lost.

A sample of what `python tests/faults/kill_points.py` and `capture_life.py` run in full.
"""

import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

from simulators.disc.power_cut import UnreliableDisc, read_record
from simulators.disc.watched import compiler

HERE = Path(__file__).parent

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler: calls cannot be watched")


def _run(program, *arguments, work):
    done = subprocess.run(
        [sys.executable, str(HERE / program), *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"TMPDIR": str(work)},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.long
def test_killed_at_a_sample_of_calls_the_same_command_goes_on(tmp_path):
    # One while the file is laid out, one among its states.
    assert "0 with something lost" in _run("kill_points.py", "kill", 90, 60, work=tmp_path)


def test_a_power_cut_at_any_call_takes_one_reported_state_at_most(tmp_path):
    assert " 0 beyond the bound" in _run("kill_points.py", "power", 0, work=tmp_path)


@pytest.mark.long
def test_in_any_order_of_ends_resumes_and_other_devices_nothing_reported_is_lost(tmp_path, runs):
    _run("capture_life.py", 10 * runs, work=tmp_path)


def test_the_disc_keeps_what_was_synced_and_only_that(tmp_path):
    """The model that the cuts are made with: what is not synced may go, names too, and folders with all in them."""
    record = tmp_path / "record"
    record.write_bytes(
        b"mkdir\t/a\t0\t0\nsync\t/\t0\t0\n"
        b"create\t/a/x\t0\t0\nwrite\t/a/x\t0\t4\nsafe"
        b"sync\t/a/x\t0\t0\nsync\t/a\t0\t0\nwrite\t/a/x\t2\t2\n!!"
        b"rename\t/a/x\t0\t4\n/a/ymkdir\t/b\t0\t0\ncreate\t/b/z\t0\t0\nsync\t/b\t0\t0\n"
    )
    disc = UnreliableDisc()
    for call in read_record(record):
        disc.apply(call)
    assert disc.after_power_cut(None) == {"/a/x": b"safe"}
    discs = [disc.after_power_cut(random.Random(seed)) for seed in range(60)]
    assert {tuple(sorted(files)) for files in discs} == {("/a/x",), ("/a/y",), ("/a/y", "/b/z")}
    assert {content for files in discs for path, content in files.items() if path.startswith("/a/")} == {
        b"safe",
        b"sa!!",
    }
