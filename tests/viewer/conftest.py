"""Fixtures of the room: a folder with captures, and the application in front of it."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect
from starlette.testclient import TestClient

from processing.instrument.model import InstrumentModel
from viewer.application import application

TOKEN = "the-token"


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    """An empty folder for the application to show."""
    folder = tmp_path / "lab"
    folder.mkdir()
    return folder


@pytest.fixture
def client(lab: Path) -> TestClient:
    """A browser on this machine that was given the address."""
    return TestClient(application(lab, TOKEN), base_url=f"http://127.0.0.1:8000/{TOKEN}", raise_server_exceptions=False)


@pytest.fixture
def drr_capture(lab: Path, configs: Path, synthetic_capture: Callable[..., Path]) -> Callable[..., Path]:
    """Writes a capture of a dual rotating retarder polarimeter into the folder; returns its path.

    The scene is a known Mueller matrix with some noise of its own in every pixel; keywords go to the header.
    """
    text = (configs / "instruments" / "rgb950.yaml").read_text()
    model = InstrumentModel.load(configs / "instruments" / "rgb950.yaml").at(662)

    def make(name="one.h5", mueller=None, shape=(12, 16), seed_of_noise=1, **more) -> Path:
        states = np.arange(40)
        angles = {"psg": 9.0 * states, "psa": 9.0 * 4.91 * states}
        w = model.rows(angles, None).reshape(40, 16)
        m = np.diag([1.0, 0.5, 0.4, 0.3]) if mueller is None else mueller
        rng = np.random.default_rng(seed_of_noise)
        signal = (w @ m.reshape(16))[:, None, None] * 1000 * np.ones(shape)
        # As the detector below has it: shot noise and read noise.
        noise = rng.normal(size=signal.shape) * np.sqrt(signal / 2.6 + (2.3 / 2.6) ** 2)
        frames = np.concatenate([np.full((4, *shape), 64.0), 64 + signal + noise])
        angles = {name: np.concatenate([np.zeros(4), column]) for name, column in angles.items()}
        detector = {"black_level_counts": 64.0, "gain_e_per_count": 2.6, "read_noise_e": 2.3, "bits": 12}
        header = {"instrument_yaml": text, "mode": "drr", "wavelength_nm": 662.0, "detector": detector} | more
        return synthetic_capture(
            np.round(frames[:, None]).astype(np.uint16),
            angles,
            name=f"lab/{name}",
            role=("dark",) * 4 + ("sample",) * 40,
            **header,
        )

    return make


@pytest.fixture
def address(lab: Path) -> Iterator[str]:
    """Address of the application, served by its own command."""
    child = subprocess.Popen(
        [sys.executable, "-m", "viewer.command", lab], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    assert child.stdout is not None
    line = child.stdout.readline()
    match = re.search(r"http://127\.0\.0\.1:\d+/\S+/", line)
    assert match, line
    yield match[0].rstrip("/")
    child.send_signal(signal.SIGINT)
    child.wait()
    child.stdout.close()
    for job in lab.glob(".umov-view/jobs/*/job.json"):
        if not (job.parent / "code").exists():
            os.kill(json.loads(job.read_text())["pid"], signal.SIGKILL)


@pytest.fixture
def draw_region() -> Callable[..., None]:
    """Draws a rectangle on the frame of a page, by shares of its width and height, with the button and the mouse."""

    def draw(page: Page, first: tuple[float, float], last: tuple[float, float]) -> None:
        page.locator("#region").click()
        expect(page.locator("#region")).to_have_attribute("aria-pressed", "true")
        box = page.locator("#frame .nsewdrag").first.bounding_box()
        assert box is not None
        (x0, y0), (x1, y1) = (
            (box["x"] + box["width"] * across, box["y"] + box["height"] * down) for across, down in (first, last)
        )
        page.mouse.move(x0, y0)
        page.mouse.down()
        page.mouse.move(x1, y1, steps=4)
        page.mouse.up()
        expect(page.locator("#pixel")).to_have_text(re.compile(r"\(\d+ pixels\)"))

    return draw
