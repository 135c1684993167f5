"""Every kind of axis passes the conformance kit. A new kind is under test by being in the two folders."""

from typing import Any

import pytest

from drivers.motion import AxisConfig
from drivers.registry import device_kinds
from simulators.conformance import AxisConformance, SerialPortConformance, SharedLineConformance
from simulators.conformance.axis_noise import ROUNDS
from simulators.conformance.served_axes import motion_kinds, serial_kinds
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.serve_options import ServeOptions

# The allowance of a single test, and for each round of noise.
pytestmark = pytest.mark.timeout(600 + 10 * ROUNDS)

#: The others of Thorlabs' are the same program with other numbers; `tests/end_to_end/test_acquire_rigs.py` moves them.
ALIKE = {"apt-bsc203", "apt-k10cr2", "apt-kbd101", "apt-kst101"}


def _marked(kinds: list[str]) -> list[Any]:
    return [pytest.param(kind, marks=[pytest.mark.long] * (kind in ALIKE)) for kind in kinds]


class TestEveryAxis(AxisConformance):
    @pytest.fixture(params=_marked(motion_kinds()))
    def kind(self, request: pytest.FixtureRequest) -> str:
        return str(request.param)


class TestSharedLines(SharedLineConformance):
    @pytest.fixture(params=_marked(motion_kinds(axes=2)))
    def kind(self, request: pytest.FixtureRequest) -> str:
        return str(request.param)


class TestSerialPorts(SerialPortConformance):
    @pytest.fixture(params=_marked(serial_kinds()))
    def kind(self, request: pytest.FixtureRequest) -> str:
        return str(request.param)


def test_every_kind_of_axis_has_an_emulator() -> None:
    covered = {
        config.kind  # type: ignore[attr-defined]
        for kind in motion_kinds()
        for config in axis_configs(served_kinds()[kind](ServeOptions()), "none")
    }
    # A stage of Micro-Manager has no wire, a liquid crystal has volts: tests/conformance/test_mmcore.py, test_lcc25.py.
    assert covered | {"mmcore", "lcc25"} == set(device_kinds("axes"))


def test_a_config_that_names_no_device_is_refused_when_it_is_written() -> None:
    with pytest.raises(TypeError, match=r"has no field 'serial_number'.*`identified_by`"):

        class Config(AxisConfig):
            kind: str = "nameless"
