"""The `process` command as a user runs it: import, reduce, calibrate, and every way to feed it badly."""

from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from processing.instrument.model import InstrumentModel
from processing.storage.products.images import MuellerImage
from processing.storage.products.product import Product

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def instrument(configs: Path) -> Path:
    return configs / "instruments/rgb950.yaml"


class Measured:
    """A folder as another lab would hand it over: states.csv and one image a state."""

    def __init__(self, folder: Path, instrument: Path, sample: np.ndarray, odd: str = ".png") -> None:
        self.folder, self.states = folder, folder / "states.csv"
        psg = 9.0 * np.arange(40)
        self.angles = {"psg": psg, "psa": 4.91 * psg}
        w = InstrumentModel.load(instrument).at(662).rows(self.angles)[:, 0]
        ramp = np.linspace(4000, 16000, 8 * 12).reshape(8, 12)
        self.m = sample.reshape(16, 1, 1) * ramp
        frames = np.rint(np.einsum("nk,kxy->nxy", w, self.m) + 200).astype(np.uint16)
        lines = ["state,psg_deg,psa_deg,exposure_s,file"]
        for k, frame in enumerate(frames):
            name = f"f{k}{odd if k % 2 else '.png'}"
            cv2.imwrite(str(folder / name), frame)
            lines.append(f"{k},{psg[k]},{4.91 * psg[k]},0.01,{name}")
        self.lines, self.frames = lines, frames
        self.write(lines)

    def write(self, lines: list[str]) -> None:
        self.states.write_text("\n".join(lines) + "\n", encoding="utf-8")


@pytest.fixture
def measured(tmp_path: Path, instrument: Path) -> Measured:
    return Measured(tmp_path, instrument, np.diag([1.0, 1.0, -1.0, -1.0]))


@pytest.mark.usefixtures("figures")
@pytest.mark.long
def test_import_reduce_figure(tmp_path: Path, instrument: Path, process: Run) -> None:
    data = Measured(tmp_path, instrument, np.diag([1.0, 1.0, -1.0, -1.0]), ".tif")
    options = ["--wavelength-nm", 662, "--instrument", instrument, "--sample", "mirror", "--omega-deg", 3]
    noise = ["--black-level", 200, "--gain-e-per-count", 0.5, "--read-noise-e", 2]
    code, out, err = process("import", "--states", data.states, *options, *noise)
    assert (code, err) == (0, "")
    figure = tmp_path / "m.png"
    code, out, err = process("reduce", tmp_path / "states.h5", "--figure", figure)
    # Frames without noise under a gain that promises some: told.
    assert (code, "the residual is only" in err) == (0, True)
    assert "condition number: 7.14" in out
    assert "SIMULATED" not in out
    drawn = cv2.imread(str(figure))
    assert drawn.shape[0] > 500
    assert drawn.std() > 10
    image = MuellerImage.load(tmp_path / "states.mueller.h5")
    assert np.max(np.abs(image.values.reshape(16, 8, 12) - data.m)) < 5  # counts, from rounding of the frames
    assert np.isfinite(image.errors).all()
    written = (tmp_path / "states.mueller.h5").stat().st_mtime_ns
    code, out, err = process("reduce", tmp_path / "states.h5")
    assert (code, out.splitlines()[-1].startswith("unchanged")) == (0, True)
    assert (tmp_path / "states.mueller.h5").stat().st_mtime_ns == written
    assert "states.mueller.h5 exists" in process.refused("reduce", tmp_path / "states.h5", "--weighted")
    assert process("reduce", tmp_path / "states.h5", "--weighted", "--overwrite", "--no-figure")[0] == 0


def test_calibrate_finds_a_wrong_train_and_never_overwrites(
    measured: Measured, tmp_path: Path, instrument: Path, process: Run
) -> None:
    options = ["--wavelength-nm", 662, "--instrument", instrument, "--black-level", 200, "--sample", "mirror"]
    assert process("import", "--states", measured.states, *options)[0] == 0
    wrong = tmp_path / "wrong.yaml"
    wrong.write_text(instrument.read_text().replace("662: 94.78", "662: 91.0").replace("662: 13.41", "662: 12.0"))
    free = "psa_retarder.retardance_deg,psa_retarder.azimuth_deg"
    new = tmp_path / "new.yaml"
    command = ["calibrate", tmp_path / "states.h5", "--instrument", wrong, "--free", free, "--write", new]
    code, _, err = process(*command)
    assert (code, err) == (0, "")
    before, model = InstrumentModel.load(wrong), InstrumentModel.load(new)
    fitted = model.at(662).analyzer[0]
    assert fitted.retardance_deg == pytest.approx(94.78, abs=0.01)  # type: ignore[union-attr]
    assert fitted.azimuth_deg == pytest.approx(13.41, abs=0.01)
    assert model.at(451).generator == before.at(451).generator
    assert "is not replaced" in process.refused(*command)


def test_frames_that_do_not_fit(measured: Measured, instrument: Path, process: Run, tmp_path: Path) -> None:
    options = ["--states", measured.states, "--wavelength-nm", 662, "--instrument", instrument]
    cv2.imwrite(str(tmp_path / "f3.png"), np.zeros((9, 12), np.uint16))
    err = process.refused("import", *options)
    assert "states.csv:5: f3.png is 12 x 9 uint16, but the first frame is 12 x 8 uint16" in err
    (tmp_path / "f3.png").write_bytes(b"not an image")
    assert "f3.png: is not an image" in process.refused("import", *options)
    assert not list(tmp_path.glob("*.h5*"))
    np.save(tmp_path / "s.npy", measured.frames[:39])
    assert "exactly one of" in process.refused("import", *options, "--stack", tmp_path / "s.npy")
    measured.write([line.rsplit(",", 1)[0] for line in measured.lines])
    err = process.refused("import", *options, "--stack", tmp_path / "s.npy")
    assert "shape (39, 8, 12)" in err
    assert "(40, rows, columns)" in err


def test_bad_options(measured: Measured, instrument: Path, process: Run, tmp_path: Path) -> None:
    options = ["--states", measured.states, "--instrument", instrument]
    err = process.refused("import", *options, "--wavelength-nm", 700)
    assert "is given at 451, 524, 662, 947 nm; asked for 700 nm" in err
    err = process.refused("import", *options, "--wavelength-nm", 662, "--sample", "glass")
    assert "--sample glass: neither air, mirror, unknown" in err
    assert "give --sample unknown, and its name with --title" in " ".join(err.split())
    process.refused("import", *options, "--wavelength-nm", 662, "--gain-e-per-count", -1)
    broken = tmp_path / "broken.yaml"
    broken.write_text(instrument.read_text().replace("analyzer:", "anlyzer:"), encoding="utf-8")
    err = process.refused("import", "--states", measured.states, "--wavelength-nm", 662, "--instrument", broken)
    assert "broken.yaml:" in err
    assert "unknown key" in err


def test_bad_captures(measured: Measured, instrument: Path, process: Run, tmp_path: Path) -> None:
    assert "no such file" in process.refused("reduce", tmp_path / "none.h5")
    assert process("import", "--states", measured.states, "--wavelength-nm", 662)[0] == 0
    capture = tmp_path / "states.h5"
    assert "holds no instrument model. Give one with --instrument" in process.refused("reduce", capture)
    truncated = tmp_path / "truncated.h5"
    truncated.write_bytes(capture.read_bytes()[:3000])
    assert "truncated" in process.refused("reduce", truncated)
    foreign = tmp_path / "other.h5"
    with h5py.File(foreign, "w") as h5:
        h5["x"] = 1
    assert "no umov capture" in process.refused("reduce", foreign)
    before = sorted(tmp_path.iterdir())
    line = measured.lines
    measured.write(line[:11])
    assert process("import", "--states", measured.states, "--wavelength-nm", 662, "--overwrite")[0] == 0
    code, _, err = process("reduce", capture, "--instrument", instrument)
    assert code == 1
    assert "rank 10, and 16 are needed" in err
    assert sorted(tmp_path.iterdir()) == before


def test_noise_options_of_reduce(measured: Measured, tmp_path: Path, instrument: Path, process: Run) -> None:
    options = ["--wavelength-nm", 662, "--instrument", instrument, "--black-level", 200]
    assert process("import", "--states", measured.states, *options)[0] == 0
    capture = tmp_path / "states.h5"
    assert "this capture does not know its gain" in process.refused("reduce", capture, "--weighted")
    assert "none of nearest, likelihood" in process.refused("reduce", capture, "--physical", "closest")
    assert "is not a mosaic capture" in process.refused("reduce", capture, "--demosaic", "bilinear")
    assert "is not a product of `process`" in process.refused("reduce", capture, "--camera", capture)
    noise = ["--gain-e-per-count", 0.5, "--read-noise-e", 2, "--overwrite"]
    assert process("import", "--states", measured.states, *options, *noise)[0] == 0
    extra = ["--weighted", "--covariance", "--physical", "likelihood", "--no-figure"]
    code, out, err = process("reduce", capture, *extra)
    assert (code, "the residual is only" in err) == (0, True)
    assert "weighted: yes" in out
    assert "physical estimate: likelihood" in out
    with Product(tmp_path / "states.mueller.h5") as product:
        assert {"mueller", "mueller_physical", "mueller_covariance"} <= set(product.names)
        assert product.steps[0].arguments["weighted"] is True
        assert [Path(i["path"]).name for i in product.steps[0].inputs] == ["states.h5"]


def test_camera_of_a_capture_without_repeats(measured: Measured, instrument: Path, process: Run) -> None:
    options = ["--wavelength-nm", 662, "--instrument", instrument]
    assert process("import", "--states", measured.states, *options)[0] == 0
    assert "no dark states" in process.refused("camera", measured.folder / "states.h5")


@pytest.mark.usefixtures("figures")
def test_xi0_reduces_first_and_reuses_the_product(
    measured: Measured, tmp_path: Path, instrument: Path, process: Run
) -> None:
    noise = ["--black-level", 200, "--gain-e-per-count", 0.5, "--read-noise-e", 2]
    options = ["--wavelength-nm", 662, "--instrument", instrument, *noise]
    assert process("import", "--states", measured.states, *options)[0] == 0
    code, out, err = process("xi0", tmp_path / "states.h5", "--figure", tmp_path / "xi0.png")
    assert (code, "the residual is only" in err) == (0, True)
    assert (tmp_path / "xi0.png").stat().st_size > 10_000
    with Product(tmp_path / "states.xi0.h5") as product:
        assert [s.name for s in product.steps] == ["reduce", "xi0"]
        # A mirror has no depolarization; noise-free but for rounding, so every pixel is valid.
        assert np.all(product.get("valid") == 1)
        assert np.max(np.abs(product.get("xi0") - 1)) < 0.01
    code, out, err = process("xi0", tmp_path / "states.h5", "--overwrite", "--no-figure")
    assert code == 0
    assert "using" in out
    err = process.refused("xi0", tmp_path / "states.xi0.h5", "--out", tmp_path / "y.h5")
    assert "holds a xi0 image; this needs: mueller" in err


def test_instrument_of_another_wavelength(measured: Measured, tmp_path: Path, configs: Path, process: Run) -> None:
    assert process("import", "--states", measured.states, "--wavelength-nm", 662)[0] == 0
    imaging = configs / "instruments/drr_imaging_630nm.yaml"
    err = process.refused("reduce", tmp_path / "states.h5", "--instrument", imaging)
    assert "is given at 630 nm; asked for 662 nm" in err
