"""How fast `view` answers for a large capture: opening it, a pixel's curve, a part of a frame that is zoomed into.

Run: .venv/bin/python benchmarks/view_times.py [--rows 2048 --columns 2448 --states 40]

The capture is written into a temporary folder. `opened` is the time from asking for the page to its first frame drawn,
in headless Chromium with nothing in its cache. Medians of the repeats, with the processor time of the server beside
them, and of the page's own thread: on a busy machine those tell what a quiet one would take.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
from playwright.sync_api import sync_playwright

from processing.instrument.model import InstrumentModel
from processing.storage.capture_schema import CaptureHeader, Detector, create_layout, write_closing
from processing.storage.checksums import row_crc32

ROOT = Path(__file__).resolve().parents[1]
REPEATS = 7


def write_capture(path: Path, rows: int, columns: int, states: int) -> None:
    """A capture with 4 dark states and this many of a sample; noise in every frame: nothing is compressible."""
    text = (ROOT / "configs/instruments/rgb950.yaml").read_text()
    model = InstrumentModel.load(ROOT / "configs/instruments/rgb950.yaml").at(662)
    turned = np.arange(states)
    angles = {"psg": 9.0 * turned, "psa": 9.0 * 4.91 * turned}
    signal = model.rows(angles, None).reshape(states, 16) @ np.diag([1.0, 0.5, 0.4, 0.3]).reshape(16) * 1500
    rng = np.random.default_rng(1)
    noise = rng.normal(0, 12, (rows, columns))
    detector = Detector(black_level_counts=64, gain_e_per_count=2.6, read_noise_e=2.3, bits=12)
    header = CaptureHeader(
        title="large", simulated=True, mode="drr", wavelength_nm=662, instrument_yaml=text, detector=detector
    )
    role = ("dark",) * 4 + ("sample",) * states
    targets = {name: np.concatenate([np.zeros(4), column]) for name, column in angles.items()}
    with h5py.File(path, "w") as h5:
        create_layout(h5, header, targets, role, (rows, columns), np.uint16, "2026-01-01T00:00:00")
        for k in range(4 + states):
            level = 0.0 if k < 4 else signal[k - 4]
            frame = np.clip(64 + level + np.roll(noise, k * 17, axis=1), 0, 4095).astype(np.uint16)
            h5["entry/instrument/detector/data"][k, 0] = frame
            h5["entry/instrument/detector/row_crc32"][k, 0] = row_crc32(frame)
        for name, column in targets.items():
            h5[f"entry/instrument/{name}/value"][...] = column
        h5["entry/states/exposure_s"][...], h5["entry/states/done"][...] = 0.01, 1
        write_closing(h5, "complete", {})


@dataclass(frozen=True)
class Server:
    """The application as a process: where it answers, and its processor time."""

    base: str
    pid: int

    def asked(self, address: str) -> tuple[float, float]:
        """Seconds for one answer, and of them those of the processor."""
        start, used = time.perf_counter(), self.used_s()
        with urllib.request.urlopen(f"{self.base}/{address}") as answer:
            answer.read()
        return time.perf_counter() - start, self.used_s() - used

    def used_s(self) -> float:
        """Processor time of the server so far."""
        fields = Path(f"/proc/{self.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def told(what: str, times: list[tuple[float, float]], target: str = "") -> None:
    """One line of the table: median of the clock, mean of the processor, which counts in steps of 10 ms."""
    clock = 1e3 * statistics.median(seconds for seconds, _ in times)
    processor = 1e3 * statistics.mean(seconds for _, seconds in times)
    print(f"{what:<54} {clock:7.0f} ms {processor:7.0f} ms   {target}")


def main() -> None:
    """Write the capture, serve it, ask."""
    parser = argparse.ArgumentParser(description=__doc__)
    for name, default in (("rows", 2048), ("columns", 2448), ("states", 40)):
        parser.add_argument(f"--{name}", type=int, default=default)
    options = parser.parse_args()
    rows, columns = options.rows, options.columns
    with tempfile.TemporaryDirectory() as folder:
        write_capture(Path(folder) / "large.h5", rows, columns, options.states)
        server = subprocess.Popen(
            [sys.executable, "-m", "viewer.command", folder],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        assert server.stdout is not None
        found = re.search(r"http\S+", server.stdout.readline())
        assert found is not None
        print(f"{columns} x {rows} pixels, {options.states} states and 4 dark ones; by the clock and of the processor")
        try:
            measure(Server(found[0].rstrip("/"), server.pid), rows, columns)
        finally:
            server.terminate()
            server.wait()


def measure(server: Server, rows: int, columns: int) -> None:
    """Ask the server as a page does, and then have a browser open the page."""
    # Once for what is compiled, imported and kept.
    server.asked("capture?file=large.h5")
    told("first pixel's curve: darks read, model set up, once", [server.asked("curve?file=large.h5&x0=1&y0=1")])
    turns = range(1, REPEATS + 1)
    curves = [server.asked(f"curve?file=large.h5&x0={97 * k % columns}&y0={131 * k % rows}") for k in turns]
    told("a pixel's curve of all states, with the fitted one", curves, "target 50 ms")
    frames = [server.asked(f"frame?file=large.h5&state={k + 4}&most=700") for k in turns]
    told("a frame, reduced to the screen", frames)
    part = f"x0={columns // 3}&x1={columns // 3 + 300}&y0={rows // 3}&y1={rows // 3 + 300}"
    told("300 x 300 pixels, zoomed into", [server.asked(f"frame?file=large.h5&state={k + 4}&{part}") for k in turns])
    told("page of the capture, server alone", [server.asked("capture?file=large.h5") for _ in turns])
    opening = [opened(server.base) for _ in turns]
    seen = 1e3 * statistics.median(seconds for seconds, _, _ in opening)
    print(f"{'page opened in Chromium, the frame to be seen':<54} {seen:7.0f} ms              target 1000 ms")
    told("... to be zoomed and probed", [(clock, thread) for _, clock, thread in opening])


def opened(base: str) -> tuple[float, float, float]:
    """Seconds from asking for the page to its first picture and to its plot, and processor time of the page's thread.

    In a browser that has seen nothing before.
    """
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        devtools = page.context.new_cdp_session(page)
        devtools.send("Performance.enable", {"timeDomain": "threadTicks"})
        start = time.perf_counter()
        page.goto(f"{base}/capture?file=large.h5")
        page.wait_for_selector("body[data-ready]", state="attached")
        seconds = time.perf_counter() - start
        metrics = {entry["name"]: entry["value"] for entry in devtools.send("Performance.getMetrics")["metrics"]}
        pictures = "performance.getEntriesByType('resource').filter(e => e.name.includes('/preview'))"
        seen = page.evaluate(f"{pictures}[0].responseEnd / 1000")
        browser.close()
    return seen, seconds, metrics["TaskDuration"]


if __name__ == "__main__":
    main()
