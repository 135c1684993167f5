"""One look of the five commands: -h and --help everywhere, --version, completion."""

import re
from importlib.metadata import version

import pytest
from typer.testing import CliRunner

from acquisition.commands.application import app as acquire
from acquisition.commands.public_data import app as data
from processing.commands.application import app as process
from processing.commands.command_line import application, run
from processing.commands.diagnose import app as diagnose
from processing.commands.program import main as umov
from simulators.cli import app as simulate
from tests.commands import exit_code
from viewer.command import app as view

COMMANDS = {
    "acquire": acquire,
    "process": process,
    "diagnose": diagnose,
    "simulate": simulate,
    "view": view,
    "data": data,
}


@pytest.mark.parametrize("name", COMMANDS)
def test_version_and_help(name):
    run = CliRunner().invoke
    assert run(COMMANDS[name], ["--version"]).output == f"umov {version('umov')}\n"
    short, long = (run(COMMANDS[name], [option], prog_name=name) for option in ("-h", "--help"))
    assert short.exit_code == long.exit_code == 0
    assert short.output == long.output
    assert short.output.startswith(f"Usage: {name} ")
    assert "--show-completion" in short.output


@pytest.mark.parametrize(
    ("name", "command"),
    [
        (name, command.name or command.callback.__name__)
        for name, app in COMMANDS.items()
        for command in app.registered_commands
        if name not in ("diagnose", "view")
    ],
)
def test_every_command_has_short_help(name, command):
    done = CliRunner().invoke(COMMANDS[name], [command, "-h"], prog_name=name)
    assert done.exit_code == 0
    assert f"Usage: {name} {command}" in done.output


@pytest.mark.parametrize(
    ("name", "words", "message"),
    [
        ("acquire", "--omega 35deg", "--omega 35deg: must be a valid number (angle between source and camera, "),
        ("acquire", "move psg ten", "degrees ten: must be a valid number"),
        ("process", "design rig.yaml --wavelength red", "--wavelength red: must be a valid number"),
        ("simulate", "serve zaber --axes two", "--axes two: must be a valid integer"),
        ("simulate", "serve zaber --limits 7", "'7' is not MIN:MAX in degrees"),
        ("view", "--port eighty", "--port eighty: must be a valid integer"),
        ("diagnose", "", "Missing argument 'captures'"),
        ("process", "reduce a.h5 --wieghted", "No such option: --wieghted (Possible options: "),
        ("acquire", "fly", "No such command 'fly'"),
        ("process", "reduc a.h5", "Did you mean 'reduce'? More: "),
    ],
)
def test_a_wrong_option_is_told_as_every_mistake(name, words, message, capsys):
    assert exit_code(COMMANDS[name], *words.split()) == 2
    streams = capsys.readouterr()
    assert not streams.out
    assert streams.err.startswith("error: ")
    assert message in streams.err
    assert re.search(r"[\w)'][.?] More: \S+.* -h$", streams.err.strip())
    assert "Input should" not in streams.err


def test_ctrl_c_is_answered(capfd):
    """Typer ends a program that is interrupted without a word."""
    app = application("sample", "A command that somebody interrupts.")

    @app.command()
    def wait() -> None:
        raise KeyboardInterrupt

    with pytest.raises(SystemExit) as end:
        run(app, [])
    assert end.value.code == 130
    assert capfd.readouterr().err == "interrupted; nothing that was finished is lost\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_umov_has_every_command(name, capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["umov"])
    monkeypatch.setenv("UMOV_DOOR", "")
    for words, answer in (([name, "-h"], f"umov {name} [OPTIONS]"), ([name, "--version"], f"umov {version('umov')}")):
        assert exit_code(umov, *words) == 0
        assert answer in capsys.readouterr().out


def test_umov_needs_no_process_before_a_command_of_it(capsys, monkeypatch):
    monkeypatch.setattr("sys.argv", ["umov"])
    monkeypatch.setenv("UMOV_DOOR", "")
    assert exit_code(umov, "check", "-h") == 0
    assert "umov process check" in capsys.readouterr().out


def test_umov_lists_its_commands(capsys):
    for words, code in (([], 2), (["-h"], 0), (["fly"], 2)):
        assert exit_code(umov, *words) == code
        streams = capsys.readouterr()
        assert all(name in streams.out + streams.err for name in COMMANDS)
