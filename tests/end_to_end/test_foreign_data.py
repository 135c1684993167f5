"""Data of four other labs, imported, reduced and compared with the truth that made them."""

from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from scipy.io import savemat

from processing.instrument.elements import Diattenuator, Polarizer, Retarder
from processing.instrument.measured_matrix import MeasuredMatrix
from processing.instrument.model import Channel, InstrumentModel
from processing.storage.captures.capture import Capture
from processing.storage.formats.import_request import name_of_item
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
    code, text, _ = process(*command, "--dry-run")
    assert code == 0
    assert "41 states, 5 of them dark" in text
    assert "img_2.tif" in text.splitlines()[4]
    assert (tmp_path / "sample.import.png").exists()
    assert not out.exists()
    assert process(*command)[0] == 0
    assert mueller_of(process, out) == pytest.approx(SAMPLE, abs=2e-3)
    # The recipe imports it once more, without any other option.
    copy = tmp_path / "again.h5"
    assert process("import", "--recipe", tmp_path / "sample.import.yaml", "--out", copy)[0] == 0
    with Capture(out) as first, Capture(copy) as second:
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
    code, _, text = process(*command)
    assert code == 2
    assert "--angles radians" in text
    assert process(*command, "--angles", "radians")[0] == 0
    assert mueller_of(process, out) == pytest.approx(SAMPLE, abs=2e-3)


@pytest.mark.parametrize("kind", ["npz", "struct", "folders", "repeats", "one column"])
def test_other_files_of_the_same_scan(configs, tmp_path, process, drr, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)
    frames = frames_of(configs, "drr_5to1.yaml", drr)[:, 0] - DARK
    instrument = configs / "instruments" / "drr_5to1.yaml"
    np.savetxt("angles.csv", np.stack([drr["psg"], drr["psa"]], axis=1), delimiter=",", header="psg,psa")
    options = ["--states", "angles.csv"]
    if kind == "npz":
        np.savez_compressed("run.npz", frames=frames, **drr)
        options = ["--columns", "psg=run.npz::psg", "--columns", "psa=run.npz::psa", "--stack", "run.npz::frames"]
    elif kind == "struct":
        savemat("run.mat", {"data": {"img": np.moveaxis(frames, 0, -1), "deg": drr}, "note": "x"})
        axes = (f"{axis}=run.mat::data.deg.{axis}" for axis in ("psg", "psa"))
        options = [*(word for axis in axes for word in ("--columns", axis)), "--stack", "run.mat::data.img"]
    elif kind == "repeats":
        np.save("run.npy", frames.repeat(3, axis=0))
        options += ["--stack", "run.npy", "--repeats", "3"]
    elif kind == "one column":
        # A gear: one motor turns both plates.
        np.savetxt("angles.csv", drr["psg"], header="motor", comments="")
        words = instrument.read_text().replace("axis: psa,", "axis: psa, ratio: 5,")
        assert "ratio: 5" in words
        instrument = tmp_path / "geared.yaml"
        instrument.write_text(words)
        np.save("run.npy", frames)
        options += ["--columns", "psg=motor", "--columns", "psa=motor", "--stack", "run.npy"]
    else:
        # Written last to first: the order in the folder is not that of the states.
        for k in reversed(range(len(frames))):
            (tmp_path / f"state_{k}").mkdir()
            cv2.imwrite(f"state_{k}/frame.tif", frames[k])
        options += ["--stack", "state_*/frame.tif"]
    out = tmp_path / "sample.h5"
    code, _, text = process("import", *options, "--wavelength-nm", 532, "--instrument", instrument, "--out", out)
    assert code == 0, text
    assert mueller_of(process, out) == pytest.approx(SAMPLE, abs=2e-3)


def test_scenes_of_a_polarization_camera_are_not_averaged(configs, tmp_path, process):
    scenes = [tmp_path / f"scene{k}.png" for k in range(3)]
    for k, scene in enumerate(scenes):
        cv2.imwrite(str(scene), np.full((8, 8), 1000 + k, np.uint16))
    options = ("--wavelength-nm", 550, "--instrument", configs / "instruments" / "linear_stokes.yaml")
    _, text, _ = process("import", "--stack", tmp_path, *options, "--out", tmp_path / "all.h5")
    assert "3 frames in which nothing turns: `reduce` averages them. If each is a scene, give the files" in text
    code, text, _ = process("import", *scenes, *options, "--out", tmp_path / "each")
    assert (code, text.splitlines()[-1]) == (0, "3 inputs: 3 made, 0 unchanged, 0 failed")
    with Capture(tmp_path / "each" / "scene2.h5") as capture:
        assert capture.frames(0)[0, 0, 0] == 1002


@pytest.fixture
def day(configs, tmp_path, drr, monkeypatch):
    """Folders of three measurements, each with frames and a table; returns the options of them all."""
    monkeypatch.chdir(tmp_path)
    for name in ("run_2", "run_10", "run_3.5"):
        Path(name).mkdir()
        np.save(f"{name}/frames.npy", frames_of(configs, "drr_5to1.yaml", drr)[:, 0] - DARK)
        table = np.stack([drr["psg"], drr["psa"]], axis=1)
        np.savetxt(f"{name}/log.csv", table, delimiter=",", header="psg,psa", comments="")
    instrument = configs / "instruments" / "drr_5to1.yaml"
    return ("--wavelength-nm", 532, "--instrument", instrument)


def test_several_measurements_in_one_command(day, process):
    runs = sorted(Path().glob("run_*"))
    options = ("--states", "{item}/log.csv", "--stack", "{item}/frames.npy", *day)
    (runs[0] / "log.csv").rename("away.csv")
    code, text, errors = process("import", *options, *runs, "none")
    assert code == 2
    assert "4 inputs: 2 made, 0 unchanged, 2 failed" in text
    assert f"{runs[0]}/log.csv: cannot be read" in errors
    Path("away.csv").rename(runs[0] / "log.csv")
    captures = [Path(f"{run}.h5") for run in runs]
    before = [path.stat().st_mtime_ns for path in captures[1:]]
    code, text, _ = process("import", *options, *runs)
    assert (code, text.splitlines()[-1]) == (0, "3 inputs: 1 made, 2 unchanged, 0 failed")
    assert [path.stat().st_mtime_ns for path in captures[1:]] == before
    for path in captures:
        assert mueller_of(process, path) == pytest.approx(SAMPLE, abs=2e-3)
    # Another option, or newer frames, are another capture.
    assert process("import", *options, "--black-level", 5, *runs)[0] == 2
    np.save(runs[0] / "frames.npy", np.load(runs[0] / "frames.npy") + 1)
    code, text, errors = process("import", *options, *runs)
    assert (code, text.splitlines()[-1]) == (2, "3 inputs: 0 made, 2 unchanged, 1 failed")
    assert f"{captures[0]} exists" in errors


@pytest.mark.parametrize(
    ("item", "name"),
    [("day/run.1/", "day/run.1.h5"), ("day/run.1.h5::/scan/a", "day/run.1_scan_a.h5"), (".", "day.h5"), ("/", ".h5")],
)
def test_the_capture_of_a_measurement_is_next_to_it(item, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("day/run.1").mkdir(parents=True)
    if item == ".":
        monkeypatch.chdir("day")
    start = Path("/") if item == "/" else tmp_path
    assert Path(name_of_item(item)).absolute() == start / name


def test_the_stack_of_a_recipe_is_that_of_no_other_measurement(day, process):
    runs = sorted(Path().glob("run_*"))
    np.save(runs[1] / "frames.npy", np.load(runs[1] / "frames.npy") + 7)
    stack = runs[0] / "frames.npy"
    assert process("import", "--states", runs[0] / "log.csv", "--stack", stack, *day, "--out", "first.h5")[0] == 0
    (runs[1] / "frames.npy.csv").write_bytes((runs[1] / "log.csv").read_bytes())
    options = ("--recipe", "first.import.yaml", runs[1] / "frames.npy")
    for more in ((), ("--states", "{item}.csv")):
        process.made("import", *options, *more, "--out", "second.h5", "--overwrite")
        with Capture(Path("first.h5")) as first, Capture(Path("second.h5")) as second:
            assert np.array_equal(first.frames(4) + 7, second.frames(4))


def test_the_data_are_never_replaced_by_their_capture(configs, tmp_path, process, drr):
    file = tmp_path / "lab.h5"
    with h5py.File(file, "w") as h5:
        h5["frames"] = frames_of(configs, "drr_5to1.yaml", drr)[:, 0]
        h5["angles"] = np.stack([drr["psg"], drr["psa"]], axis=1)
    content = file.read_bytes()
    columns = (
        "--columns",
        "psg={item}::/angles[0]",
        "--columns",
        "psa={item}::/angles[1]",
        "--stack",
        "{item}::/frames",
    )
    options = (*columns, "--wavelength-nm", 532, "--instrument", configs / "instruments" / "drr_5to1.yaml", file)
    code, _, text = process("import", *options, "--overwrite")
    assert (code, "has the data themselves" in text) == (2, True)
    assert file.read_bytes() == content
    assert process("import", *options, "--out", tmp_path / "capture.h5")[0] == 0


def test_two_beams_on_one_sensor(tmp_path, process):
    plate = "{kind: retarder, name: plate, axis: hwp, azimuth_deg: 0, retardance_deg: 180}"
    channels = "".join(
        f"  - {{name: {name}, elements: [{{kind: polarizer, name: p_{name}, azimuth_deg: {angle}}}]}}\n"
        for name, angle in (("o", 0), ("e", 90))
    )
    text = (
        f"kind: instrument\nname: wollaston\ngenerator: []\nanalyzer: [{plate}]\nchannels:\n{channels}beams: [o, e]\n"
    )
    (tmp_path / "beams.yaml").write_text(text)
    angles = {"hwp": np.array([0, 22.5, 45, 67.5])}
    light = np.zeros(16)
    light[::4] = 1, 0.3, -0.2, 0
    signal = InstrumentModel.load(tmp_path / "beams.yaml").at(550).rows(angles) @ light * 8000
    for angle, pair in zip(angles["hwp"], signal, strict=True):
        frame = np.repeat(pair, 6)[None].repeat(4, axis=0).round().astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"hwp_{angle}.tif"), frame)
    out = tmp_path / "c.h5"
    command = ("import", "--stack", tmp_path / "hwp_{hwp}.tif", "--wavelength-nm", 550)
    process.made(*command, "--instrument", tmp_path / "beams.yaml", "--out", out)
    with Capture(out) as capture:
        assert (capture.channel_names, capture.frame_shape) == (("o", "e"), (4, 6))
    assert process("reduce", out, "--no-figure")[0] == 0
    s = MuellerImage.load(out.with_suffix(".stokes.h5")).values[:, 0].mean(axis=(1, 2))
    assert s[:3] / s[0] == pytest.approx(light[:12:4], abs=2e-3)


def test_a_liquid_crystal_polarimeter_has_a_measured_w_and_no_angles(tmp_path, process):
    rng = np.random.default_rng(4)
    w = rng.normal(0, 0.1, (20, 16)) + np.eye(16)[0]
    rows = "".join(f"    - {row.tolist()}\n" for row in w)
    (tmp_path / "lc.yaml").write_text(f"kind: instrument\nname: lc\nmeasured:\n  u: 0.002\n  rows:\n{rows}")
    np.save(tmp_path / "run.npy", (w @ SAMPLE.reshape(16) * 8000).round().astype(np.uint16)[:, None, None].repeat(4, 1))
    out = tmp_path / "sample.h5"
    command = ("import", "--stack", tmp_path / "run.npy", "--instrument", tmp_path / "lc.yaml", "--wavelength-nm", 550)
    assert process(*command, "--out", out)[0] == 0
    assert mueller_of(process, out) == pytest.approx(SAMPLE, abs=5e-3)


@pytest.mark.parametrize("kind", ["npy", "mat"])
def test_a_stokes_polarimeter_of_twelve_states(configs, tmp_path, process, kind):
    angles = {"psa": np.arange(12) * 15.0}
    frames = frames_of(configs, "rotating_retarder_stokes.yaml", angles)[:, 0] - DARK
    if kind == "npy":
        (tmp_path / "run").mkdir()
        for k, frame in enumerate(frames):
            np.save(tmp_path / "run" / f"s{k}.npy", frame)
        np.save(tmp_path / "angles.npy", angles["psa"])
        options = ("--stack", tmp_path / "run", "--columns", f"psa={tmp_path}/angles.npy")
    else:
        savemat(tmp_path / "run.mat", {"img": np.moveaxis(frames, 0, -1), "deg": angles["psa"]})
        options = ("--stack", f"{tmp_path}/run.mat::img", "--columns", f"psa={tmp_path}/run.mat::deg")
    out = tmp_path / "sample.h5"
    instrument = ("--instrument", configs / "instruments" / "rotating_retarder_stokes.yaml")
    assert process("import", *options, *instrument, "--wavelength-nm", 532, "--out", out)[0] == 0
    assert process("reduce", out, "--no-figure")[0] == 0
    product = out.with_suffix(".stokes.h5")
    image = MuellerImage.load(product)
    assert image.values[:, 0].mean(axis=(1, 2)) / image.values[0, 0].mean() == pytest.approx(SAMPLE[:, 0], abs=2e-3)
    former = product.rename(out.with_suffix(".mueller.h5"))
    for command in ("reduce", "quantities"):
        code, text, _ = process(command, out, "--no-figure")
        assert (code, product.exists()) == (0, False)
        assert former.name in text


def mueller_of(process, capture):
    """M / m00 of the whole image, by `process reduce`."""
    assert process("reduce", capture, "--no-figure")[0] == 0
    m = MuellerImage.load(capture.with_suffix(".mueller.h5")).values.mean(axis=(2, 3))
    return m / m[0, 0]


def test_the_reference_of_instrument_files_names_every_field():
    page = (ROOT / "docs/instrument-files.md").read_text()
    fields = {*InstrumentModel.model_fields, *Channel.model_fields, *MeasuredMatrix.model_fields}
    fields |= {name for kind in (Polarizer, Retarder, Diattenuator) for name in kind.model_fields}
    assert {name for name in fields if f"`{name}`" not in page} == set()
