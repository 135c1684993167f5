"""`./lab demo` on many seeds: a table of what was built in, what was found, and the error of M before and after.

PYTHONPATH=. python benchmarks/demo_seeds.py [--first 1] [--last 20]    # rows of the table in docs/studies/demo.md
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from acquisition.commands.demo import run_seed
from acquisition.demo.loop import Demo
from acquisition.demo.summary import NOT_FOUND, cause_rows

#: Relative change of the error of M from which on it counts as improved or worse; less is a draw.
CHANGE = 0.01

HEAD = """| seed | built in | found | residual beyond noise | error of M/m00 | error of xi0 | result | s |
|---|---|---|---|---|---|---|---|"""


def result_of(demo: Demo) -> str:
    """In a few words, failures first."""
    ratio = demo.after.mueller_rms / demo.before.mueller_rms
    words = [f"WRONG NAME {e.kind}" for e in demo.wrong_names]
    words += ["M WORSE"] if ratio > 1 + CHANGE else ["M improved"] if ratio < 1 - CHANGE else ["M as before"]
    missing = sum(found == NOT_FOUND for _, found in cause_rows(demo))
    return ", ".join(words + ([f"{missing} not found"] if missing else []))


def row_of(demo: Demo) -> str:
    """One line of the table."""
    d, rows = demo.judged.diagnosis, cause_rows(demo)
    cells = [
        str(demo.seed),
        "<br>".join(true for true, _ in rows),
        "<br>".join(found for _, found in rows),
        f"{d.error_before.told} to {d.error_after.told}",
        f"{demo.before.mueller_rms:.4f} to {demo.after.mueller_rms:.4f}",
        f"{demo.before.xi0_rms:.4f} to {demo.after.xi0_rms:.4f}",
        result_of(demo),
        f"{demo.seconds:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def main() -> None:
    """Print the table, a row as soon as its seed is done."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--last", type=int, default=20)
    asked = parser.parse_args()
    print(HEAD, flush=True)
    for seed in range(asked.first, asked.last + 1):
        with tempfile.TemporaryDirectory() as folder:
            print(row_of(run_seed(Path(folder) / "demo", seed)), flush=True)


if __name__ == "__main__":
    main()
