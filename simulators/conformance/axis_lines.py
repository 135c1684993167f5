"""What axes owe to others on their line, and to programs that have it."""

import os
import subprocess
import sys
import threading

import pytest

from drivers.errors import PortBusy
from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import patient_clock
from simulators.conformance.axis_noise import DriverNoise
from simulators.conformance.served_axes import AxisTests


class SharedLineConformance(AxisTests):
    """Of a controller or a chain with several axes on one line."""

    def test_two_axes_on_one_line_move_at_once(self, kind: str) -> None:
        with self.served(kind, speed=2.0, axes=2) as served:
            first, second = served.open(0), served.open(1)
            motions = [first.start_move(150.0), second.start_move(-150.0)]
            assert first.is_moving()
            assert second.is_moving()
            results: list[float] = []
            threads = [threading.Thread(target=lambda m=motion: results.append(m.wait().deg)) for motion in motions]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
            assert sorted(results) == pytest.approx([-150.0, 150.0], abs=0.05)
            assert served.emulator.true_deg(1) == pytest.approx(-150.0, abs=0.05)
            first.close()
            assert second.read_position().deg == pytest.approx(-150.0, abs=0.05)

    def test_the_places_of_two_axes_differ(self, kind: str) -> None:
        with self.served(kind, axes=2) as served:
            first, second = (config.place() for config in served.configs)
            assert first != second, "a rig file cannot have both: Config.place() of them has to differ"


class SerialPortConformance(DriverNoise):
    """Of a controller behind a serial port: one program has it at a time, and its line may be disturbed."""

    def test_a_port_that_another_program_holds_is_refused_by_name(self, kind: str) -> None:
        with self.served(kind) as served:
            holder = (
                "import os, sys; f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print('open', flush=True); input()"
            )
            with subprocess.Popen(
                [sys.executable, "-c", holder, served.port.path],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            ) as process:
                assert process.stdout is not None
                assert process.stdout.readline() == "open\n"
                with pytest.raises(PortBusy, match=rf"python.*\(pid {process.pid}\)"):
                    served.open()
                process.communicate("\n")
            assert served.emulator.faults.commands == 0
            served.open()
            with LineRegistry(clock=patient_clock()) as registry, pytest.raises(PortBusy, match=rf"pid {os.getpid()}"):
                open_axis("second", served.configs[0], registry)
