"""Bytes of an Elliptec module: what real mounts sent, and answers that come late."""

import pytest

from drivers.axes import elliptec
from drivers.errors import CommandRejected
from simulators.clock import FastClock, patient_clock
from simulators.controllers import elliptec as elliptec_emulator
from simulators.serial.reply_faults import Fault
from simulators.serial.serve_options import ServeOptions
from tests.protocol.scripted import scripted, served


def elliptec_after(*pairs: tuple[bytes, bytes]) -> list[tuple[bytes, bytes]]:
    """The exchanges of opening a module, whose identification was recorded from a real mount, then these."""
    opening = (b"0in", b"0IN0E1140050920201501016800023000\r\n"), (b"0gv", b"0GV64\r\n")
    return [*[pair for pair in opening for _ in range(2)], *pairs]


def test_elliptec_real_captures() -> None:
    # The position, too, is a recording of a real mount.
    position = (b"0gp", b"0POFFFFDA9C\r\n")
    pairs = elliptec_after(position, position, (b"0gs", b"0GS09\r\n"), (b"0gs", b"0GS0D\r\n"))
    with scripted(*pairs) as (path, lines):
        axis = elliptec.open("psg", elliptec.Config(port=path, address="0", serial_number="11400509"), lines)
        assert axis.counts_per_deg == pytest.approx(398.22, abs=0.01)
        position = axis.read_position()
        assert position.counts == -9572
        assert position.deg == pytest.approx(-24.04, abs=0.01)
        assert axis.is_moving()
        assert not axis.is_moving()
        with pytest.raises(CommandRejected, match="over-current"):
            axis._do_check_fault()


def test_a_module_that_answers_late_is_found_by_its_serial_number() -> None:
    emulator = elliptec_emulator.make(ServeOptions(clock=FastClock(100.0, base=patient_clock())))
    serial_number = elliptec_emulator.axis_configs(emulator, "none")[0].serial_number
    # Of the two readings of its identity the first or the second.
    for place in (1, 2):
        with served(emulator) as (path, lines):
            emulator.faults.add(Fault("late", from_command=place, commands=1, amount=0.13))
            config = elliptec.Config(port=path, serial_number=serial_number, reply_s=0.1)
            assert elliptec.open("psg", config, lines).describe().serial_number == serial_number


def test_elliptec_end_message_just_before_the_status_still_proves_the_homing() -> None:
    # The module's end of homing arrives between the question for its status and the answer to it.
    pairs = elliptec_after(
        (b"0gs", b"0GS00\r\n"),
        (b"0ho0", b""),
        (b"0gs", b"0PO00000000\r\n0GS00\r\n"),
        (b"0gs", b"0GS00\r\n"),
        *[(b"0gp", b"0PO00000000\r\n")] * 2,
        (b"0gs", b"0GS00\r\n"),
        *[(b"0gp", b"0PO00000000\r\n")] * 2,
    )
    with scripted(*pairs) as (path, lines):
        config = elliptec.Config(port=path, address="0", pause_before_move_s=0.0)
        axis = elliptec.open("psg", config, lines)
        assert axis.home().wait().counts == 0


def test_the_status_that_answers_a_stop_of_an_elliptec_is_no_answer_to_a_question() -> None:
    pairs = elliptec_after(
        # Busy: a module takes no stop on its way. The answer comes when the move is over and another question is asked.
        (b"0st", b""),
        (b"0gp", b"0GS09\r\n0PO00000000\r\n"),
        (b"0gp", b"0PO00000000\r\n"),
        # "Not supported", from a module that knows no stop, is no fault of its last move.
        (b"0st", b"0GS03\r\n"),
        (b"0gs", b"0GS00\r\n"),
        (b"0st", b""),
        (b"0gs", b"0GS00\r\n0GS09\r\n"),
        # It may never come.
        (b"0st", b""),
        (b"0gs", b"0GS09\r\n"),
        (b"0gs", b"0GS09\r\n"),
    )
    with scripted(*pairs) as (path, lines):
        axis = elliptec.open("psg", elliptec.Config(port=path, address="0", reply_s=0.2), lines)
        axis.stop()
        assert axis.read_position().counts == 0
        axis.stop()
        assert not axis.is_moving()
        axis.check_fault()
        axis.stop()
        assert axis.is_moving()
        axis.stop()
        assert axis.is_moving()
