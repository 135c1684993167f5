"""Change the runner, the writer and the solvers in one place at a time and see whether a test notices.

`./lab mutate` goes on where it was last stopped, for at most `--minutes`; it begins again with what has changed since.
What survives is listed by `--survivors`, and shown as a difference by `.venv/bin/python -m mutmut show NAME`.
"""

import argparse
import json
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

from mutmut.stats import status_by_exit_code

ROOT = Path(__file__).resolve().parents[1]
#: Outcomes of a changed program that a test notices: fail, hang or crash.
NOTICED = ("killed", "timeout", "segfault", "suspicious")


def run(minutes: float, names: list[str]) -> None:
    """Try changes for so long; Ctrl-C is how mutmut is asked to keep what it has found."""
    command = [sys.executable, "-m", "mutmut", "run", "--max-children", "2", *names]
    child = subprocess.Popen(command, cwd=ROOT)
    try:
        child.wait(60 * minutes)
    except subprocess.TimeoutExpired:
        child.send_signal(signal.SIGINT)
        child.wait()


def outcomes() -> dict[str, dict[str, str]]:
    """For each file, what became of each of its changes, as far as they were tried."""
    statuses = {}
    for path in sorted((ROOT / "mutants").rglob("*.py.meta")):
        codes = json.loads(path.read_text())["exit_code_by_key"]
        name = str(path.relative_to(ROOT / "mutants")).removesuffix(".meta")
        statuses[name] = {mutant: status_by_exit_code[code] for mutant, code in codes.items()}
    return {name: statuses[name] for name in statuses if statuses[name]}


def main() -> None:
    """Run, then print the score of each file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--survivors", action="store_true", help="list what no test noticed, and try nothing")
    parser.add_argument("names", nargs="*", help="names of changes, with * for any part; all by default")
    options = parser.parse_args()
    if not options.survivors:
        run(options.minutes, options.names)
    print(f"{'file':48} {'changes':>7} {'tried':>6} {'noticed':>7}  score")
    for name, statuses in outcomes().items():
        tried = Counter(status for status in statuses.values() if status not in ("not checked", "skipped"))
        noticed = sum(tried[status] for status in NOTICED)
        score = f"{100 * noticed / tried.total():.0f} %" if tried else "-"
        print(f"{name:48} {len(statuses):7} {tried.total():6} {noticed:7}  {score:>5}")
        if options.survivors:
            print(*(f"    {m}: {s}" for m, s in statuses.items() if s in ("survived", "no tests")), sep="\n")


if __name__ == "__main__":
    main()
