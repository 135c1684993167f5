"""Peak memory of `acquire` for 16, 40 and 80 states of 2448 x 2048, the emulators in another process.

Run: .venv/bin/python benchmarks/acquire_memory.py
"""

import contextlib
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from simulated_rig import write_rig

from simulators.rig.served_rig import serve


def main() -> None:
    rows, columns = 2048, 2448
    for states in (16, 40, 80):
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            behind = write_rig(folder / "behind.yaml", {"rows": rows, "columns": columns})
            with serve(behind, folder / "rig.yaml", "red_sphere"):
                (folder / "plan.yaml").write_text(
                    f"kind: plan\nstates: {{kind: rotating_retarders, states: {states}, step_deg: {360 / states}}}\n"
                )
                options = ["--plan", folder / "plan.yaml", "--rig", folder / "rig.yaml", "--out", folder]
                run = subprocess.Popen(
                    [sys.executable, "-m", "acquisition.commands.application", *map(str, options)],
                    stdout=subprocess.PIPE,
                    text=True,
                )
                peak = 0
                while run.poll() is None:
                    peak = max(peak, _peak_mib(run.pid))
                    time.sleep(0.1)
                out, _ = run.communicate()
            if run.returncode:
                raise SystemExit(f"the run ended with {run.returncode}")
            size = next(folder.glob("*.h5")).stat().st_size
            print(f"{states} states of {columns} x {rows}: file {size / 1e6:.0f} MB, peak {peak} MiB")
            print("\n".join(line for line in out.splitlines() if line.startswith("seconds")))


def _peak_mib(pid: int) -> int:
    # Not getrusage: a child's figure there begins with the memory of the process that it was forked from.
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) // 1024
    return 0


if __name__ == "__main__":
    main()
