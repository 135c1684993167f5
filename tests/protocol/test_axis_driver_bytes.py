"""Byte transcripts: what each driver writes and how it reads the replies; a pair that is not used fails."""

import pytest

from drivers.apt_frames import apt_framer
from drivers.axes import apt, elliptec, esp301, gcs2, gsc, lcc25, smc100, zaber
from drivers.errors import CommandRejected, NotHomedError, ReplyError, WrongDevice
from simulators.clock import FastClock, patient_clock
from simulators.controllers import elliptec as elliptec_emulator
from simulators.controllers import esp301 as esp301_emulator
from simulators.controllers import zaber as zaber_emulator
from simulators.serial.reply_faults import Fault
from simulators.serial.serve_options import ServeOptions
from tests.protocol.scripted import scripted, served


def test_gsc_moves_are_relative_and_asked_for() -> None:
    idle, accepted = (
        (b"Q:\r\n", b"-      400,       20,K,K,R\r\n"),
        (b"Q:\r\n", b"OK\r\n-      400,       20,K,K,B\r\n"),
    )
    with scripted(
        (b"?:V\r\n", b"V1.10\r\n"),
        idle,
        *[idle] * 8,
        (b"M:1+P1200\r\n", b""),
        accepted,
        (b"G:\r\n", b""),
        (b"Q:\r\n", b"-      400,       20,X,L,R\r\n"),
        (b"L:1\r\n", b""),
    ) as (path, lines):
        axis = gsc.open("psg", gsc.Config(port=path, assume_homed=True, rtscts=False), lines)
        assert (axis.read_position().deg, axis.is_homed()) == (-1.0, True)
        with pytest.raises(CommandRejected, match="G:: the controller refuses it"):
            axis._do_start_move(800.0)
        axis.stop()
        with pytest.raises(WrongDevice, match="moves one at a time"):
            gsc.open("psa", gsc.Config(port=path, axis=2), lines)


def test_a_gsc_02_is_driven_by_a_letter_without_a_colon() -> None:
    # Blanks as the manuals print them.
    idle = (b"Q:\r\n", b"-       400,         0, K, K, R\r\n")
    with scripted((b"?:V\r\n", b"V2.00\r\n"), *[idle] * 3, (b"M:1+P1200\r\n", b""), idle, (b"G\r\n", b""), idle) as (
        path,
        lines,
    ):
        axis = gsc.open("psg", gsc.Config(port=path, home_direction="-", assume_homed=True, rtscts=False), lines)
        axis._do_start_move(800.0)


def test_a_disturbed_blank_in_a_status_of_a_gsc_is_asked_for_again() -> None:
    with scripted(
        (b"?:V\r\n", b"V1.10\r\n"), (b"Q:\r\n", b"-\x1c     400,K,K,R\r\n"), (b"Q:\r\n", b"-      400,K,K,R\r\n")
    ) as (path, lines):
        gsc.open("psg", gsc.Config(port=path, rtscts=False, reply_s=0.2), lines)


def test_an_lcc25_is_woken_by_an_empty_line() -> None:
    with scripted(
        (b"\r", b"\rCommand error CMD_NOT_DEFINED\r>\n"),
        (b"*idn?\r", b"*idn?\rTHORLABS LCC25 VERSION 1.05\r>\n"),
        (b"volt1=1.5300\r", b"volt1=1.5300\r>\n"),
        (b"mode=1\r", b"mode=1\r>\n"),
        (b"enable=1\r", b"enable=1\r>\n"),
    ) as (path, lines):
        lcc25.open("lcr", lcc25.Config(port=path), lines)._do_start_move(1.53)


def test_the_speed_of_a_conex_agp_is_that_of_the_rig_file() -> None:
    with scripted(
        *[(b"1VE\r\n", b"1VE CONEX-AGP 2.0.0\r\n"), (b"1ID?\r\n", b"1IDAG-PR100P\r\n")] * 2,
        *[(b"1SL?\r\n", b"1SL-170\r\n")] * 2,
        *[(b"1SR?\r\n", b"1SR170\r\n")] * 2,
    ) as (path, lines):
        with pytest.raises(WrongDevice, match="speed_deg_s"):
            smc100.open("psg", smc100.Config(port=path), lines)
        axis = smc100.open("psg", smc100.Config(port=path, speed_deg_s=2.0), lines)
        assert (axis.speed_deg_s, axis.acceleration_deg_s2) == (2.0, 20.0)


def smc100_after(*pairs: tuple[bytes, bytes]) -> list[tuple[bytes, bytes]]:
    """The exchanges of opening a CONEX, then these."""
    values = (b"VA?", b"20"), (b"AC?", b"80"), (b"SL?", b"0"), (b"SR?", b"90")
    constants = [(b"1%b\r\n" % name, b"1%b%b\r\n" % (name[:2], value)) for name, value in values]
    opening = (b"1VE\r\n", b"1VE CONEX-CC 2.0.1\r\n"), (b"1ID?\r\n", b"1IDPR50CC\r\n")
    return [*opening, *[pair for pair in constants for _ in range(2)], *pairs]


def test_smc100_open_and_refusals() -> None:
    pairs = smc100_after(
        (b"1TS\r\n", b"1TS000032\r\n"),
        (b"1TS\r\n", b"1TS000032\r\n"),
        (b"1TP\r\n", b"1TP12.34500\r\n"),
        (b"1TP\r\n", b"1TP12.34500\r\n"),
        (b"1TE\r\n", b"1TE@\r\n"),
        (b"1PA45.500000\r\n", b""),
        (b"1TE\r\n", b"1TEH\r\n"),
        (b"1ST\r\n", b""),
        (b"1TS\r\n", b"1TS010033\r\n"),
    )
    with scripted(*pairs) as (path, lines):
        arm = smc100.open("arm", smc100.Config(port=path, stage_id="PR50"), lines)
        assert arm.describe().firmware == "2.0.1"
        assert (arm.speed_deg_s, arm.acceleration_deg_s2, arm.limits.max_deg) == (20.0, 80.0, 90.0)
        with pytest.raises(NotHomedError, match="NOT REFERENCED"):
            arm.start_move(45.5)
        arm.stop()
        # Bit 7 from the left: supply voltage too low.
        with pytest.raises(CommandRejected, match="DC voltage low"):
            arm._do_check_fault()


def test_smc100_asks_again_for_a_state_that_there_is_not_and_does_not_guess_it() -> None:
    # 0x29 is no state: a reply of the right form with one digit changed.
    states = [(b"1TS\r\n", b"1TS0000%d\r\n" % state) for state in (29, 28, 29, 29)]
    with scripted(*smc100_after(*states)) as (path, lines):
        arm = smc100.open("arm", smc100.Config(port=path), lines)
        assert arm.is_moving()
        with pytest.raises(ReplyError, match="unknown state 000029"):
            arm.is_moving()


def test_apt_bytes() -> None:
    info = bytes.fromhex("060054008150") + (27_000_001).to_bytes(4, "little") + b"KDC101\0\0" + bytes(64)
    info += (6).to_bytes(2, "little") + bytes(6)
    velocity = bytes.fromhex("15040e008150 0100 00000000 0a000000 b2450500")
    home = bytes.fromhex("42040e008150 0100 0200 0100 b2450500 00000000")
    completed = bytes.fromhex("64040e008150") + bytes(14)
    position = bytes.fromhex("120406008150 0100 f8ffffff")
    pairs = [
        (bytes.fromhex("120000005001"), b""),
        *[(bytes.fromhex("050000005001"), info)] * 2,
        *[(bytes.fromhex("140401005001"), velocity)] * 2,
        *[(bytes.fromhex("410401005001"), home)] * 2,
        # Unsolicited messages before and after the reply, and noise in front.
        (bytes.fromhex("110401005001"), b"\x00\x53" + completed + position + completed),
        (bytes.fromhex("110401005001"), position),
        (bytes.fromhex("650401025001"), b""),
    ]
    with scripted(*pairs) as (path, lines):
        axis = apt.open("psa", apt.Config(port=path, serial_number=27_000_001), lines)
        assert axis.speed_deg_s == pytest.approx(345_522 / 42941.66, rel=1e-4)
        assert axis.read_position().counts == -8
        axis.stop()


def test_both_lengths_of_an_apt_status_are_frames() -> None:
    # PnPQ's tests have these: a status of 20 bytes, and the 34 of a K10CR2.
    short = bytes.fromhex("81040e0081220100010000000000000007000000")
    long = bytes.fromhex("81041c00812201000100000000000000070000000100000000000000000000000000")
    buffer = bytearray(long + short)
    assert [apt_framer(buffer), apt_framer(buffer), apt_framer(buffer)] == [long, short, None]


def test_esp301_bytes() -> None:
    opening = [
        (b"VE?\r", b"ESP301 Version 3.0.1 6/1/99\r\n"),
        (b"2ID?\r", b"URS75CC, SN1263\r\n"),
        (b"2SN?\r", b"7\r\n"),
        *[(b"2VA?\r", b"20\r\n")] * 2,
        *[(b"2AC?\r", b"80\r\n")] * 2,
        *[(b"2SL?\r", b"-170\r\n")] * 2,
        *[(b"2SR?\r", b"170\r\n")] * 2,
        (b"2TP?\r", b"451322, NO ERROR\r\n30.0000\r\n"),
        (b"2TP?\r", b"30.0000\r\n"),
        (b"TE?\r", b"213\r\n"),
        (b"TE?\r", b"0\r\n"),
    ]
    with scripted(*opening) as (path, lines):
        axis = esp301.open("arm", esp301.Config(port=path, axis=2, stage_id="URS75CC, SN1263"), lines)
        assert axis.describe().serial_number == "SN1263"
        assert axis.read_position().counts == 30.0
        with pytest.raises(CommandRejected, match="213: motor not enabled"):
            axis._do_check_fault()


def test_gcs2_bytes() -> None:
    opening = [
        (b"*IDN?\n", b"(c)2015 Physik Instrumente (PI) GmbH & Co. KG, C-863.11, 0115012345, 1.2.1.0\n"),
        *[(b"VEL? 2\n", b"2=50.0\n")] * 2,
        *[(b"ACC? 2\n", b"2=200.0\n")] * 2,
        *[(b"TMN? 2\n", b"2=-1e7\n")] * 2,
        *[(b"TMX? 2\n", b"2=180.0\n")] * 2,
        # The answer for another axis is none for this one.
        (b"POS? 2\n", b"1=7.0\n2=30.25\n"),
        (b"POS? 2\n", b"2=30.25\n"),
        *[(b"\x05", b"2\n")] * 2,
        (b"HLT 2\n", b""),
        (b"SVO? 2\n", b"2=0\n"),
        (b"ERR?\n", b"0\n"),
        (b"SVO 2 1\n", b""),
        (b"ERR?\n", b"0\n"),
        (b"ERR?\n", b"0\n"),
        (b"MOV 2 12.500000\n", b""),
        (b"ERR?\n", b"7\n"),
    ]
    with scripted(*opening) as (path, lines):
        axis = gcs2.open("psg", gcs2.Config(port=path, axis=2, serial_number="0115012345"), lines)
        assert (axis.limits.min_deg, axis.limits.max_deg) == (None, 180.0)
        assert axis.read_position().counts == 30.25
        assert axis.is_moving()
        axis.stop()
        with pytest.raises(CommandRejected, match="error 7: position out of limits"):
            axis._do_start_move(12.5)


def test_readings_that_disagree_are_no_position() -> None:
    answers = iter(range(10, 190, 10))
    pairs = [(b"1TP\r\n", f"1TP{next(answers)}.00000\r\n".encode()) for _ in range(18)]
    steps: list[tuple[bytes, bytes]] = [pairs[0]]
    for pair in pairs[1:]:
        steps += [pair, (b"1TS\r\n", b"1TS000033\r\n")]
    opening = [
        (b"1VE\r\n", b"1VE SMC100CC 1.0\r\n"),
        (b"1ID?\r\n", b"1IDX\r\n"),
        *[(f"1{c}?\r\n".encode(), f"1{c}20\r\n".encode()) for c in ("VA", "VA", "AC", "AC", "SL", "SL", "SR", "SR")],
    ]
    with scripted(*opening, *steps) as (path, lines):
        arm = smc100.open("arm", smc100.Config(port=path), lines)
        with pytest.raises(ReplyError, match="contradict"):
            arm.read_position()


@pytest.mark.parametrize(
    ("answer", "identity"),
    [
        # The first is what public recordings of an E-861 have.
        ("(c)2013 Physik Instrumente(PI) Karlsruhe, E-861 Version 7.2.0", ("E-861", "", "7.2.0")),
        ("Physik Instrumente, C-863.11, 0115012345, 1.2.1.0", ("C-863.11", "0115012345", "1.2.1.0")),
        ("(c)2017 Physik Instrumente, C-887, 0115012345, 2.6.1, 1.0", ("C-887", "0115012345", "2.6.1, 1.0")),
        ("PHYSIK INSTRUMENTE C-867 VERSION 1.0", ("C-867", "", "1.0")),
        ("(c)2015 Physik Instrumente (PI) GmbH", ("", "", "")),
    ],
)
def test_what_a_pi_controller_says_of_itself(answer: str, identity: tuple[str, str, str]) -> None:
    assert gcs2.read_identity(answer)[1:] == identity


def test_errors_of_one_esp301_axis_are_kept_while_another_is_asked() -> None:
    emulator = esp301_emulator.make(ServeOptions(clock=FastClock(100.0, base=patient_clock())))
    with served(emulator) as (path, lines):
        first, second = (esp301.open(f"axis {k}", esp301.Config(port=path, axis=k), lines) for k in (1, 2))
        emulator.errors.extend([(204, 0), (7, 0), (120, 0)])
        with pytest.raises(CommandRejected, match=r"error 7: .*, error 120: homing aborted"):
            first.check_fault()
        first.check_fault()
        with pytest.raises(CommandRejected, match="error 204: hardware limit"):
            second.check_fault()
        second.check_fault()


def summed(body: str) -> bytes:
    """Zaber text with its checksum: all characters and the checksum add up to zero modulo 256."""
    check = next(value for value in range(256) if (sum(body.encode()) + value) % 256 == 0)
    return f"{body}:{check:02X}".encode()


def test_zaber_exchange_sorts_out_what_is_not_its_reply() -> None:
    old, right = summed("02 1 99 OK IDLE -- 5"), summed("02 1 01 OK IDLE -- -77")
    checked = summed("02 1 02 OK BUSY WR 06").rpartition(b":")[2]
    with scripted(
        (b"/" + summed("2 1 01 get pos") + b"\n", b"!02 1 IDLE --\r\n#02 1 info\r\n@%b\r\n@%b\r\n" % (old, right)),
        # A checksum in lower case, and a blank.
        (b"/" + summed("2 1 02") + b"\n", b"@02 1 02 OK BUSY WR 06:%b \r\n" % checked.lower()),
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


def test_a_zaber_that_answers_in_another_form_is_not_called_silent() -> None:
    emulator = zaber_emulator.make(ServeOptions(clock=FastClock(100.0, base=patient_clock())))
    reply = emulator._reply
    emulator._reply = lambda data: reply(data.replace(b" IDLE", b""))  # type: ignore[method-assign]
    with served(emulator) as (path, lines), pytest.raises(ReplyError, match=r"no valid reply, but \[b'@01 .*baudrate"):
        zaber.open("psg", zaber.Config(port=path, reply_s=0.2), lines)


def test_zaber_homes_at_the_lesser_of_two_speeds() -> None:
    emulator = zaber_emulator.make(ServeOptions(homed=True, clock=FastClock(100.0, base=patient_clock())))
    for device in emulator.devices:
        device.approach_deg_s = 10 * device.axis.speed_deg_s
    with served(emulator) as (path, lines):
        axis = zaber.open("psg", zaber.Config(port=path, address=1), lines)
        motion = axis.home()
        assert motion.expected_s == pytest.approx(2 * 360.0 / axis.speed_deg_s, rel=1e-3)
        motion.wait()


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
