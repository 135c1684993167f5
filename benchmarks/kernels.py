"""Repeat tests of numbers under each kernel of OpenBLAS that this processor can run, and with numba's generic code.

`./lab kernels` runs `tests/physics`, `tests/measured` and the chain of instruments in one child process after another.
Sums come out in another order on another processor: a verdict, a name or a sign that changes with it is a fault of the
engine.
"""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = ("tests/physics", "tests/measured", "tests/end_to_end/test_instrument_chain.py")
#: Features that the processor needs for each kernel, by the names in /proc/cpuinfo.
NEEDS = {
    "Nehalem": {"sse4_2"},
    "Haswell": {"avx2", "fma"},
    "SkylakeX": {"avx512f", "avx512bw", "avx512dq", "avx512vl"},
}
#: What OpenBLAS says it runs, to see that the kernel was taken.
ARCHITECTURE = "import numpy, threadpoolctl as t; print({p.get('architecture') for p in t.threadpool_info()})"


def environments() -> dict[str, dict[str, str]]:
    """Variables of each run by its name; a kernel that the machine sets is the only one."""
    if "OPENBLAS_CORETYPE" in os.environ:
        kernels = [os.environ["OPENBLAS_CORETYPE"]]
    else:
        flags = set(Path("/proc/cpuinfo").read_text(encoding="utf-8").split())
        kernels = [name for name, needed in NEEDS.items() if needed <= flags]
    runs = {name: {"OPENBLAS_CORETYPE": name} for name in kernels}
    return runs | {"numba generic": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""}}


def main() -> None:
    """Run the tests under each; options go to pytest. The exit code is 1 if any run fails."""
    failed = []
    for name, variables in environments().items():
        child = os.environ | {"OPENBLAS_NUM_THREADS": "1"} | variables
        result = subprocess.run([sys.executable, "-c", ARCHITECTURE], env=child, capture_output=True, text=True)
        print(f"kernels: {name}, OpenBLAS runs {result.stdout.strip()}", flush=True)
        options = sys.argv[1:] or [*TESTS, "-n", "2"]
        if subprocess.run([sys.executable, "-m", "pytest", "-q", *options], env=child, cwd=ROOT).returncode:
            failed.append(name)
    print(f"kernels: {'all pass' if not failed else 'failed: ' + ', '.join(failed)}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    main()
