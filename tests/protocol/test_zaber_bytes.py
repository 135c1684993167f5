"""Bytes of Zaber's ASCII protocol: checksums, replies of others, and the speed of homing."""

import pytest

from drivers.axes import zaber
from drivers.errors import CommandRejected, ReplyError
from simulators.clock import FastClock, patient_clock
from simulators.controllers import zaber as zaber_emulator
from simulators.serial.serve_options import ServeOptions
from tests.protocol.scripted import scripted, served


def summed(body: str) -> bytes:
    """Zaber text with its checksum: all characters and the checksum add up to zero modulo 256."""
    check = next(value for value in range(256) if (sum(body.encode()) + value) % 256 == 0)
    return f"{body}:{check:02X}".encode()


def test_zaber_checksum_and_reply() -> None:
    assert zaber.checksum("0 0 00") == "00"
    assert zaber.checksum("1 1 07 move abs 10000") == "B9"
    reply = zaber.parse_reply(b"@01 1 07 OK BUSY -- 0:E0")
    assert reply == zaber.Reply(1, 1, 7, True, True, "--", "0")
    for spoiled in (b"@01 1 07 OK IDLE -- 0:E0", b"@01 1 07 OK BUSY -- 0:", b"01 1 07 OK BUSY -- 0:E0", b"", b"\xff"):
        assert zaber.parse_reply(spoiled) is None
    assert zaber.parse_reply(b"@01 1 07 OK BUSY -- 0") == zaber.Reply(1, 1, 7, True, True, "--", "0", summed=False)


def test_zaber_exchange_sorts_out_what_is_not_its_reply() -> None:
    old, right = summed("02 1 99 OK IDLE -- 5"), summed("02 1 01 OK IDLE -- -77")
    with scripted(
        (b"/" + summed("2 1 01 get pos") + b"\n", b"!02 1 IDLE --\r\n#02 1 info\r\n@%b\r\n@%b\r\n" % (old, right)),
        (b"/" + summed("2 1 02") + b"\n", b"@" + summed("02 1 02 OK BUSY WR 0") + b"\r\n"),
        (b"/" + summed("2 1 03 fly") + b"\n", b"@" + summed("02 1 03 RJ IDLE -- BADCOMMAND") + b"\r\n"),
    ) as (path, _):
        line = zaber.ZaberLine(zaber.Config(port=path), patient_clock(), None)
        assert line.ask(2, 1, "get pos", repeat=True).data == "-77"
        assert line.ask(2, 1, "", repeat=True).busy
        with pytest.raises(CommandRejected, match="BADCOMMAND"):
            line.ask(2, 1, "fly", repeat=False)
        line.close()


@pytest.mark.parametrize("says", [b"OK IDLE -- 0", b"RJ IDLE -- BADCOMMAND"], ids=["none sent", "none known"])
def test_zaber_replies_without_checksum_count_where_the_device_says_that_it_sends_none(says: bytes) -> None:
    with scripted(
        (b"/" + summed("0 0 01 get system.serial") + b"\n", b"@01 0 01 OK IDLE -- 4711\r\n"),
        (b"/" + summed("1 0 02 get comm.checksum") + b"\n", b"@01 0 02 " + says + b"\r\n"),
        (b"/" + summed("1 0 03 get comm.checksum") + b"\n", b"@01 0 03 " + says + b"\r\n"),
        (b"/" + summed("1 1 04 get pos") + b"\n", b"@01 1 04 OK IDLE -- -77\r\n"),
        # A checksum that is there must still be right.
        (b"/" + summed("1 1 05 get pos") + b"\n", b"@01 1 05 OK IDLE -- -77:00\r\n"),
    ) as (path, _):
        line = zaber.ZaberLine(zaber.Config(port=path, reply_s=0.2), patient_clock(), None)
        assert line.ask_all("get system.serial") == [(1, "4711")]
        assert line.ask(1, 1, "get pos", repeat=False).data == "-77"
        with pytest.raises(ReplyError):
            line.ask(1, 1, "get pos", repeat=False)
        line.close()


def test_a_zaber_reply_that_lost_its_checksum_is_not_believed() -> None:
    with scripted(
        (b"/" + summed("0 0 01 get system.serial") + b"\n", b"@01 0 01 OK IDLE -- 47\r\n"),
        (b"/" + summed("1 0 02 get comm.checksum") + b"\n", b"@" + summed("01 0 02 OK IDLE -- 1") + b"\r\n"),
        (b"/" + summed("1 0 03 get comm.checksum") + b"\n", b"@" + summed("01 0 03 OK IDLE -- 1") + b"\r\n"),
        (b"/" + summed("1 1 04 get pos") + b"\n", b"@01 1 04 OK IDLE -- 7\r\n"),
    ) as (path, _):
        line = zaber.ZaberLine(zaber.Config(port=path, reply_s=0.2), patient_clock(), None)
        assert line.ask_all("get system.serial") == []
        with pytest.raises(ReplyError):
            line.ask(1, 1, "get pos", repeat=False)
        line.close()


def test_zaber_homes_at_the_lesser_of_two_speeds() -> None:
    emulator = zaber_emulator.make(ServeOptions(homed=True, clock=FastClock(100.0, base=patient_clock())))
    for device in emulator.devices:
        device.approach_deg_s = 10 * device.axis.speed_deg_s
    with served(emulator) as (path, lines):
        axis = zaber.open("psg", zaber.Config(port=path, address=1), lines)
        motion = axis.home()
        assert motion.expected_s == pytest.approx(2 * 360.0 / axis.speed_deg_s, rel=1e-3)
        motion.wait()
