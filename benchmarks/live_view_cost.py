"""What browsers on the live page cost a capture: its dead time with and without them.

Run: .venv/bin/python benchmarks/live_view_cost.py [--runs 8] [--clients 4] [--busy]

Captures on the simulated rig, by turns with the page closed and with so many browsers asking for state, frame and quick
look as the page does (twice a second; with --busy without a pause). Dead time is what a capture takes beyond moves,
settling, exposure and the camera's own reading out. Printed are the medians, their ratio with its standard error from
pairs of neighbours, and the processor time that the measuring thread itself spends on the page, with and without
busy browsers, which a loaded machine does not change much.
Needs a quiet machine: on a loaded one the standard error says how little the ratio tells.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

import numpy as np

from acquisition.screen.live_view import LiveView
from acquisition.screen.observer import StateReport
from acquisition.stop_request import StopRequest
from drivers.motion import Position
from processing.storage.capture import Capture

ROOT = Path(__file__).resolve().parents[1]


def browse(url: str, busy: bool, end: threading.Event) -> None:
    """Ask for what the page asks for until the run has ended."""
    base, query = url.split("/?")
    while not end.is_set():
        for path in ("state", "frame.png", "quick.png"):
            try:
                with urllib.request.urlopen(f"{base}/{path}?{query}", timeout=10) as answer:
                    answer.read()
            except OSError:
                # No frame yet, or the run has ended.
                continue
        end.wait(0.0 if busy else 0.5)


def dead_time_s(folder: Path, clients: int, busy: bool) -> float:
    """Seconds of one capture beyond the unavoidable, with so many browsers (0: the page is there, nobody looks)."""
    command = [
        sys.executable,
        "-m",
        "acquisition.commands.application",
        "--omega",
        "35",
        "--out",
        str(folder),
        "--live",
    ]
    end, browsers = threading.Event(), []
    child = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert child.stderr is not None
    for line in child.stderr:
        found = re.search(r"live view: (http://\S+)", line)
        if found:
            browsers = [threading.Thread(target=browse, args=(found[1], busy, end)) for _ in range(clients)]
            for browser in browsers:
                browser.start()
    child.wait()
    end.set()
    for browser in browsers:
        browser.join()
    (path,) = folder.glob("*.h5")
    with Capture(path) as capture:
        ledger = capture.closing["ledger"]
    path.unlink()
    return float(ledger["excess"] * ledger["unavoidable_s"])


def own_cost_ms(clients: int, rows: int = 2048, columns: int = 2448) -> float:
    """Processor time of the measuring thread for one state of a 5-megapixel camera, milliseconds.

    The browsers ask without a pause.
    """
    pixels = np.ones((rows, columns), dtype=np.uint16)
    report = StateReport(0, "sample", {"psg": Position(0.0, 0)}, 0.01, 0.0, 0.0, 1.0, pixels)
    spent, end = [], threading.Event()
    with LiveView(True, 64.0, 4095, StopRequest()) as view:
        browsers = [threading.Thread(target=browse, args=(view.url, True, end)) for _ in range(clients)]
        for browser in browsers:
            browser.start()
        for _ in range(40):
            start_s = time.thread_time()
            view.state_done(report)
            spent.append(time.thread_time() - start_s)
            time.sleep(0.05)
        end.set()
        for browser in browsers:
            browser.join()
    return 1e3 * float(np.median(spent))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=8, help="captures of each kind")
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--busy", action="store_true", help="browsers that ask without a pause")
    options = parser.parse_args()
    for clients in (0, options.clients):
        cost_ms = own_cost_ms(clients)
        print(
            f"measuring thread: {cost_ms:.2f} ms a state of 2048 x 2448 pixels with {clients} busy browsers", flush=True
        )
    alone, watched = [], []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(options.runs):
            alone.append(dead_time_s(Path(folder), 0, options.busy))
            watched.append(dead_time_s(Path(folder), options.clients, options.busy))
            print(f"  pair {len(watched)}: {alone[-1]:.3f} s alone, {watched[-1]:.3f} s watched", flush=True)
    ratio = np.array(watched) / np.array(alone)
    error = ratio.std(ddof=1) / np.sqrt(len(ratio))
    print(
        f"dead time, median: {np.median(alone):.3f} s alone, {np.median(watched):.3f} s with {options.clients} browsers"
    )
    print(f"ratio {ratio.mean():.4f} +- {error:.4f} over {len(ratio)} pairs")


if __name__ == "__main__":
    main()
