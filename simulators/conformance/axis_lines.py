"""What axes owe to others on their line, and to programs that have it."""

from __future__ import annotations

import os
import subprocess
import sys
import threading

import pytest

from drivers.errors import PortBusy
from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import patient_clock
from simulators.conformance.axis_bench import ServedAxis
from simulators.conformance.axis_noise import DriverNoise


class SharedLineConformance(ServedAxis):
    """Of a controller or a chain with several axes on one line."""

    def test_two_axes_on_one_line_move_at_once(self, kind: str) -> None:
        with self.served(kind, speed=2.0, axes=2) as bench:
            first, second = bench.open(0), bench.open(1)
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
            assert bench.emulator.true_deg(1) == pytest.approx(-150.0, abs=0.05)
            first.close()
            assert second.read_position().deg == pytest.approx(-150.0, abs=0.05)


class SerialPortConformance(DriverNoise):
    """Of a controller behind a serial port: one program has it at a time, and its line may be disturbed."""

    def test_a_port_that_another_program_holds_is_refused_by_name(self, kind: str) -> None:
        with self.served(kind) as bench:
            holder = (
                "import os, sys; f = os.open(sys.argv[1], os.O_RDWR | os.O_NOCTTY); print('open', flush=True); input()"
            )
            with subprocess.Popen(
                [sys.executable, "-c", holder, bench.port.path],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            ) as process:
                assert process.stdout is not None
                assert process.stdout.readline() == "open\n"
                with pytest.raises(PortBusy, match=rf"python.*\(pid {process.pid}\)"):
                    bench.open()
                process.communicate("\n")
            assert bench.emulator.faults.commands == 0
            bench.open()
            with LineRegistry(clock=patient_clock()) as other, pytest.raises(PortBusy, match=rf"pid {os.getpid()}"):
                open_axis("second", bench.configs[0], other)
