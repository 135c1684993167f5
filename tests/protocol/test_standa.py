"""Standa 8SMC5: bytes as the maker's own library writes them, and what driver and emulator make of them."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from drivers.axes import standa
from drivers.errors import CommandRejected, NotHomedError, ReplyError, WrongDevice
from drivers.standa_frames import LAYOUTS, framer, message
from simulators.clock import FastClock, ManualClock, patient_clock
from simulators.controllers import standa as emulated
from simulators.controllers.standa import StandaEmulator
from simulators.serial.serve_options import ServeOptions
from tests.protocol.scripted import served

# libximc 3.1.2, command_move(-1234, -56): it fills the bytes that it reserves with 0xCC.
MOVE = bytes.fromhex("6d6f7665 2efbffff c8ff cccccccccccc f355")
# The same, set_edges_settings with both borders as counts that stop: -100 - 3/256 and 200 + 7/256 steps.
BORDERS = bytes.fromhex("73656473 06 01 9cffffff fdff c8000000 0700 cccccccccccc 1092")


@contextmanager
def opened(homed: bool = True, **options: Any) -> Iterator[tuple[StandaEmulator, standa.StandaAxis]]:
    clock = FastClock(200.0, base=patient_clock())
    emulator = emulated.make(ServeOptions(**{"homed": homed, "clock": clock} | options))
    with served(emulator) as (path, lines):
        entry = {"port": path, "steps_per_deg": 100, "poll_s": 0.002, "reply_s": 0.25, "assume_homed": homed}
        yield emulator, standa.open("psg", standa.Config.model_validate(entry), lines)


def test_the_emulator_takes_the_bytes_of_the_makers_library() -> None:
    clock = ManualClock()
    box = emulated.make(ServeOptions(clock=clock))
    for byte in MOVE:
        box.receive(bytes([byte]))
    assert box.take_output() == b"move"
    clock.sleep_s(60.0)
    assert box.count_deg() == pytest.approx((-1234 - 56 / 256) / 100, abs=1e-9)
    box.receive(BORDERS + b"geds" + b"gpos")
    borders, position = LAYOUTS[b"geds"].pack(6, 1, -100, -3, 200, 7), LAYOUTS[b"gpos"].pack(-1234, -56, 0)
    assert box.take_output() == b"seds" + message(b"geds", borders) + message(b"gpos", position)


def test_errors_of_the_controller() -> None:
    box = emulated.make(ServeOptions(clock=ManualClock()))
    box.receive(MOVE[:-1] + b"\0")
    assert box.take_output() == b"errd"
    box.receive(b"\0\0gxyz")
    assert box.take_output() == b"\0\0errc"
    box.receive(message(b"smov", LAYOUTS[b"gmov"].pack(200_000, 0, 1, 1, 1, 0)))
    assert box.take_output() == b"errv"


def test_answers_are_found_in_noise() -> None:
    status = message(b"gets", bytes(48))
    buffer = bytearray(b"\0\0x" + status[:-1] + b"?" + b"sstp" + status + status[:9])
    assert [framer(buffer), framer(buffer), framer(buffer)] == [b"sstp", status[:-2], None]
    assert bytes(buffer) == status[:9]


def test_opening_reads_units_and_borders() -> None:
    emulator = emulated.make(ServeOptions(clock=FastClock(200.0, base=patient_clock())))
    emulator.settings |= {b"eds": (5, 6, -2100, 0, 32100, 128), b"mov": (2000, 128, 3000, 5000, 2000, 0)}
    with served(emulator) as (path, lines):
        axis = standa.open("psg", standa.Config(port=path, steps_per_deg=100), lines)
        # The border on the left does not stop.
        assert (axis.limits.min_deg, axis.limits.max_deg) == (None, 321.005)
        assert (axis.speed_deg_s, axis.acceleration_deg_s2) == (20.005, 30.0)
        assert axis.counts_per_deg == 25_600
        assert (axis.describe().model, axis.describe().firmware) == ("8SMC5-US 2.3.0", "4.7.8")
        emulator.settings[b"fbs"] = (4000, 1, 0, 4000)
        with pytest.raises(WrongDevice, match="feedback 1"):
            standa.open("psg", standa.Config(port=path, steps_per_deg=100), lines)


def test_home_gives_the_count_a_zero_and_needs_both_the_flag_and_this_session() -> None:
    with opened(homed=False) as (emulator, axis):
        axis.home().wait()
        assert emulator.count_deg() == 0.0
        axis.start_move(-12.34).wait()
        assert emulator.true_deg(0) == pytest.approx(-12.34, abs=1e-3)
        # The old homing in the status must not end the next one.
        assert axis.home().wait().counts == 0
        emulator.axis.lose_reference()
        with pytest.raises(NotHomedError):
            axis.start_move(1.0)


def test_a_homing_that_was_stopped_makes_no_reference() -> None:
    # So slow that it does not get home before the stop, however late that comes.
    with opened(homed=False, speed_deg_s=1.0, clock=FastClock(1.0, base=patient_clock())) as (_, axis):
        axis.home()
        axis.stop()
        while axis.is_moving():
            pass
        assert not axis.is_homed()


def test_an_alarm_is_a_fault_and_lost_bytes_are_made_up_for() -> None:
    with opened() as (emulator, axis):
        # Half a command, as after a cable that was pulled: the next question would be taken for its data.
        axis.line.link.write(b"move" + bytes(3))
        assert axis.read_position().counts == 0
        with pytest.raises(ReplyError, match="errc"):
            axis.line.command(b"fly!")
        emulator.alarm = True
        with pytest.raises(CommandRejected, match="alarm"):
            axis.check_fault()
