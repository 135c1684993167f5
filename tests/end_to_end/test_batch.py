"""Commands with several files and folders: one line each, nothing made twice, a failed one does not end the rest."""

import os
import re
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from processing.steps.reduction import Reduction
from processing.storage.products.product import Product

STATES, SHAPE = 24, (6, 8)


@pytest.fixture(scope="module")
def captures(captures_in, configs, tmp_path_factory) -> Path:
    """A folder with three captures: one_2, one_10 and `deeper/other`."""
    folder = tmp_path_factory.mktemp("lab") / "captures"
    (folder / "deeper").mkdir(parents=True)
    text = (configs / "instruments" / "drr_5to1.yaml").read_text()
    detector = {"gain_e_per_count": 2.5, "read_noise_e": 4.0, "bits": 12}
    psg, write = np.arange(STATES) * 7.5, captures_in(folder)
    for seed, name in enumerate(("one_2", "one_10", "deeper/other")):
        frames = np.random.default_rng(seed).integers(400, 3000, (STATES, 1, *SHAPE), dtype=np.uint16)
        write(frames, {"psg": psg, "psa": psg * 4.91}, name=f"{name}.h5", instrument_yaml=text, detector=detector)
    return folder


@pytest.fixture
def lab(captures, tmp_path) -> Path:
    """The captures in a folder of the test's own."""
    return Path(shutil.copytree(captures, tmp_path / "captures"))


@pytest.fixture
def process(process):
    """Runs `process ARGS`; returns exit code, lines of stdout, lines of stderr."""

    def run(*args: object) -> tuple[int, list[str], list[str]]:
        code, out, err = process(*args)
        return code, out.splitlines(), err.splitlines()

    return run


def results(lines: list[str]) -> list[tuple[str, str]]:
    """Result and file name of the lines of a batch."""
    matches = (re.match(r"(made|unchanged|failed) +(\S+)", line) for line in lines)
    return [(line[1], Path(line[2]).name) for line in matches if line]


@pytest.mark.parametrize(
    ("command", "kind", "options"),
    [
        ("reduce", "mueller.h5", ["--no-figure"]),
        ("xi0", "xi0.h5", ["--no-figure"]),
        ("export", "fits", ["--to", "fits"]),
    ],
)
def test_a_folder_twice_makes_nothing_twice(command, kind, options, lab, process):
    names = [f"{stem}.{kind}" for stem in ("one_2", "one_10", "other")]
    if command == "export":
        names = [name.replace(kind, f"mueller.{kind}") for name in names]
        process("reduce", lab, "--no-figure")
    code, out, _ = process(command, lab, *options)
    assert code == 0
    # In the order of a person: 2 before 10.
    assert sorted(results(out)) == sorted(("made", name) for name in names)
    assert [n for _, n in results(out) if n.startswith("one")] == names[:2]
    assert out[-1] == "3 inputs: 3 made, 0 unchanged, 0 failed"
    written = {path: path.stat().st_mtime_ns for path in lab.rglob("*.*")}
    os.utime(lab / "one_2.h5", (2e9, 2e9))
    written[lab / "one_2.h5"] = (lab / "one_2.h5").stat().st_mtime_ns
    code, out, _ = process(command, lab, *options)
    assert (code, out[-1]) == (0, "3 inputs: 0 made, 3 unchanged, 0 failed")
    assert {path: path.stat().st_mtime_ns for path in lab.rglob("*.*")} == written


def test_a_failed_file_is_reported_and_the_rest_is_done(lab, process):
    (lab / "one_3.h5").write_bytes((lab / "one_2.h5").read_bytes()[:5000])
    code, out, err = process("reduce", lab, lab / "none.h5", lab / "one_2.h5", "--no-figure")
    assert code == 2
    assert {name for _, name in results(out)} == {f"{stem}.mueller.h5" for stem in ("one_2", "one_10", "other")}
    assert out[-1] == "5 inputs: 3 made, 0 unchanged, 2 failed"
    failures = err[err.index("failed:") + 1 :]
    assert [Path(line.split()[0].rstrip(":")).name for line in failures] == ["one_3.h5", "none.h5"]
    (lab / "one_3.h5").unlink()
    code, out, _ = process("reduce", lab, "--no-figure")
    assert (code, out[-1]) == (0, "3 inputs: 0 made, 3 unchanged, 0 failed")


def test_the_exit_code_is_the_worst(lab, process, synthetic_capture):
    # Angles that all states share determine no Mueller matrix: exit code 1, not 2.
    blind = synthetic_capture(np.full((4, 1, *SHAPE), 900, np.uint16), {"psg": np.zeros(4), "psa": np.zeros(4)})
    alone = process("reduce", blind)[0]
    assert process("reduce", lab, blind, "--no-figure")[0] == alone != 0


def test_an_error_of_the_program_ends_only_its_own_file(lab, process, monkeypatch):
    record = Reduction.record

    def broken(self):
        if self.capture.name == "one_10.h5":
            raise ZeroDivisionError("division by zero")
        return record(self)

    monkeypatch.setattr(Reduction, "record", broken)
    code, out, err = process("reduce", lab, "--no-figure")
    assert (code, out[-1]) == (1, "3 inputs: 2 made, 0 unchanged, 1 failed")
    assert "one_10.h5: ZeroDivisionError: division by zero. This is a fault of the program" in err[-1]


def test_what_another_option_made_is_not_taken_for_it(lab, process):
    process("reduce", lab / "one_2.h5", "--weighted", "--no-figure")
    code, out, err = process("reduce", lab, "--no-figure")
    assert (code, out[-1]) == (2, "3 inputs: 2 made, 0 unchanged, 1 failed")
    assert "one_2.mueller.h5 exists" in err[-1]
    code, out, _ = process("reduce", lab, "--overwrite", "--no-figure")
    assert code == 0
    with Product(lab / "one_2.mueller.h5") as product:
        assert product.steps[-1].arguments["weighted"] is False


def test_a_capture_taken_again_is_reduced_again(lab, process):
    process("reduce", lab, "--no-figure")
    with h5py.File(lab / "one_10.h5", "r+") as h5:
        h5["entry/start_time"][...] = "2026-01-01T00:00:00+00:00"
    code, out, err = process("reduce", lab, "--no-figure")
    assert (code, out[-1]) == (2, "3 inputs: 0 made, 2 unchanged, 1 failed")
    assert "one_10.mueller.h5 exists" in err[-1]


def test_out_is_a_folder_for_several(lab, process, tmp_path):
    code, _, err = process("reduce", lab, "--out", tmp_path / "all.h5")
    assert (code, err) == (2, [f"error: --out {tmp_path}/all.h5: one file for 3 inputs. Give a folder: --out all"])
    code, _, err = process("reduce", lab, "--figure", tmp_path / "all.png")
    assert (code, "one file for 3 inputs" in err[0]) == (2, True)
    assert process("reduce", lab, "--out", tmp_path / "all", "--no-figure")[0] == 0
    assert len(list((tmp_path / "all").glob("*.mueller.h5"))) == 3
    assert process("reduce", lab / "one_2.h5", "--out", tmp_path / "all", "--no-figure")[1][-1].startswith("unchanged")
    shutil.copy(lab / "one_10.h5", lab / "deeper" / "one_2.h5")
    code, out, err = process("reduce", lab, "--out", tmp_path / "all", "--overwrite", "--no-figure")
    assert (code, out[-1]) == (2, "4 inputs: 3 made, 0 unchanged, 1 failed")
    assert "is that of" in err[-1]


def test_an_empty_folder_is_told(process, tmp_path):
    code, _, err = process("reduce", tmp_path)
    assert (code, err) == (2, [f"error: {tmp_path} holds no captures. Give files, or the folder that they are in."])


@pytest.mark.usefixtures("figures")
@pytest.mark.long
def test_a_missing_picture_is_drawn_again(lab, process):
    names = lab / "one_2.h5", lab / "one_10.h5"
    process("reduce", *names)
    before = (lab / "one_2.mueller.png").read_bytes()
    (lab / "one_2.mueller.png").unlink()
    assert process("reduce", *names)[1][-1] == "2 inputs: 0 made, 2 unchanged, 0 failed"
    assert (lab / "one_2.mueller.png").read_bytes() == before


def test_axostep_both_ways_twice(lab, process):
    process("reduce", lab, "--no-figure")
    for result in ("made", "unchanged"):
        code, out, _ = process("to-axostep", lab)
        assert (code, {r for r, _ in results(out)}) == (0, {result})
    for file in lab.rglob("*.mueller.h5"):
        file.unlink()
    for result in ("made", "unchanged"):
        code, out, _ = process("from-axostep", lab)
        assert (code, {r for r, _ in results(out)}) == (0, {result})


def test_colours_twice(synthetic_capture, process, tmp_path):
    colours = (("red", "red", "green", "green"),) * 2 + (("green", "green", "blue", "blue"),) * 2
    mosaic = (("90", "45"), ("135", "0"))
    for name in ("a", "b"):
        frames = np.random.default_rng(ord(name)).integers(0, 4000, (2, 1, 16, 16), dtype=np.uint16)
        capture = synthetic_capture(frames, {}, colours=colours, mosaic=mosaic)
        capture.rename(tmp_path / f"{name}.h5")
    for result in ("made", "unchanged"):
        code, out, _ = process("colours", tmp_path)
        assert (code, results(out)) == (0, [(result, "a.red.h5"), (result, "b.red.h5")])


def test_of_a_folder_the_products_with_a_plane_are_exported(lab, process):
    process("xi0", lab / "one_2.h5", "--no-figure")
    code, out, _ = process("export", lab, "--to", "csv", "--plane", "xi0")
    assert (code, [Path(line).name for line in out]) == (0, ["one_2.xi0.csv"])
    code, _, err = process("export", lab, "--to", "csv", "--plane", "nothing")
    assert (code, err) == (
        2,
        [f"error: {lab} holds no products with nothing. Give files, or the folder that they are in."],
    )
