"""What readers of the pages have and the checkout has not: files of theirs, so that shown commands can run."""

import contextlib
import shutil
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from processing.instrument.model import InstrumentModel

#: Of a capture at Omega 35, its darks among them.
STATES = 44
MOSAIC = (("90", "45"), ("135", "0"))


def states_done(path: Path) -> int:
    """States that a capture which is being written holds; 0 while it cannot be read."""
    with contextlib.suppress(OSError, KeyError, RuntimeError), h5py.File(path, "r", locking=False) as file:
        return int(np.count_nonzero(file["entry/states/done"][...]))
    return 0


@pytest.fixture
def own_files(
    tmp_path: Path, configs: Path, small_rig: Callable[..., Path], synthetic_capture: Callable[..., Path]
) -> dict[str, Callable[[], object]]:
    """What makes a reader's own files in the test's folder, by the title of the block that asks for them."""

    def colour_sensor() -> Path:
        colours = np.array([["red", "green"], ["green", "blue"]]).repeat(2, 0).repeat(2, 1)
        return synthetic_capture(
            np.full((1, 1, 16, 16), 1000, np.uint16),
            {"psg": np.zeros(1)},
            name="colour.h5",
            mosaic=MOSAIC,
            colours=tuple(map(tuple, colours)),
            channels=("mosaic",),
        )

    def turned_polarizer() -> Path:
        azimuth = np.arange(0, 180, 15.0)
        counts = 1000 + 900 * np.cos(2 * np.deg2rad(azimuth[:, None, None] - np.array(MOSAIC, float)))
        camera = (configs / "instruments/linear_stokes.yaml").read_text(encoding="utf-8")
        turned = camera.replace("azimuth_deg: 0}\nanalyzer", "axis: polarizer}\nanalyzer")
        assert turned != camera
        return synthetic_capture(
            np.tile(counts, (1, 8, 8))[:, None],
            {"polarizer": azimuth},
            name="polarizer.h5",
            mosaic=MOSAIC,
            sample={"kind": "air"},
            instrument_yaml=turned,
        )

    def six_wavelengths() -> None:
        instrument = InstrumentModel.load(configs / "instruments/drr_5to1.yaml")
        angles = {"psg": 7.5 * np.arange(24), "psa": 37.5 * np.arange(24)}
        for nm in (450, 500, 550, 600, 650, 700):
            plate = {"azimuth_deg": 0.4, "retardance_deg": 127 * 550 / nm}
            model = instrument.with_values({"psg_retarder": plate, "psa_retarder": plate})
            light = 100 + 20_000 * model.rows(angles) @ np.eye(4).ravel()
            synthetic_capture(
                np.random.default_rng(nm).poisson(np.broadcast_to(light[..., None, None], (24, 1, 8, 8))).astype("<u2"),
                angles,
                name=f"air{nm}.h5",
                wavelength_nm=nm,
                sample={"kind": "air"},
                detector={"black_level_counts": 100, "bits": 16},
            )

    def frames_of_another_lab() -> None:
        instrument = InstrumentModel.load(configs / "instruments/drr_imaging_630nm.yaml")
        psg = 9.0 * np.arange(40)
        angles = {"psg": psg, "psa": 5 * psg + 3, "analyzer": 2 * psg}
        mirror = np.diag([1.0, 1, -1, -1]).ravel()
        counts = 12 + 3000 * instrument.at(630).rows(angles)[:, 0] @ mirror
        lines = [",".join(["state", *angles, "file"])]
        for state, count in enumerate(counts):
            cv2.imwrite(str(tmp_path / f"{state}.png"), np.full((8, 12), round(count), np.uint16))
            lines.append(",".join([str(state), *(str(turned[state]) for turned in angles.values()), f"{state}.png"]))
        (tmp_path / "states.csv").write_text("\n".join(lines) + "\n")

    def power_cut() -> None:
        rig, folder = small_rig(), tmp_path / "cut"
        acquire = [sys.executable, "-m", "acquisition.commands.application", "--omega", "35"]
        # On a machine that is busy elsewhere a capture may be over before anybody looks: then another one.
        while not (cut := [path for path in folder.glob("*.partial") if 0 < states_done(path) < STATES]):
            with subprocess.Popen([*acquire, "--rig", str(rig), "--out", str(folder)]) as child:
                while child.poll() is None and not any(map(states_done, folder.glob("*.partial"))):
                    time.sleep(0.02)
                child.kill()
        (tmp_path / "captures").mkdir(exist_ok=True)
        shutil.move(cut[0], tmp_path / "captures/X.h5.partial")

    return {
        "with a capture of a colour sensor": colour_sensor,
        "with a capture of a turned polarizer": turned_polarizer,
        "with captures of air at six wavelengths": six_wavelengths,
        "with data of another lab": frames_of_another_lab,
        "with a capture that a power cut ended, and your rig": power_cut,
    }


@pytest.fixture
def short_plan(tmp_path: Path) -> Callable[[str], Path]:
    """A plan of one dark and one light state of a mode."""

    def make(mode: str, more: str = "") -> Path:
        path = tmp_path / f"{mode}.yaml"
        states = "states: {kind: fixed, states: 1}" if mode == "stokes" else ""
        path.write_text(f"kind: plan\nmode: {mode}\ndarks: 1\nexposure_s: 0.005\n{states}\n{more}\n")
        return path

    return make
