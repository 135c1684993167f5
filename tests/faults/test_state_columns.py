"""Columns of states.csv: the noise stated for each state, and names that nobody knows."""

from dataclasses import replace

import numpy as np
import pytest

from processing.diagnosis.captures.read_capture import read_capture
from processing.instrument.model import InstrumentModel
from processing.reduction.mueller import reduce_mueller
from processing.reduction.mueller_reduction import Choice
from processing.storage.captures.capture import Capture
from processing.storage.formats.foreign_arrays import ImportFailed
from processing.storage.formats.import_request import ImportRequest
from processing.storage.formats.importing import import_capture
from processing.storage.formats.state_csv import read_states
from processing.storage.products.images import MuellerImage

HEAD = "state,psg_deg,channel_left,channel_right"


def written(folder, head, rows):
    path = folder / "states.csv"
    path.write_text("\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


def test_noise_of_each_state_is_what_the_file_says(tmp_path, configs):
    rows = [f"{k},{4 * k},{1000 + k},{500 + 3 * k},{2 + k}" for k in range(46)]
    instrument = configs / "instruments/drr_wollaston.yaml"
    out = tmp_path / "c.h5"
    import_capture(ImportRequest(written(tmp_path, HEAD + ",sigma", rows), out, 1200, instrument=instrument))
    with Capture(out) as capture:
        assert capture.sigma == pytest.approx(2.0 + np.arange(46))
        data = read_capture(capture, InstrumentModel.load(instrument).at(1200))
    assert data.noise_known
    full_scale = data.conditions.full_scale
    assert np.sqrt(data.variance()[:, 1, 0, 0]) * full_scale == pytest.approx(2.0 + np.arange(46))


def test_a_reduction_weighs_and_tells_errors_by_the_noise_that_is_stated(tmp_path, configs):
    """Elements scatter by their errors over many captures of which half of the states are ten times as noisy."""
    instrument, random = configs / "instruments/drr_wollaston.yaml", np.random.default_rng(3)
    psg = 4.0 * np.arange(46)
    model = InstrumentModel.load(instrument).nominal_at(1200)
    w = model.rows({"psg": psg}).reshape(46, 2, 16)
    light = 1000 * w @ np.eye(4).reshape(16)
    sigma = np.where(np.arange(46) % 2, 1.0, 10.0)
    images = []
    for k in range(12):
        noisy = light + sigma[:, None] * random.standard_normal(light.shape)
        rows = [f"{n},{psg[n]},{a},{b},{sigma[n]}" for n, (a, b) in enumerate(noisy)]
        out = tmp_path / f"c{k}.h5"
        import_capture(ImportRequest(written(tmp_path, HEAD + ",sigma", rows), out, 1200, instrument=instrument))
        for weighted in (False, True):
            product = tmp_path / f"m{k}{weighted}.h5"
            with Capture(out) as capture:
                reduce_mueller(capture, model, product, (), choice=Choice(weighted=weighted))
            images.append(MuellerImage.load(product))
    for weighted in (False, True):
        matrices, errors = ([getattr(i, name)[..., 0, 0] for i in images[weighted::2]] for name in ("values", "errors"))
        assert "sigma" in images[weighted].facts["noise"]
        pull = (np.array(matrices) - 1000 * np.eye(4)) / np.array(errors)
        assert np.sqrt(np.mean(pull**2)) == pytest.approx(1.0, abs=0.25)
        # Weights use the precise half; without them the noisy half decides.
        assert (errors[0].max() < 12.0) == weighted


def test_a_capture_without_stated_noise_has_none(tmp_path):
    out = tmp_path / "c.h5"
    import_capture(ImportRequest(written(tmp_path, HEAD, ["0,0,1.0,2.0", "1,4,1.5,2.5"]), out, 1200))
    with Capture(out) as capture:
        assert capture.sigma is None


@pytest.mark.parametrize("value", ["0", "-1"])
def test_noise_is_above_zero(tmp_path, value):
    path = written(tmp_path, HEAD + ",sigma", ["0,0,1,2,1", f"1,4,1,2,{value}"])
    with pytest.raises(ImportFailed, match=r"states.csv:3: column sigma"):
        read_states(path, ("psg",))


@pytest.mark.parametrize("column", ["exposure", "stderr", "psa", "temperature_c"])
def test_an_unknown_column_is_refused(tmp_path, column):
    path = written(tmp_path, f"{HEAD},{column}", ["0,0,1,2,1", "1,4,1,2,1"])
    with pytest.raises(ImportFailed, match=f"unknown column {column}"):
        read_states(path, ("psg",))


def test_axes_may_be_called_by_their_bare_name_where_the_instrument_has_them(tmp_path):
    path = written(tmp_path, "state,psg,stage_deg,channel_left", ["0,0,1,2", "1,4,1,2"])
    assert set(read_states(path, ("psg",)).angles_deg) == {"psg", "stage"}


ANALYZER = ("state", "psa_deg", "channel_camera")


def spreadsheet(folder, delimiter, numbers):
    """A states file as a spreadsheet saves it, byte order mark and all."""
    lines = [delimiter.join(ANALYZER), *(delimiter.join(row) for row in numbers)]
    path = folder / "states.csv"
    path.write_bytes("\r\n".join([*lines, ""]).encode("utf-8-sig"))
    return path


@pytest.mark.parametrize("delimiter", [";", "\t", ","])
def test_states_as_spreadsheets_save_them(tmp_path, delimiter):
    numbers = [("0", "-7.5", "1000.25"), ("1", "372.5", "900")]
    if delimiter == ";":
        numbers = [tuple(text.replace(".", ",") for text in row) for row in numbers]
    states = read_states(spreadsheet(tmp_path, delimiter, numbers), ["psa"])
    assert states.angles_deg["psa"].tolist() == [-7.5, 372.5]
    assert states.channels["camera"].tolist() == [1000.25, 900.0]


@pytest.mark.parametrize(("delimiter", "angle", "cell"), [(";", "7,5", "1.000"), ("\t", "7,5", "1.000")])
def test_a_number_that_could_be_two_is_refused(tmp_path, delimiter, angle, cell):
    path = spreadsheet(tmp_path, delimiter, [("0", angle, "3"), ("1", "15", cell)])
    with pytest.raises(ImportFailed, match=f"states.csv:3: column channel_camera: '{cell}' is not a finite number"):
        read_states(path, ["psa"])


def test_angles_that_are_probably_radians_are_refused_until_the_unit_is_given(tmp_path):
    degrees = np.arange(0.0, 360.0, 15.0)
    numbers = [(str(k), f"{angle:.6f}", "1000") for k, angle in enumerate(np.deg2rad(degrees))]
    request = ImportRequest(spreadsheet(tmp_path, ",", numbers), tmp_path / "c.h5", 550)
    with pytest.raises(ImportFailed, match=r"axis psa turns by 6\.02 degrees.*--angles radians"):
        import_capture(request)
    import_capture(replace(request, angles="radians"))
    with Capture(tmp_path / "c.h5") as capture:
        assert capture.angles_deg["psa"] == pytest.approx(degrees, abs=1e-4)


@pytest.mark.parametrize("wavelength", [0.532, 5.32e-7])
def test_a_wavelength_in_another_unit_is_refused_with_the_number_in_nm(tmp_path, wavelength):
    with pytest.raises(ImportFailed, match="--wavelength-nm 532"):
        import_capture(ImportRequest(tmp_path / "states.csv", tmp_path / "c.h5", wavelength))


def test_frames_may_be_npy_files(tmp_path):
    frames = np.random.default_rng(1).normal(1000, 5, (3, 4, 5))
    for k, frame in enumerate(frames):
        np.save(tmp_path / f"{k}.npy", frame)
    path = written(tmp_path, "state,psa_deg,file", [f"{k},{30 * k},{k}.npy" for k in range(3)])
    import_capture(ImportRequest(path, tmp_path / "c.h5", 550))
    with Capture(tmp_path / "c.h5") as capture:
        assert np.array_equal([capture.frames(k)[0] for k in range(3)], frames)
    np.save(tmp_path / "0.npy", frames)
    with pytest.raises(ImportFailed, match=r"0.npy: shape \(3, 4, 5\); a frame has rows and columns"):
        import_capture(ImportRequest(path, tmp_path / "d.h5", 550))
