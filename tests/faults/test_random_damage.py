"""Promise 20 at random: sound files are spoilt at every door, and nothing worse than a refusal comes of it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).with_name("fuzz_doors.py")


@pytest.mark.skipif(bool(os.environ.get("CI")), reason="CI itself runs it for longer")
@pytest.mark.long
def test_random_damage_at_every_door():
    """A fixed seed and few inputs; CI itself gives each door half a minute (.ci/run)."""
    command = [sys.executable, str(FUZZ), "--inputs", "15", "--seed", "20"]
    process = subprocess.run(command, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stdout[-3000:] + process.stderr[-2000:]
