"""A liquid-crystal retarder: bytes, what an axis owes, and a capture of named states in volts."""

import pickle
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquisition.commands.doctor import describe_axis
from drivers.errors import CommandRejected, DeviceError, LimitError, MotionFailed, ReplyTimeout
from processing.labelled import open_dataset
from processing.labelled_file import write_dataset
from simulators.clock import FastClock
from simulators.conformance.axis_faults import AxisFaults
from simulators.conformance.axis_lines import SerialPortConformance
from simulators.conformance.axis_noise import EmulatorNoise
from simulators.controllers.lcc25 import make
from simulators.serial.reply_faults import Fault
from simulators.serial.serve_options import ServeOptions
from tests.rig_files import change_yaml

VOLTS = {"low": 1.2, "quarter": 1.53, "half": 2.2, "high": 9.0}


def test_bytes_of_the_controller() -> None:
    emulator = make(ServeOptions(clock=FastClock(instant=True)))
    for request, reply, volts in (
        (b"*idn?\r", b"*idn?\rTHORLABS LCC25 VERSION 1.05\r> ", 0.0),
        (b"volt1?\r", b"volt1?\r5.000\r> ", 0.0),
        (b"volt1=1.53\r", b"volt1=1.53\r> ", 0.0),
        (b"enable=1\r", b"enable=1\r> ", 1.53),
        (b"volt1?\r", b"volt1?\r1.530\r> ", 1.53),
        (b"volt1=26\r", b"volt1=26\rCommand error CMD_ARG_INVALID\r> ", 1.53),
        (b"volt2=4\r", b"volt2=4\r> ", 1.53),
        (b"mode=2\r", b"mode=2\r> ", 4.0),
        (b"mode?\r", b"mode?\r2\r> ", 4.0),
        (b"freq=60.0\r", b"freq=60.0\r> ", 4.0),
        (b"freq=4\r", b"freq=4\rCommand error CMD_ARG_INVALID\r> ", 4.0),
        (b"\r", b"\rCommand error CMD_NOT_DEFINED\r> ", 4.0),
        (b"volt3?\r", b"volt3?\rCommand error CMD_NOT_DEFINED\r> ", 4.0),
    ):
        emulator.receive(request)
        assert (emulator.take_output(), emulator.true_deg()) == (reply, volts)


class TestLCC25(EmulatorNoise):
    emulator = "lcc25"

    test_another_device_is_refused = AxisFaults.test_another_device_than_the_rig_file_names_is_refused
    test_a_port_that_vanishes = AxisFaults.test_a_port_that_vanishes_and_one_that_is_not_there
    test_one_late_answer_spoils_no_opening = AxisFaults.test_one_late_answer_spoils_no_opening
    test_a_held_port_is_refused = SerialPortConformance.test_a_port_that_another_program_holds_is_refused_by_name

    def test_opening_changes_nothing_and_voltages_are_read_back(self) -> None:
        with self.served("lcc25") as served:
            before = dict(served.emulator.values)  # type: ignore[attr-defined]
            axis = served.open(states=VOLTS)
            assert (axis.read_position().deg, axis.is_homed(), axis.warnings()) == (0.0, True, ["its output is off"])
            assert served.emulator.values == before  # type: ignore[attr-defined]
            for volts in (1.53, 25.0, 0.0, 2.2):
                position = axis.start_move(volts).wait()
                assert (position.deg, served.emulator.true_deg()) == (volts, volts)
            assert axis.config.named_states() == VOLTS
            assert axis.home().wait().deg == 2.2
            assert axis.warnings() == []
            assert describe_axis(axis).endswith(": at 2.2000 V, limits 0 to 25")

    def test_limits_are_volts_and_refused_without_a_byte(self) -> None:
        with self.served("lcc25") as served:
            axis = served.open(limits_deg=(0.5, 10.0))
            before = served.emulator.faults.commands
            for volts in (0.4, 10.1, 26.0):
                with pytest.raises(LimitError, match=r"limits are 0\.5 to 10 V"):
                    axis.start_move(volts)
            assert served.emulator.faults.commands == before

    @pytest.mark.parametrize("fault", ["garbled", "late", "foreign", "silent"])
    def test_a_passing_fault_never_gives_a_wrong_voltage(self, fault: str) -> None:
        right = 0
        with self.served("lcc25") as served:
            # A busy machine takes a tenth of a second for an answer of its own.
            axis = served.open(reply_s=0.5, margin_s=10.0)
            for place in range(1, 13):
                served.emulator.faults.add(Fault(fault, from_command=place, commands=1, amount=0.65))  # type: ignore[arg-type]
                try:
                    position = axis.start_move(0.5 * place).wait()
                except DeviceError:
                    continue
                finally:
                    served.emulator.faults.clear()
                right += 1
                assert (position.deg, served.emulator.true_deg()) == (0.5 * place, 0.5 * place)
        assert right >= 8

    def test_a_silent_controller_and_one_that_alternates_are_errors(self) -> None:
        with self.served("lcc25") as served:
            axis = served.open(reply_s=0.1)
            axis.start_move(2.0).wait()
            served.emulator.receive(b"mode=0\r")
            with pytest.raises(CommandRejected, match=r"changes between two voltages\. Choose Voltage 1"):
                axis.read_position()
            served.emulator.receive(b"mode=1\r")
            served.emulator.faults.add(Fault("silent"))
            with pytest.raises(ReplyTimeout, match="no reply"):
                axis.read_position()

    def test_an_output_that_somebody_switches_off_ends_the_move(self) -> None:
        with self.served("lcc25") as served:
            axis = served.open(settle_s=0.3, margin_s=2.0)
            motion = axis.start_move(2.0)
            served.emulator.receive(b"enable=0\r")
            with pytest.raises(MotionFailed, match=r"move to 2.0000 V: .* off its target by -2.0000 V") as caught:
                motion.wait()
            assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)


def _instrument(folder: Path) -> Path:
    """A retarder at 45 degrees before a polarizer, whose W is known at four voltages."""
    retardance = np.pi / np.array(list(VOLTS.values()))
    rows = 0.5 * np.stack([np.ones(4), np.cos(retardance), np.zeros(4), np.sin(retardance)], axis=1)
    text = (
        "kind: instrument\nname: liquid crystal\nmeasured:\n"
        f"  angles_deg: {{lcr: {list(VOLTS.values())}}}\n  tolerance_deg: 0.01\n  rows: {rows.round(12).tolist()}\n"
    )
    path = folder / "crystal.yaml"
    path.write_text(text)
    return path


@pytest.fixture
def crystal_rig(small_rig: Callable[..., Path], tmp_path: Path) -> Path:
    """A polarimeter whose only moving part is a voltage."""
    axes = {"lcr": {"kind": "lcc25", "port": "sim:crystal", "settle_s": 0.02, "states": VOLTS}}
    top = {name: [] for name in ("home_order", "endless", "forbidden", "interlocks")}
    top |= {"axes": axes, "modes": {"stokes": {"instrument": str(_instrument(tmp_path))}}}
    top |= {"backlash_deg": {}, "park_deg": {}, "homing": {}, "solids": None}
    ports = {"crystal": {"kind": "lcc25"}, "shutter": {"kind": "sc10"}}
    return small_rig(top=top, ports=ports, axes={"lcr": {"port": "crystal"}})


PLAN = "kind: plan\nmode: stokes\nsample: {name: air, kind: air}\nomega_deg: 180\ndarks: 1\n"


@pytest.mark.long
def test_a_capture_of_named_states(
    crystal_rig: Path,
    tmp_path: Path,
    acquire: Callable[..., tuple[int, str, str]],
    process: Callable[..., tuple[int, str, str]],
) -> None:
    plan = tmp_path / "plan.yaml"
    plan.write_text(f"{PLAN}states: {{kind: table, angles: {{lcr: [quarter, 1.2, half, high, quarter]}}}}\n")
    acquire.made("--plan", plan, "--rig", crystal_rig, "--out", tmp_path / "taken", "--yes")
    (path,) = (tmp_path / "taken").glob("*.h5")
    with h5py.File(path) as h5:
        axis = h5["entry/instrument/lcr"]
        assert [axis[name].attrs["units"] for name in ("value", "target_value")] == ["V", "V"]
        assert axis["value"][:].tolist() == [1.53, 1.53, 1.2, 2.2, 9.0, 1.53]
        assert axis["state_name"][:].tolist() == [b"quarter", b"quarter", b"low", b"half", b"high", b"quarter"]
        assert b"quarter" in h5["entry/plan/data"][()]
    dataset = open_dataset(path)
    assert dataset["lcr_V"].attrs["units"] == "V"
    with h5py.File(write_dataset(dataset, tmp_path / "again.h5")) as h5:
        assert h5["entry/instrument/lcr/value"].attrs["units"] == "V"
    process.made("reduce", path, "--out", tmp_path / "stokes.h5", "--no-figure")
    # Light of the unpolarized source, straight through; no voltage shows its part at 45 degrees.
    stokes = open_dataset(tmp_path / "stokes.h5")["mueller"].mean(("y", "x")).to_numpy()[:, 0]
    np.testing.assert_allclose(stokes / stokes[0], [1, 0, np.nan, 0], atol=0.01)


@pytest.mark.parametrize(
    ("states", "message"),
    [
        ("[quarter, fifth]", "axis lcr has no state 'fifth', only: low, quarter, half, high"),
        ("[1.2, 1.53, 2.2, 9.0, 9.0, 30]", "limits are 0 to 10 V"),
        ("[low, half, high]", "does not depend on the voltage of lcr, which changes"),
    ],
)
def test_what_is_refused(
    crystal_rig: Path, tmp_path: Path, states: str, message: str, acquire: Callable[..., tuple[int, str, str]]
) -> None:
    if "voltage" in message:
        (tmp_path / "crystal.yaml").write_text("kind: instrument\nname: none\ngenerator: []\nanalyzer: []\n")
    elif "limits" in message:
        text = (tmp_path / "crystal.yaml").read_text()
        (tmp_path / "crystal.yaml").write_text(text.replace("tolerance_deg: 0.01", "tolerance_deg: 100"))
    change_yaml(crystal_rig, lambda tree: tree["axes"]["lcr"].update({"limits_deg": [0, 10]}))
    plan = tmp_path / "plan.yaml"
    plan.write_text(f"{PLAN}states: {{kind: table, angles: {{lcr: {states}}}}}\n")
    code, _, err = acquire("--plan", plan, "--rig", crystal_rig, "--out", tmp_path / "taken", "--yes")
    assert (code != 0, message in " ".join(err.split())) == (True, True), err
