"""Memory, descriptors and threads of `acquire` over a night of small captures on the simulated rig.

    python benchmarks/steady_night.py [CAPTURES]

Sampled after each capture, from outside. Exit code 1 if one of them grew: the last tenth of the night against the
second (the first still loads libraries). Memory may grow by 2 %: what Python's allocator keeps is not the same twice,
and a campaign keeps a record of each capture. A sample may fall into a moment at which a file is open: two descriptors.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from kill_points import ROOT, write_files

#: What may be more at the end: a share, and a number.
MAY_GROW = {"memory, MiB": (0.02, 0.0), "descriptors": (0.0, 2.0), "threads": (0.0, 0.0)}


def sample(pid: int) -> dict[str, float]:
    """What the process holds now."""
    proc = Path(f"/proc/{pid}")
    status = dict(line.split(":", 1) for line in (proc / "status").read_text().splitlines())
    return {
        "memory, MiB": int(status["VmRSS"].split()[0]) / 1024,
        "descriptors": len(os.listdir(proc / "fd")),
        "threads": int(status["Threads"]),
    }


def watch(captures: int, folder: Path) -> list[dict[str, float]]:
    """Run a campaign; one sample a capture, taken when the file of the next one has appeared."""
    options = write_files(folder, captures)
    command = [sys.executable, "-m", "acquisition.commands.application", *options, "--out", str(folder / "out")]
    samples: list[dict[str, float]] = []
    told = folder / "told.txt"
    with told.open("w") as file, subprocess.Popen(command, cwd=ROOT, stdout=file, stderr=file) as acquire:
        while acquire.poll() is None:
            if len(list((folder / "out" / "night").glob("*.h5"))) > len(samples):
                samples.append(sample(acquire.pid))
                if len(samples) % 25 == 0:
                    print(f"{len(samples)} captures: {samples[-1]}", flush=True)
            time.sleep(0.05)
    if acquire.returncode:
        raise SystemExit(f"acquire ended with {acquire.returncode}: {told.read_text()[-2000:]}")
    return samples


def main() -> None:
    """Run a night and compare its last tenth with its second."""
    captures = int(sys.argv[1]) if len(sys.argv) > 1 else 300
    with tempfile.TemporaryDirectory() as folder:
        samples = watch(captures, Path(folder))
    tenth = max(1, len(samples) // 10)
    grown = False
    for what, (share, number) in MAY_GROW.items():
        early = statistics.median(one[what] for one in samples[tenth : 2 * tenth])
        late = statistics.median(one[what] for one in samples[-tenth:])
        most = max(one[what] for one in samples)
        print(f"{what}: {early:.1f} after a tenth, {late:.1f} in the last tenth, {most:.1f} at most")
        grown |= late > early * (1 + share) + number
    sys.exit(int(grown))


if __name__ == "__main__":
    main()
