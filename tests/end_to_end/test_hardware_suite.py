"""The suite that a lab runs on its rig, run on emulators that a second program serves."""

import subprocess
import sys
from pathlib import Path

from simulators.rig.served_rig import serve

ROOT = Path(__file__).resolve().parents[2]


def test_hardware_suite_passes_on_a_served_rig(small_rig, acquire, tmp_path):
    rig = tmp_path / "served.yaml"
    with serve(small_rig("behind.yaml"), rig, "red_sphere"):
        assert acquire("home", "--rig", rig, "--yes")[0] == 0
        assert acquire("move", "arm", 35, "--rig", rig)[0] == 0
        options = ["-q", "-p", "no:cacheprovider", "-o", "addopts=--import-mode=importlib", "--rig", str(rig)]
        run = subprocess.run(
            [sys.executable, "-m", "pytest", "tests/hardware", *options], cwd=ROOT, capture_output=True, text=True
        )
    assert "4 passed" in run.stdout, run.stdout + run.stderr
