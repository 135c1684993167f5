"""Slips of a user: a device that is not plugged in, names and files that are not meant so. One clear message each."""

import shutil
from pathlib import Path

import h5py
import pytest

from acquisition.commands.application import main as acquire_main
from processing.campaign.captures import find_captures
from processing.commands.application import main as process
from processing.commands.diagnose import main as diagnose
from tests.commands import exit_code
from tests.rig_files import change_yaml, write_rig


@pytest.fixture
def unplugged(small_rig):
    """A rig file whose arm is at a port that is not there."""
    return change_yaml(small_rig(), lambda rig: rig["axes"]["arm"].update(port="/dev/ttyUSB_none"))


@pytest.mark.parametrize("command", [("--omega", 35), ("home",), ("move", "psg", 10)])
def test_a_device_that_is_not_plugged_in_is_named(command, unplugged, acquire):
    code, _, err = acquire(*command, "--rig", unplugged)
    assert code == 1
    assert "axis arm, open port /dev/ttyUSB_none: there is no such port" in err
    assert "n/a" not in err


@pytest.fixture
def run(capfd):
    """Runs `process`; returns exit code and standard error."""

    def done(*arguments):
        return exit_code(process, *arguments), capfd.readouterr().err

    return done


@pytest.fixture(scope="module")
def simulated_capture(tmp_path_factory, configs):
    folder = tmp_path_factory.mktemp("taken")
    rig = write_rig(configs, folder / "rig.yaml")
    assert exit_code(acquire_main, "--omega", 35, "--rig", rig, "--out", folder) == 0
    (path,) = folder.glob("*omega35.h5")
    return path


@pytest.fixture
def capture(simulated_capture, tmp_path):
    """A capture that a test may lose, alone in its folder."""
    return Path(shutil.copy(simulated_capture, tmp_path))


def test_options_that_do_not_fit_are_told_before_the_work_and_not_passed_over(run, capture):
    code, err = run("quantities", capture, "--also", "symetric")
    assert code == 2
    assert "unknown decomposition 'symetric'; there are: symmetric, differential" in err
    # Nothing was reduced for nothing.
    assert not list(capture.parent.glob("*.mueller.h5"))
    code, err = run("xi0", capture, "--geometry", "no_such_file.yaml", "--no-figure")
    assert code == 0
    assert "holds whole Mueller matrices: --geometry and --material are not looked at" in err


def test_a_place_for_no_file_is_refused_before_the_work(acquire, small_rig, capture, configs, capfd):
    rig = small_rig()
    for place, words in ((capture, f"--out {capture} would be a folder"), (rig, f"{rig} is a file, and captures")):
        assert words in acquire.refused("--omega", 35, "--rig", rig, "--out", place)
    for command in (("snap", "--out", "no/frame.png"), ("init", "--out", "no/rig.yaml")):
        assert "there is no folder no. Make it" in acquire.refused(*command)
    instrument = configs / "instruments/rgb950.yaml"
    assert exit_code(diagnose, capture, "--instrument", instrument, "--write", "no/where.yaml") == 2
    message = "error: no/where.yaml: there is no folder no. Make it, or give another name.\n"
    assert capfd.readouterr() == ("", message)
    free = ("--free", "psa_retarder.retardance_deg", "--write", "no/where.yaml")
    assert exit_code(process, "calibrate", capture, "--instrument", instrument, *free) == 2
    # Not a word of the fit before.
    assert capfd.readouterr() == ("", message)


def test_another_camera_s_instrument_file_and_a_place_for_no_figure_are_named(run, capture, configs, tmp_path, capfd):
    """Frames of one camera were taken for those of a mosaic, or the command ended in a traceback."""
    files = configs / "instruments"
    for file, words in (
        (
            "linear_stokes.yaml",
            "its camera has no polarization mosaic, that of the instrument 'linear Stokes camera' a",
        ),
        (
            "drr_wollaston.yaml",
            "its frames have 1 channel, the instrument 'two quarter-wave plates and a Wollaston pri",
        ),
    ):
        for command in (
            ("reduce", capture, "--out", tmp_path / "no.h5"),
            ("calibrate", capture, "--free", "any.thing"),
        ):
            code, err = run(*command, "--instrument", files / file)
            assert (code, words in err, err.count("\n")) == (2, True, 1), err
        assert exit_code(diagnose, capture, "--instrument", files / file) == 2
        assert words in capfd.readouterr().err
    # Neither is there a product where its figure could not be drawn.
    for figure in ("no/where.png", "figure.docx"):
        code, err = run("reduce", capture, "--out", tmp_path / "no.h5", "--figure", tmp_path / figure)
        assert (code, err.count("\n")) == (2, 1)
    assert not (tmp_path / "no.h5").exists()


def test_what_was_measured_is_never_replaced(run, capture, tmp_path):
    """`--overwrite` is for what can be made again: a reduction with the wrong --out took its capture's place."""
    raw = capture.read_bytes()
    second = tmp_path / "other.h5"
    second.write_bytes(raw)
    assert run("reduce", capture, "--out", tmp_path / "m.h5", "--no-figure") == (0, "")
    for command in (("reduce", capture), ("xi0", tmp_path / "m.h5"), ("report", tmp_path / "m.h5")):
        for out in (capture, second):
            code, err = run(*command, "--out", out, "--overwrite")
            assert (code, f"{out} is a capture, and is not replaced" in err) == (2, True), err
    assert capture.read_bytes() == second.read_bytes() == raw
    # A product still is.
    assert run("reduce", capture, "--out", tmp_path / "m.h5", "--no-figure", "--overwrite") == (0, "")


def test_a_table_of_the_user_is_not_replaced_by_a_design(run, configs, tmp_path):
    table = tmp_path / "mine.csv"
    table.write_text("psg,psa\n0,0\n")
    instrument = configs / "instruments/rgb950.yaml"
    code, err = run("design", instrument, "--wavelength", 662, "--out", table)
    assert (code, f"{table} exists and is not replaced" in err) == (2, True)
    assert table.read_text() == "psg,psa\n0,0\n"


def test_a_file_that_is_not_meant_is_called_what_it_is(run, acquire, capture, configs, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text, folder, product = tmp_path / "notes.txt", tmp_path / "empty", tmp_path / "näme with blanks.h5"
    text.write_text("notes")
    folder.mkdir()
    assert run("reduce", capture, "--out", product, "--no-figure") == (0, "")
    rig = configs / "rigs/simulated.yaml"
    for arguments, words in (
        (("reduce", product), "is a product of `process`, and a capture is asked for"),
        (("reduce", text), "cannot be opened as HDF5: it is of another kind"),
        (("reduce", folder), "holds no captures. Give files, or the folder that they are in"),
        (("reduce", capture, "--instrument", rig), "kind: must be 'instrument', not 'rig'; is it the right file?"),
        (("reduce", capture, "--instrument", capture), "a file of this kind at most"),
        (("export", product, "--to", "png", "--out", "no/where"), "there is no folder no. Make it"),
        (("xi0", product, "--out", "no/where.h5"), "there is no folder no. Make it"),
        (("xi0", product, "--out", "xi0.png"), "what this makes is an HDF5 file; give a name that ends in .h5"),
    ):
        code, err = run(*arguments)
        assert (code, words in err) == (2, True), err
        assert err.count("\n") == 1
    # Products and tables lie beside captures; none is a damaged capture.
    with h5py.File(tmp_path / "table.h5", "w") as h5:
        h5.attrs["umov_table"] = 1
    captures, _, left_out, damaged = find_captures(tmp_path)
    assert ([path for path, *_ in captures], left_out, damaged) == ([capture], [], [])
    for command in ("verify", "repair"):
        code, out, err = acquire(command, tmp_path)
        assert (code, err) == (0, "")
        assert product.name not in out
        assert "table.h5" not in out
        assert "there is no capture in this folder" in acquire.refused(command, folder)
