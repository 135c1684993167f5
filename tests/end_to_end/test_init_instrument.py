"""`process init`: answers to ten questions become an instrument file that the other commands take."""

import pytest
from typer.testing import CliRunner

from processing.commands.application import app
from processing.instrument.model import InstrumentModel


def answered(path, *answers):
    """Output of the command, and the model in its file."""
    result = CliRunner().invoke(app, ["init", "instrument", "--out", str(path)], input="\n".join(answers) + "\n")
    assert result.exit_code == 0, result.output
    return result.output, InstrumentModel.load(path)


@pytest.mark.parametrize(
    ("generator", "analyzer", "determined"),
    [
        ("1", "3", "m00, m10, m20, m30"),
        ("1", "2", "m00, m10, m20"),
        ("1", "5", "m00, m10, m20, m30"),
        ("3", "2", "m00, m01, m02, m10, m11, m12, m20, m21, m22"),
        ("4", "3", ", ".join(f"m{i}{j}" for i in range(4) for j in range(4))),
        ("4", "4", ", ".join(f"m{i}{j}" for i in range(3) for j in range(4))),
    ],
)
def test_the_answers_determine_the_elements_of_that_polarimeter(generator, analyzer, determined, tmp_path):
    answers = ["my lab", "532"]
    # A polarizer has an azimuth, what turns has an axis, a retarder has a retardance.
    answers += {"1": [generator], "3": [generator, "0", ""], "4": [generator, "0", "", ""]}[generator]
    answers += [analyzer, *{"2": ["0", ""], "3": ["0", "", "85"], "4": [], "5": ["", "85"]}[analyzer]]
    output, model = answered(tmp_path / "mine.yaml", *answers)
    assert f"it determines {determined}\n" in output
    assert f"process import --instrument {tmp_path / 'mine.yaml'}" in output
    assert model.name == "my lab"
    if analyzer in ("3", "5"):
        assert model.value_of("psa_retarder.retardance_deg") == 85
        assert "psa_retarder.retardance_deg" in model.calibrate


def test_a_wrong_answer_is_asked_again_and_an_axis_has_its_name(tmp_path):
    output, model = answered(tmp_path / "m.yaml", "", "green", "532", "9", "1", "3", "", 'my "motor"', "ninety", "90")
    assert "'green' is no number." in output
    assert "'9' is none of 1 to 4." in output
    assert "'ninety' is no number." in output
    assert model.axes == ('my "motor"',)


def test_a_file_that_exists_is_kept(tmp_path, process):
    path = tmp_path / "m.yaml"
    path.write_text("mine")
    code, _, err = process("init", "instrument", "--out", path)
    assert (code, path.read_text()) == (2, "mine"), err
