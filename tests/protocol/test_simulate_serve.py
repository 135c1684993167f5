"""The `simulate serve` command as somebody else's client meets it."""

import contextlib
import signal
import subprocess
import sys

import pytest

from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import FastClock, patient_clock
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.serve_options import ServeOptions

SERVE = [sys.executable, "-c", "from simulators.cli import main; main()", "serve"]
KINDS = ["elliptec", "zaber", "apt-k10cr1", "apt-kdc101", "smc100", "esp301"]


def test_first_line_is_the_port_and_sigterm_ends_it() -> None:
    with contextlib.ExitStack() as stack:
        served = {
            kind: stack.enter_context(subprocess.Popen([*SERVE, kind, "--homed"], stdout=subprocess.PIPE, text=True))
            for kind in KINDS
        }
        for kind, process in served.items():
            assert process.stdout is not None
            path = process.stdout.readline().strip()
            emulator = served_kinds()[kind](ServeOptions())
            with LineRegistry(clock=patient_clock()) as lines:
                axis = open_axis("axis", axis_configs(emulator, path, homed=True)[0], lines)
                assert axis.is_homed()
                # A full turn takes 1 to 2 seconds.
                assert 1.0 <= axis.move_time_s(360.0) <= 2.0
            process.send_signal(signal.SIGTERM)
        assert {kind: process.wait() for kind, process in served.items()} == dict.fromkeys(KINDS, 0)


def test_options_reach_the_emulator() -> None:
    command = [*SERVE, "smc100", "--limits", "-5:95", "--speed", "10", "--axes", "2", "--model", "CONEX-CC"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        path = process.stdout.readline().strip()
        emulator = served_kinds()["smc100"](ServeOptions(axes=2))
        with LineRegistry(clock=patient_clock()) as lines:
            axis = open_axis("arm", axis_configs(emulator, path)[1], lines)
            assert (axis.limits.min_deg, axis.limits.max_deg, axis.speed_deg_s) == (-5.0, 95.0, 10.0)
            assert axis.describe().model.startswith("CONEX-CC")
            assert not axis.is_homed()
        process.terminate()
        assert process.wait() == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["teapot"], "no controller"),
        (["zaber", "--fault", "loud"], "expected"),
        (["zaber", "--limits", "7"], "MIN:MAX"),
        (["zaber", "--limits", "7:3"], "lower limit"),
        (["elliptec", "--model", "K10CR1"], "ELL14"),
        (["apt-k10cr1", "--axes", "2"], "one axis"),
    ],
)
def test_wrong_options_are_explained(arguments: list[str], message: str) -> None:
    from typer.testing import CliRunner

    from simulators.cli import app

    before = signal.getsignal(signal.SIGINT)
    result = CliRunner().invoke(app, ["serve", *arguments])
    assert result.exit_code == 2
    # Ctrl-C means what it meant: otherwise every later test in this process is deaf to it.
    assert signal.getsignal(signal.SIGINT) is before
    assert message in result.output.replace("\n", " ")


def test_defaults_are_those_that_the_documentation_names() -> None:
    options = ServeOptions(clock=FastClock(base=patient_clock()))
    zaber = served_kinds()["zaber"](options)
    assert [(axis.min_deg, axis.max_deg) for axis in zaber.axes] == [(None, None), (None, None), (0.0, 190.0)]
    assert not any(axis.homed for axis in zaber.axes)
    assert [module.address for module in served_kinds()["elliptec"](options).modules] == ["0", "1"]  # type: ignore[attr-defined]
    arm = served_kinds()["smc100"](options)
    assert [(axis.min_deg, axis.max_deg) for axis in arm.axes] == [(0.0, 180.0)]
    esp = served_kinds()["esp301"](options)
    assert len(esp.axes) == 2
    assert all(axis.max_deg is not None and axis.max_deg >= 90 for axis in esp.axes)
