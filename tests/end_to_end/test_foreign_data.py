"""Data of four other labs, imported, reduced and compared with the truth that made them."""

import re
import runpy
import shlex
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from scipy.io import savemat

from processing.commands.application import main
from processing.commands.diagnose import main as diagnose
from processing.instrument.elements import Diattenuator, Polarizer, Retarder
from processing.instrument.measured import MeasuredMatrix
from processing.instrument.model import Channel, InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.products.images import MuellerImage

ROOT = Path(__file__).resolve().parents[2]
#: A depolarizing sample whose elements are all different; Mueller rows are determined by what an instrument measures.
SAMPLE = np.diag([1.0, 0.6, 0.5, 0.4]) + np.array(
    [[0.0, 0.1, -0.05, 0.02], [0.08, 0, 0.03, 0], [-0.04, 0.02, 0, 0.05], [0.01, 0, -0.06, 0]]
)
SHAPE = (6, 9)
DARK = 100


def frames_of(configs, name, angles, wavelength=532):
    """Counts (states, channels, rows, columns) of the sample seen by an instrument, above a dark level."""
    model = InstrumentModel.load(configs / "instruments" / name)
    rows = model.at(wavelength).rows(angles)
    signal = (rows.reshape(-1, len(model.channels), 16) @ SAMPLE.reshape(16)) * 8000
    return (DARK + np.broadcast_to(signal[..., None, None], (*signal.shape, *SHAPE))).round().astype(np.uint16)


def dark_frames():
    return np.random.default_rng(3).normal(DARK, 2, (5, *SHAPE)).round().astype(np.uint16)


@pytest.fixture
def drr():
    turn = np.arange(36) * 6.0
    return {"psg": turn, "psa": 5 * turn % 360}


def test_tiffs_and_a_table_with_its_own_columns(configs, tmp_path, process, drr):
    frames = frames_of(configs, "drr_5to1.yaml", drr)[:, 0]
    (tmp_path / "run").mkdir()
    (tmp_path / "dark").mkdir()
    for k, frame in enumerate(frames):
        cv2.imwrite(str(tmp_path / "run" / f"img_{k}.tif"), frame)
    for k, frame in enumerate(dark_frames()):
        cv2.imwrite(str(tmp_path / "dark" / f"d{k}.tiff"), frame)
    table = ["frame,angle (deg),analyzer,remark"]
    table += [f"{k},{a},{b},ok" for k, (a, b) in enumerate(zip(drr["psg"], drr["psa"], strict=True))]
    (tmp_path / "log.csv").write_text("\n".join(table) + "\n")
    out = tmp_path / "sample.h5"
    command = (
        *("import", "--states", tmp_path / "log.csv", "--columns", "psg=angle (deg)", "--columns", "psa=analyzer"),
        *("--stack", tmp_path / "run", "--darks", f"{tmp_path}/dark/*.tiff", "--wavelength-nm", 532),
        *("--instrument", configs / "instruments" / "drr_5to1.yaml", "--out", out),
    )
    code, said, _ = process(*command, "--dry-run")
    assert code == 0
    assert "41 states, 5 of them dark" in said
    assert "img_2.tif" in said.splitlines()[4]
    assert (tmp_path / "sample.import.png").exists()
    assert not out.exists()
    assert process(*command)[0] == 0
    assert mueller_of(process, out) == pytest.approx(SAMPLE, abs=2e-3)
    # The recipe imports it once more, without any other option.
    again = tmp_path / "again.h5"
    assert process("import", "--recipe", tmp_path / "sample.import.yaml", "--out", again)[0] == 0
    with Capture(out) as first, Capture(again) as second:
        assert np.array_equal(first.frames(7), second.frames(7))


def test_hdf5_in_radians_with_darks_in_another_dataset(configs, tmp_path, process, drr):
    file = tmp_path / "lab.h5"
    with h5py.File(file, "w") as h5:
        h5["scan/frames"] = frames_of(configs, "drr_5to1.yaml", drr)[:, 0]
        h5["scan/angles"] = np.deg2rad(np.stack([drr["psg"], drr["psa"]], axis=1))
        h5["darks"] = dark_frames()
    out = tmp_path / "sample.h5"
    command = (
        *("import", "--columns", f"psg={file}::/scan/angles[0]", "--columns", f"psa={file}::/scan/angles[1]"),
        *("--stack", f"{file}::/scan/frames", "--darks", f"{file}::/darks", "--wavelength-nm", 532, "--out", out),
        *("--instrument", configs / "instruments" / "drr_5to1.yaml"),
    )
    code, _, said = process(*command)
    assert code == 2
    assert "--angles radians" in said
    assert process(*command, "--angles", "radians")[0] == 0
    assert mueller_of(process, out) == pytest.approx(SAMPLE, abs=2e-3)


@pytest.mark.parametrize("kind", ["npy", "mat"])
def test_a_stokes_polarimeter_of_twelve_states(configs, tmp_path, process, kind):
    angles = {"psa": np.arange(12) * 15.0}
    frames = frames_of(configs, "rotating_retarder_stokes.yaml", angles)[:, 0] - DARK
    if kind == "npy":
        (tmp_path / "run").mkdir()
        for k, frame in enumerate(frames):
            np.save(tmp_path / "run" / f"s{k}.npy", frame)
        np.save(tmp_path / "angles.npy", angles["psa"])
        given = ("--stack", tmp_path / "run", "--columns", f"psa={tmp_path}/angles.npy")
    else:
        savemat(tmp_path / "run.mat", {"img": np.moveaxis(frames, 0, -1), "deg": angles["psa"]})
        given = ("--stack", f"{tmp_path}/run.mat::img", "--columns", f"psa={tmp_path}/run.mat::deg")
    out = tmp_path / "sample.h5"
    instrument = ("--instrument", configs / "instruments" / "rotating_retarder_stokes.yaml")
    assert process("import", *given, *instrument, "--wavelength-nm", 532, "--out", out)[0] == 0
    assert process("reduce", out)[0] == 0
    image = MuellerImage.load(out.with_suffix(".mueller.h5"))
    assert image.values[:, 0].mean(axis=(1, 2)) / image.values[0, 0].mean() == pytest.approx(SAMPLE[:, 0], abs=2e-3)


def mueller_of(process, capture):
    """M / m00 of the whole image, by `process reduce`."""
    assert process("reduce", capture)[0] == 0
    m = MuellerImage.load(capture.with_suffix(".mueller.h5")).values.mean(axis=(2, 3))
    return m / m[0, 0]


def test_the_tutorial_of_an_own_polarimeter_corrects_its_matrix(tmp_path, process, monkeypatch):
    scope = runpy.run_path(str(ROOT / "examples/other_lab.py"))
    scope["write_folders"](tmp_path / "other_lab")
    page = (ROOT / "docs/tutorial-your-own-polarimeter.md").read_text()
    (tmp_path / "my_polarimeter.yaml").write_text(page.split('title="my_polarimeter.yaml"\n')[1].split("```")[0])
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```bash\n(.*?)```", page.replace("\\\n", " "), re.DOTALL)
    for words in map(shlex.split, blocks):
        with pytest.raises(SystemExit) as end:
            {"process": main, "diagnose": diagnose}[words[1]](words[2:])
        assert not end.value.code
    assert process("reduce", "sample.h5", "--instrument", "my_polarimeter.yaml", "--out", "nominal.h5")[0] == 0
    products = (tmp_path / "nominal.h5", *tmp_path.glob("sample.mueller*.h5"))
    matrices = [MuellerImage.load(path).values.mean(axis=(2, 3)) for path in products]
    nominal, corrected = (np.abs(m / m[0, 0] - scope["SAMPLE"]).max() for m in matrices)
    assert nominal > 0.015
    assert corrected < 0.001


def test_the_reference_of_instrument_files_names_every_field():
    page = (ROOT / "docs/instrument-files.md").read_text()
    fields = {*InstrumentModel.model_fields, *Channel.model_fields, *MeasuredMatrix.model_fields}
    fields |= {name for kind in (Polarizer, Retarder, Diattenuator) for name in kind.model_fields}
    assert {name for name in fields if f"`{name}`" not in page} == set()
