"""Random bytes at a driver's and at an emulator's input: no hang, no crash, no wrong position.

A few moves in a suite; ``UMOV_FUZZ_ROUNDS=2000`` in the environment makes it minutes for each kind.
"""

import functools
import math
import os
import random
import time
import zlib
from collections.abc import Callable

import pytest

from drivers.errors import DeviceError
from drivers.motion import MotionAxis
from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from simulators.clock import FastClock, patient_clock
from simulators.conformance.served_axes import AxisTests
from simulators.rig.controller_kinds import axis_configs, served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.pty_port import PtyPort
from simulators.serial.serve_options import ServeOptions
from simulators.serial.tcp_port import port_for

#: Longer than all tries of an exchange on a busy machine: what takes longer hangs.
HANGS_S = 60.0
ROUNDS = int(os.environ.get("UMOV_FUZZ_ROUNDS", "6"))


class NoisyWire:
    """An emulator behind a line that changes, drops and inserts a few percent of the bytes of its replies."""

    def __init__(self, emulator: Emulator, seed: int, rate: float) -> None:
        self.emulator = emulator
        self._random = random.Random(seed)
        self.rate = rate

    def receive(self, data: bytes) -> None:
        self.emulator.receive(data)

    def take_output(self) -> bytes:
        data = self.emulator.take_output()
        noisy = bytearray()
        for byte in data:
            chance = self._random.random()
            if chance < self.rate / 3:
                continue
            noisy.append(self._random.randrange(256) if chance < 2 * self.rate / 3 else byte)
            if chance > 1 - self.rate / 3:
                noisy += self._random.randbytes(self._random.randrange(1, 12))
        return bytes(noisy)

    def next_output_s(self) -> float | None:
        return self.emulator.next_output_s()


def answer_of(call: Callable[[], object]) -> object | None:
    """Return the answer, or None for a DeviceError; anything else, or a longer wait, fails."""
    start_s = patient_clock().now_s()
    try:
        return call()
    except DeviceError:
        return None
    finally:
        assert patient_clock().now_s() - start_s < HANGS_S


def seed_of(kind: str) -> int:
    """The same noise for a kind each time, independent of the other kinds."""
    return zlib.crc32(kind.encode())


class DriverNoise(AxisTests):
    """Of a driver on a serial line; TCP delivers what was sent."""

    def test_noise_on_the_line_never_gives_a_wrong_position(self, kind: str) -> None:
        seed = seed_of(kind)
        clock = FastClock(300.0, base=patient_clock())
        emulator = served_kinds()[kind](ServeOptions(homed=True, clock=clock, limits_deg=(-400.0, 400.0)))
        wire = NoisyWire(emulator, seed, rate=0.0)
        targets = random.Random(seed)
        reads = moves = 0
        with PtyPort(wire) as port, LineRegistry(clock=patient_clock()) as lines:
            short = {"reply_s": 0.1, "poll_s": 0.001, "margin_s": 0.2, "stall_s": 0.2}
            config = axis_configs(emulator, port.path, homed=True)[0].model_copy(update=short)
            axis: MotionAxis = open_axis("axis", config, lines)
            for _ in range(ROUNDS):
                wire.rate = targets.choice([0.0, 0.002, 0.01, 0.1])
                target_deg = targets.uniform(-390.0, 390.0)
                motion = answer_of(functools.partial(axis.start_move, target_deg))
                position = None if motion is None else answer_of(motion.wait)  # type: ignore[attr-defined]
                if position is not None:
                    moves += 1
                    assert position.deg == pytest.approx(target_deg, abs=0.05), f"seed {seed}"  # type: ignore[attr-defined]
                    assert position.deg == pytest.approx(emulator.true_deg(0), abs=2e-3), f"seed {seed}"  # type: ignore[attr-defined]
                while emulator.axes[0].is_moving():
                    time.sleep(0.001)
                position = answer_of(axis.read_position)
                if position is not None and position.confirmed:  # type: ignore[attr-defined]
                    reads += 1
                    assert position.deg == pytest.approx(emulator.true_deg(0), abs=2e-3), f"seed {seed}"  # type: ignore[attr-defined]
        assert min(reads, moves) >= ROUNDS // 4, f"{reads} readings, {moves} moves"


class EmulatorNoise(AxisTests):
    """Of an emulator: `pieces` of real commands get the noise past the first letter."""

    def test_an_emulator_swallows_anything_and_still_answers(self, kind: str) -> None:
        seed = seed_of(kind)
        noise = random.Random(seed)
        emulator = served_kinds()[kind](ServeOptions(clock=FastClock(50.0, base=patient_clock())))
        line = emulator.connect() if hasattr(emulator, "connect") else emulator
        spoken = 0
        for _ in range(10 * ROUNDS):
            for _ in range(50):
                choice = noise.random()
                if choice < 0.4:
                    line.receive(noise.choice(emulator.pieces))
                elif choice < 0.7:
                    line.receive(str(noise.randrange(-99, 99_999)).encode())
                else:
                    line.receive(noise.randbytes(noise.randrange(1, 30)))
                spoken += len(line.take_output())
        assert spoken > 0
        # After any input it still answers a correct question.
        line.receive(b"\r\n" * 200)
        for motor in emulator.axes:
            motor.stop()
        patient_clock().sleep_s(0.05)
        line.take_output()
        with port_for(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
            axis = open_axis("axis", axis_configs(emulator, port.path)[0], lines)
            position_deg = axis.read_position().deg
            assert math.isfinite(position_deg), f"seed {seed}"
            axis.stop()
            assert not axis.is_moving()
