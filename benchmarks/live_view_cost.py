"""What browsers on the live page cost a capture: its dead time with and without them.

Run: .venv/bin/python benchmarks/live_view_cost.py [--blocks 40] [--clients 4] [--busy]

One campaign of captures on the simulated rig, with the page open. In blocks of three captures, in random order,
nobody looks at the page; so many browsers do, as the page does (the state twice a second, pictures where it is new;
with --busy without a pause); or they look at the page of another program that shows frames as fast. That program is
there all the time. What the third kind costs is the price of browsers on the same machine, whatever they look at;
what the second costs beyond it is taken by the page. Dead time is what a capture takes beyond moves, settling,
exposure and the camera's own reading out. Printed are means, ratios with standard errors over blocks, and the
processor time that the measuring thread itself spends on the page, which a loaded machine does not change much.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import random
import re
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np
from kill_points import write_rig

from acquisition.screen.live_view import LiveView
from acquisition.screen.observer import StateReport
from acquisition.stop_request import StopRequest
from drivers.motion import Position
from processing.storage.capture import Capture

ROOT = Path(__file__).resolve().parents[1]
Kind = Literal["nobody", "watched", "elsewhere"]
KINDS: tuple[Kind, ...] = ("nobody", "watched", "elsewhere")
#: States of a capture, pixels of a side, and about what a state takes.
STATES, SIDE = 300, 300
STATE_S = 0.02


class Browsers:
    """So many threads that ask a page for what it asks for itself, while they are told to look at one."""

    def __init__(self, clients: int, pause_s: float) -> None:
        self._pause_s = pause_s
        self._url: str | None = None
        self._ended = threading.Event()
        self._threads = [threading.Thread(target=self._browse) for _ in range(clients)]
        for thread in self._threads:
            thread.start()

    def look_at(self, url: str | None) -> None:
        """From now on at this page, or at none."""
        self._url = url

    def end(self) -> None:
        """Close them all."""
        self._ended.set()
        for thread in self._threads:
            thread.join()

    def _browse(self) -> None:
        seen = ""
        while not self._ended.is_set():
            url = self._url
            if url is None:
                self._ended.wait(0.02)
                continue
            base, query = url.split("/?")
            # No frame yet, or the run has ended.
            with contextlib.suppress(OSError):
                state = json.loads(_get(f"{base}/state?{query}"))
                if (now := f"{state.get('title')}{state.get('done')}") != seen:
                    seen = now
                    _get(f"{base}/frame.png?{query}")
                    _get(f"{base}/quick.png?{query}")
            self._ended.wait(self._pause_s)


def _get(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=10) as answer:
        data: bytes = answer.read()
        return data


def show_frames(rows: int, columns: int) -> None:
    """The other program: a live page that is handed a frame as often as that of the capture, until it is ended."""
    report = _report(rows, columns)
    with LiveView(True, 64.0, 4095, StopRequest()) as view:
        print(view.url, flush=True)
        while True:
            view.state_done(report)
            time.sleep(STATE_S)


def _report(rows: int, columns: int) -> StateReport:
    pixels = np.random.default_rng(1).integers(100, 4000, size=(rows, columns), dtype=np.uint16)
    return StateReport(0, "sample", {"psg": Position(0.0, 0)}, 0.01, 0.0, 0.0, 1.0, pixels)


@contextlib.contextmanager
def other_page(rows: int, columns: int) -> Iterator[str]:
    """Address of the page of the other program."""
    command = [sys.executable, __file__, "--show", str(rows), str(columns)]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        try:
            yield program.stdout.readline().strip()
        finally:
            program.kill()


def campaign(folder: Path, captures: int) -> list[str]:
    """The command that takes them: of many states and little besides dead time, a thousandth of a degree apart."""
    quick = {"rows": SIDE, "columns": SIDE, "clock_speed": 200, "camera_wait_s": 60}
    write_rig(folder / "rig.yaml", quick, settle_s=0.0)
    (folder / "plan.yaml").write_text(
        "kind: plan\nmode: drr\nwavelength_nm: 662\nomega_deg: 35\nsample: {name: red_sphere}\n"
        f"states: {{kind: rotating_retarders, states: {STATES}, step_deg: 9, ratio: 4.91}}\n"
        "exposure_s: 0.001\ndarks: 1\n"
    )
    angles = ", ".join(f"{35 + k / 1000:.3f}" for k in range(captures))
    (folder / "campaign.yaml").write_text(
        f"kind: campaign\nname: watched\nplans: {{drr: {folder / 'plan.yaml'}}}\n"
        f"samples: [{{name: red_sphere}}]\nwavelengths_nm: [662]\nomega_deg: [{angles}]\n"
    )
    return [
        *(sys.executable, "-m", "acquisition.commands.application", "--live", "--yes"),
        *("--rig", str(folder / "rig.yaml"), "--campaign", str(folder / "campaign.yaml"), "--out", str(folder)),
    ]


def dead_times(folder: Path, kinds: list[Kind], browsers: Browsers, other: str) -> Iterator[tuple[Kind, float]]:
    """Seconds of each capture beyond the unavoidable, while the browsers look where its kind says."""
    told = folder / "told.txt"
    with told.open("w") as words, subprocess.Popen(campaign(folder, len(kinds)), cwd=ROOT, stderr=words) as acquire:
        page = None
        while page is None and acquire.poll() is None:
            page = re.search(r"live view: (http://\S+)", told.read_text())
            time.sleep(0.02)
        address = {"nobody": None, "watched": page[1] if page else None, "elsewhere": other}
        for number, kind in enumerate(kinds):
            browsers.look_at(address[kind])
            while len(files := sorted((folder / "watched").glob("*.h5"))) <= number and acquire.poll() is None:
                time.sleep(0.01)
            browsers.look_at(None)
            if len(files) <= number:
                raise SystemExit(f"acquire ended with {acquire.wait()}: {told.read_text()[-2000:]}")
            with Capture(files[number]) as capture:
                ledger = capture.closing["ledger"]
            yield kind, float(ledger["excess"] * ledger["unavoidable_s"])


def own_cost_ms(clients: int, rows: int = 2048, columns: int = 2448) -> float:
    """Processor time of the measuring thread for one state of a 5-megapixel camera, milliseconds.

    The browsers ask without a pause.
    """
    report, spent = _report(rows, columns), []
    browsers = Browsers(clients, 0.0)
    with LiveView(True, 64.0, 4095, StopRequest()) as view:
        browsers.look_at(view.url)
        for _ in range(40):
            start_s = time.thread_time()
            view.state_done(report)
            spent.append(time.thread_time() - start_s)
            time.sleep(0.05)
        browsers.end()
    return 1e3 * float(np.median(spent))


def ratio(of: list[float], to: list[float]) -> str:
    """Of the means, with its standard error from blocks left out one at a time."""
    over, under = np.array(of), np.array(to)
    without = (over.sum() - over) / (under.sum() - under)
    error = np.sqrt((len(over) - 1) * np.mean((without - without.mean()) ** 2))
    return f"{over.sum() / under.sum():.4f} +- {error:.4f}"


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--blocks", type=int, default=40, help="captures of each kind")
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--busy", action="store_true", help="browsers that ask without a pause")
    parser.add_argument("--show", type=int, nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.show:
        show_frames(*options.show)
    for clients in (0, options.clients):
        cost_ms = own_cost_ms(clients)
        print(
            f"measuring thread: {cost_ms:.2f} ms a state of 2048 x 2448 pixels with {clients} busy browsers", flush=True
        )
    # The first capture still loads libraries.
    draw = random.Random(1)
    kinds: list[Kind] = ["nobody", *(kind for _ in range(options.blocks) for kind in draw.sample(KINDS, 3))]
    found: dict[Kind, list[float]] = {kind: [] for kind in KINDS}
    browsers = Browsers(options.clients, 0.0 if options.busy else 0.5)
    with tempfile.TemporaryDirectory() as folder, other_page(SIDE, SIDE) as other:
        try:
            for number, (kind, dead_s) in enumerate(dead_times(Path(folder), kinds, browsers, other)):
                if number:
                    found[kind].append(dead_s)
                if number % 30 == 0:
                    print(f"  capture {number} of {len(kinds)}: {dead_s:.3f} s ({kind})", flush=True)
        finally:
            browsers.end()
    for kind in KINDS:
        error_s = np.std(found[kind], ddof=1) / np.sqrt(options.blocks)
        print(f"dead time, {kind}: {np.mean(found[kind]):.4f} +- {error_s:.4f} s a capture")
    print(f"watched / nobody: {ratio(found['watched'], found['nobody'])}")
    print(f"elsewhere / nobody: {ratio(found['elsewhere'], found['nobody'])}")
    print(f"watched / elsewhere: {ratio(found['watched'], found['elsewhere'])}")


if __name__ == "__main__":
    main()
