"""How long the guard takes: from the kill or the freeze of `acquire` to a shut light and axes at rest.

    python benchmarks/guard_time.py [TRIES]

The rig is emulated by this process behind real ports, so that it outlasts the program that is killed.
"""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from simulated_rig import write_rig

from simulators.rig.served_rig import serve


def _once(folder: Path, kind: signal.Signals) -> tuple[float, float]:
    rig = write_rig(folder / "rig.yaml", {"rows": 64, "columns": 80, "clock_speed": 2})
    with serve(rig, folder / "served.yaml", "red_sphere") as simulation:
        command = ["-m", "acquisition.commands.application", "--omega", "35", "--rig", str(folder / "served.yaml")]
        child = subprocess.Popen([sys.executable, *command, "--out", str(folder)], stderr=subprocess.DEVNULL)

        def moving() -> bool:
            return any(axis.is_moving() for emulator in simulation.emulators.values() for axis in emulator.axes)

        while not (simulation.light() and moving()):
            if child.poll() is not None:
                raise SystemExit(f"acquire ended with {child.returncode} before it could be killed")
            time.sleep(0.002)
        begin_s = time.monotonic()
        child.send_signal(kind)
        dark_s = rest_s = 0.0
        while not (dark_s and rest_s):
            time.sleep(0.002)
            now_s = time.monotonic() - begin_s
            dark_s = dark_s or (0.0 if simulation.light() else now_s)
            # Between two moves they rest for a moment: the guard's own word counts.
            log = folder / "guard.jsonl"
            rest_s = rest_s or (now_s if log.exists() and "axes at rest" in log.read_text() else 0.0)
        child.kill()
        child.wait()
    return dark_s, rest_s


def main() -> None:
    """Print the median and the worst of both times."""
    tries = int(sys.argv[1]) if len(sys.argv) > 1 else 10
    for kind in (signal.SIGKILL, signal.SIGSTOP):
        times = []
        for _ in range(tries):
            with tempfile.TemporaryDirectory() as folder:
                times.append(_once(Path(folder), kind))
        middle, worst = np.median(times, axis=0), np.max(times, axis=0)
        print(
            f"{kind.name}: light shut after {middle[0]:.2f} s (worst {worst[0]:.2f}), "
            f"axes at rest after {middle[1]:.2f} s (worst {worst[1]:.2f}), {tries} tries"
        )


if __name__ == "__main__":
    main()
