"""Every example and notebook runs as it stands."""

import json
import re
import runpy
from pathlib import Path

import h5py
import pytest

from processing.diagnosis.instrument.diagnose import diagnose_captures

NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")
EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def test_all_of_the_gallery_is_here():
    # other_lab prints nothing: test_foreign_data.py runs it and imports what it writes.
    assert {f.stem for f in EXAMPLES.glob("*.py")} == {*SAID, "other_lab"}
    assert {f.stem for f in EXAMPLES.glob("*.ipynb")} == {"capture_to_xi0", "close_the_loop"}


#: Words that each script must have printed when it is done.
SAID = {
    "take_a_capture": "median reduced chi square",
    "from_simulated_bench": "median xi0",
    "close_the_loop": "corrected: rms of",
    "design_states": "free angles:     71.4",
    "algebra": "and its process is the retarder: True",
}
LONG = {"close_the_loop", "design_states"}


@pytest.fixture(scope="module")
def answer():
    """The diagnosis of a capture by its frames: the script and the notebook make the same."""
    answers = {}

    def diagnose(captures, instrument):
        with h5py.File(captures[0]) as h5:
            asked = h5["entry/instrument/detector/data"][...].tobytes(), instrument.model_dump_json()
        if asked not in answers:
            answers[asked] = diagnose_captures(captures, instrument)
        return answers[asked]

    return diagnose


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] if name in LONG else []) for name in SAID]
)
def test_script(name, tmp_path, monkeypatch, capsys, small_rig, default_rig, answer):
    monkeypatch.setattr("processing.diagnose_captures", answer)
    monkeypatch.setattr("sys.argv", [name, str(tmp_path)])
    monkeypatch.chdir(tmp_path)
    # The rig of the examples has 360 000 pixels at a tenth of real time.
    default_rig(small_rig())
    runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
    text = capsys.readouterr().out
    assert SAID[name] in text
    if name == "close_the_loop":
        before, after = (float(line.split()[-1]) for line in text.splitlines()[-2:])
        assert after < 0.7 * before


@pytest.mark.parametrize("name", ["capture_to_xi0", pytest.param("close_the_loop", marks=pytest.mark.long)])
def test_notebook(name, capsys, monkeypatch, answer):
    monkeypatch.setattr("processing.diagnose_captures", answer)
    monkeypatch.setenv("MPLBACKEND", "agg")
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text())["cells"]
    scope: dict[str, object] = {}
    capsys.readouterr()
    for cell in cells:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), f"{name}.ipynb", "exec"), scope)
            stored = "".join(line for o in cell["outputs"] if o["output_type"] == "stream" for line in o["text"])
            text = capsys.readouterr().out
            # The last digits are those of the processor.
            assert NUMBER.split(text) == NUMBER.split(stored)
            assert [*map(float, NUMBER.findall(text))] == pytest.approx([*map(float, NUMBER.findall(stored))], rel=0.05)
    assert any(cell.get("outputs") for cell in cells)
