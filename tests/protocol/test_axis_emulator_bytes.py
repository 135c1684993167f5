"""Byte transcripts: what each emulated controller answers, from manuals, public drivers and recorded traffic."""

import pytest

from simulators.clock import ManualClock
from simulators.rig.controller_kinds import served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.serve_options import ServeOptions


def emulator(kind: str, **options: object) -> tuple[Emulator, ManualClock]:
    clock = ManualClock()
    return served_kinds()[kind](ServeOptions(clock=clock, **options)), clock  # type: ignore[arg-type]


def talk(device: Emulator, request: bytes) -> bytes:
    device.receive(request)
    return device.take_output()


def run_out(device: Emulator, clock: ManualClock) -> bytes:
    """Let every motion end and return what is said on its own."""
    clock.sleep_s(60.0)
    return device.take_output()


def test_zaber() -> None:
    chain, clock = emulator("zaber")
    # Who is there: one line for each device, in chain order.
    assert talk(chain, b"/\n") == b"@01 0 OK IDLE WR 0\r\n@02 0 OK IDLE WR 0\r\n@03 0 OK IDLE WR 0\r\n"
    assert talk(chain, b"/0 0 00:00\n").startswith(b"@01 0 00 OK IDLE WR 0:")
    assert talk(chain, b"/1 1 04 warnings\n") == b"@01 1 04 OK IDLE WR 01 WR\r\n"
    # Without a reference an absolute move is refused.
    assert talk(chain, b"/1 1 07 move abs 10000:B9\n").startswith(b"@01 1 07 RJ IDLE WR BADDATA:")
    assert talk(chain, b"/1 1 05 home\n") == b"@01 1 05 OK BUSY WR 0\r\n"
    run_out(chain, clock)
    assert talk(chain, b"/1 1 07 move abs 10000:B9\n") == b"@01 1 07 OK BUSY -- 0:E0\r\n"
    assert talk(chain, b"/1 1 08\n") == b"@01 1 08 OK BUSY -- 0\r\n"
    assert run_out(chain, clock) == b""
    assert talk(chain, b"/1 1 10 get pos\n") == b"@01 1 10 OK IDLE -- 10000\r\n"
    talk(chain, b"/1 1 move rel -500\n")
    run_out(chain, clock)
    assert talk(chain, b"/1 get pos\r\n") == b"@01 0 OK IDLE -- 9500\r\n"
    # A wrong checksum gets no answer; an unknown command, axis or address is told apart.
    assert talk(chain, b"/1 1 07 move abs 10000:B8\n") == b""
    assert talk(chain, b"/1 1 fly\n") == b"@01 1 RJ IDLE -- BADCOMMAND\r\n"
    assert talk(chain, b"/1 3 home\n") == b"@01 3 RJ IDLE -- BADAXIS\r\n"
    assert talk(chain, b"/9 home\n") == b""
    # Jog runs until stop; a stop leaves a note.
    talk(chain, b"/1 1 20 move vel 100000\n")
    clock.sleep_s(0.3)
    assert talk(chain, b"/1 1 14 stop\n").startswith(b"@01 1 14 OK BUSY NI")
    run_out(chain, clock)
    assert talk(chain, b"/1 1 08\n") == b"@01 1 08 OK IDLE NI 0\r\n"


def test_zaber_alert_and_limit() -> None:
    chain, clock = emulator("zaber", homed=True)
    talk(chain, b"/3 set comm.alert 1\n")
    assert talk(chain, b"/3 1 move abs 999999\n") == b"@03 1 RJ IDLE -- BADDATA\r\n"
    assert talk(chain, b"/3 1 move abs -1\n") == b"@03 1 RJ IDLE -- BADDATA\r\n"
    assert talk(chain, b"/3 1 move max\n") == b"@03 1 OK BUSY -- 0\r\n"
    assert run_out(chain, clock) == b"!03 1 IDLE --\r\n"
    assert talk(chain, b"/3 1 get limit.min\n") == b"@03 1 OK IDLE -- 0\r\n"


def test_elliptec() -> None:
    line, clock = emulator("elliptec", homed=True)
    assert talk(line, b"0in") == b"0IN0E1140050220201501016800023000\r\n"
    assert len(talk(line, b"1in")) == 33 + 2
    assert talk(line, b"0gs") == b"0GS00\r\n"
    assert talk(line, b"0ma00008C00") == b""
    assert talk(line, b"0gs") == b"0GS09\r\n"
    assert talk(line, b"0ma00000000") == b"0GS09\r\n"
    # A bounded move cannot be stopped.
    assert talk(line, b"0st") == b"0GS09\r\n"
    assert run_out(line, clock) == b"0PO00008C00\r\n"
    assert talk(line, b"0gp") == b"0PO00008C00\r\n"
    assert talk(line, b"0mrFFFFE0E4") == b""
    assert run_out(line, clock) == b"0PO00006CE4\r\n"
    assert talk(line, b"0ho0") == b""
    assert run_out(line, clock) == b"0PO00000000\r\n"
    assert talk(line, b"0maFFFFDA9C") == b""
    assert run_out(line, clock) == b"0POFFFFDA9C\r\n"
    assert line.true_deg(0) == pytest.approx(-24.04, abs=0.01)
    assert talk(line, b"0gv\r\n") == b"0GV64\r\n"
    assert talk(line, b"0sv46") == b"0GS00\r\n"
    assert talk(line, b"0gv") == b"0GV46\r\n"
    assert talk(line, b"0zz") == b"0GS03\r\n"
    # A stray digit behind "ho" is tolerated; the answer to a new address comes from there.
    assert talk(line, b"0ho00") == b""
    run_out(line, clock)
    assert talk(line, b"0ca5") == b"5GS00\r\n"
    assert talk(line, b"0gs") == b""
    assert talk(line, b"5gs") == b"5GS00\r\n"


def test_smc100() -> None:
    line, clock = emulator("smc100")
    assert talk(line, b"1VE\r\n") == b"1VE SMC100CC 2.0.1\r\n"
    assert talk(line, b"1TS\r\n") == b"1TS00000A\r\n"
    # Refused silently; the reason waits in the error memory and is read once.
    assert talk(line, b"1PA45.5\r\n") == b""
    assert talk(line, b"1TE\r\n1TE\r\n") == b"1TEH\r\n1TE@\r\n"
    assert talk(line, b"1OR\r\n1TS\r\n") == b"1TS00001E\r\n"
    run_out(line, clock)
    assert talk(line, b"1TS\r\n") == b"1TS000032\r\n"
    assert talk(line, b"1SL?\r\n1SR?\r\n") == b"1SL0\r\n1SR180\r\n"
    assert talk(line, b" 1 pa 45.5 \r\n\r\n1TS\r\n") == b"1TS000028\r\n"
    assert talk(line, b"1PA10\r\n1TE\r\n") == b"1TEM\r\n"
    run_out(line, clock)
    assert talk(line, b"1TS\r\n1TP\r\n1TH\r\n") == b"1TS000033\r\n1TP45.50000\r\n1TH45.50000\r\n"
    assert talk(line, b"1PR-3\r\n") == b""
    run_out(line, clock)
    assert talk(line, b"1TP\r\n") == b"1TP42.50000\r\n"
    assert talk(line, b"1PA181\r\n1TE\r\n") == b"1TEG\r\n"
    assert talk(line, b"1OR\r\n1TE\r\n") == b"1TEK\r\n"
    assert talk(line, b"1MM0\r\n1TS\r\n") == b"1TS00003C\r\n"
    assert talk(line, b"1PA1\r\n1TE\r\n") == b"1TEJ\r\n"
    assert talk(line, b"1MM1\r\n1TS\r\n") == b"1TS000034\r\n"
    assert talk(line, b"1XY\r\n1TE\r\n") == b"1TEA\r\n"
    assert talk(line, b"7TS\r\n") == b""
    # A reset is silent for a while and loses the reference.
    assert talk(line, b"1RS\r\n1TS\r\n") == b""
    clock.sleep_s(1.0)
    assert talk(line, b"1TS\r\n") == b"1TS00000A\r\n"


def test_smc100_stop_without_an_address_stops_all() -> None:
    line, clock = emulator("smc100", homed=True, axes=2)
    talk(line, b"1PA170\r\n2PA170\r\n")
    clock.sleep_s(0.2)
    talk(line, b"ST\r\n")
    run_out(line, clock)
    assert 0 < line.true_deg(0) < 100
    assert line.true_deg(1) == pytest.approx(line.true_deg(0))


def h(text: str) -> bytes:
    return bytes.fromhex(text)


def test_apt_stepper() -> None:
    unit, clock = emulator("apt-k10cr1")
    info = talk(unit, h("05 00 00 00 50 01"))
    assert info[:6] == h("06 00 54 00 81 50")
    assert len(info) == 6 + 84
    assert int.from_bytes(info[6:10], "little") == 55_000_001
    assert info[10:18] == b"K10CR1\0\0"
    # No answer to another unit's address, nor to a blink.
    assert talk(unit, h("05 00 00 00 11 01")) == b""
    assert talk(unit, h("23 02 01 00 50 01")) == b""
    assert talk(unit, h("43 04 01 00 50 01")) == b""
    assert run_out(unit, clock) == h("44 04 01 00 01 50")
    assert talk(unit, h("53 04 06 00 d0 01 01 00 00 08 00 00")) == b""
    moving = talk(unit, h("29 04 01 00 50 01"))
    assert moving[:8] == h("2a 04 06 00 81 50 01 00")
    assert int.from_bytes(moving[8:], "little") & 0x30
    ended = run_out(unit, clock)
    assert ended[:6] == h("64 04 0e 00 81 50")
    assert len(ended) == 6 + 14
    assert talk(unit, h("11 04 01 00 50 01")) == h("12 04 06 00 81 50 01 00 00 08 00 00")
    assert talk(unit, h("80 04 01 00 50 01"))[:12] == h("81 04 0e 00 81 50 01 00 00 08 00 00")
    bits = int.from_bytes(talk(unit, h("29 04 01 00 50 01"))[8:], "little")
    assert bits & 1 << 10
    assert not bits & 0x30
    # Stop, profiled.
    talk(unit, h("57 04 01 01 50 01"))
    clock.sleep_s(0.5)
    talk(unit, h("65 04 01 02 50 01"))
    assert run_out(unit, clock)[:6] == h("66 04 0e 00 81 50")
    # Disabled, it does not move.
    talk(unit, h("10 02 01 02 50 01"))
    assert talk(unit, h("11 02 01 00 50 01")) == h("12 02 01 02 01 50")
    talk(unit, h("48 04 06 00 d0 01 01 00 00 00 01 00"))
    assert run_out(unit, clock) == b""


def test_apt_dc_servo_and_its_periodic_status() -> None:
    unit, clock = emulator("apt-kdc101", homed=True)
    info = talk(unit, h("05 00 00 00 50 01"))
    assert int.from_bytes(info[6:10], "little") == 27_000_001
    assert info[6 + 76] == 6
    assert talk(unit, h("90 04 01 00 50 01"))[:6] == h("91 04 0e 00 81 50")
    assert talk(unit, h("14 04 01 00 50 01"))[:8] == h("15 04 0e 00 81 50 01 00")
    talk(unit, h("11 00 00 00 50 01"))
    clock.sleep_s(0.15)
    assert unit.take_output()[:2] == h("91 04")
    talk(unit, h("12 00 00 00 50 01"))
    clock.sleep_s(1.0)
    assert unit.take_output() == b""


def test_apt_rack_and_its_bays() -> None:
    rack, clock = emulator("apt-bsc203", axes=2)
    info = talk(rack, h("05 00 00 00 11 01"))
    assert info[:6] == h("06 00 54 00 81 11")
    assert info[10:18] == b"BSC203\0\0"
    # The bays from 0 on: occupied, occupied, empty.
    for bay, state in ((0, 1), (1, 1), (2, 2)):
        assert talk(rack, bytes((0x60, 0, bay, 0, 0x11, 1))) == bytes((0x61, 0, bay, state, 1, 0x11))
    assert talk(rack, h("11 04 01 00 23 01")) == b""
    assert talk(rack, h("43 04 01 00 22 01")) == b""
    assert run_out(rack, clock) == h("44 04 01 00 01 22")


def test_a_k10cr2_sends_a_longer_status_and_a_malformed_address() -> None:
    unit, _ = emulator("apt-k10cr2", homed=True)
    status = talk(unit, h("80 04 01 00 50 01"))
    assert (status[:6], len(status)) == (h("81 04 1c 00 81 50"), 6 + 28)
    assert talk(unit, h("17 04 01 00 50 01"))[:6] == h("18 04 16 00 80 50")


def test_apt_homing_speed_of_zero_looks_dead() -> None:
    unit, clock = emulator("apt-k10cr1")
    before = unit.true_deg(0)
    talk(unit, h("40 04 0e 00 d0 01 01 00 02 00 01 00 00 00 00 00 00 00 00 00") + h("43 04 01 00 50 01"))
    assert run_out(unit, clock) == b""
    assert unit.true_deg(0) == before


def test_esp301() -> None:
    box, clock = emulator("esp301")
    assert talk(box, b"VE?\r").startswith(b"ESP301")
    assert talk(box, b"1MO?\r") == b"0\r\n"
    # The motor is off at power-up: the move does nothing and leaves error 113.
    assert talk(box, b"1PA30\r") == b""
    assert talk(box, b"TE?\rTE?\r") == b"113\r\n0\r\n"
    assert talk(box, b"TB?\r") == b"0, 0, NO ERROR DETECTED\r\n"
    assert talk(box, b"1MO;1OR1;1MD?\r") == b"0\r\n"
    assert talk(box, b"1PA3;TE?\r") == b"130\r\n"
    run_out(box, clock)
    assert talk(box, b"1 pa 30 ; 1ws500 ; 1tp\r") == b""
    clock.sleep_s(0.3)
    assert box.take_output() == b""
    assert run_out(box, clock) == b"30.0000\r\n"
    assert talk(box, b"1DP?;1MD?;1SN?\r") == b"30.0000\r\n1\r\n7\r\n"
    assert talk(box, b"1PA1000;TE?\r") == b"106\r\n"
    assert talk(box, b"1PA-1000;TE?\r") == b"107\r\n"
    assert talk(box, b"TP;TE?\r9TP;TE?\r1ZZ;TE?\r1PA;TE?\r") == b"37\r\n9\r\n6\r\n38\r\n"
    assert float(talk(box, b"1SR?\r")) >= 90
    # A stop is heard while the queue waits.
    talk(box, b"1PA-150;1WS;1TP?\r")
    clock.sleep_s(0.2)
    talk(box, b"1ST\r")
    run_out(box, clock)
    assert -150 < box.true_deg(0) < 30


def test_gcs2() -> None:
    box, clock = emulator("gcs2")
    assert talk(box, b"*IDN?\n") == b"(c)2015 Physik Instrumente (PI) GmbH & Co. KG, C-884.4DC, 0115012345, 1.2.1.0\n"
    assert talk(box, b"SAI?\n") == b"1 \n2\n"
    assert talk(box, b"POS? 1\n") == b"1=0.000000\n"
    # Servo off, then not referenced: the move is dropped and the error stays until it is read.
    assert talk(box, b"MOV 1 10\nERR?\nERR?\n") == b"5\n0\n"
    assert talk(box, b"SVO 1 1\nFRF 1\nERR?\n\x05") == b"0\n1\n"
    run_out(box, clock)
    assert talk(box, b"\x05FRF?\n") == b"0\n1=1 \n2=0\n"
    assert talk(box, b"MOV 1 -12.5\nERR?\n") == b"0\n"
    run_out(box, clock)
    assert talk(box, b"POS? 1\nONT? 1\n") == b"1=-12.500000\n1=1\n"
    assert talk(box, b"MOV 1 90\nHLT 1\nERR?\n") == b"10\n"
    assert talk(box, b"FLY 1\nERR?\nMOV 7 1\nERR?\nMOV 1\nERR?\n") == b"2\n15\n1\n"


def test_gsc_sets_a_move_and_drives_it() -> None:
    box, clock = emulator("gsc-01")
    for request, reply in (
        (b"?:V\r\n", b"V1.10\r\n"),
        (b"H:1\r\n", b"OK\r\n"),
        (b"M:1+P400\r\n", b"NG\r\n"),
        (b"!:\r\n", b"B\r\n"),
    ):
        assert talk(box, request) == reply
    clock.sleep_s(60.0)
    assert talk(box, b"Q:\r\n") == b"         0,X,K,R\r\n"
    assert talk(box, b"G:\r\n") == b"NG\r\n"
    assert talk(box, b"M:1-P4000\r\nG:\r\nQ:\r\n") == b"OK\r\nOK\r\n         0,K,K,B\r\n"
    clock.sleep_s(60.0)
    assert talk(box, b"Q:\r\n") == b"-     4000,K,K,R\r\n"
    assert talk(box, b"A:1+P20000000\r\n") == b"NG\r\n"
    assert box.true_deg(0) == -10.0
    # The coordinate after the move counts; letters may be small; a free motor obeys no move.
    assert talk(box, b"A:1+P16777215\r\nM:1-P16777215\r\n") == b"OK\r\nNG\r\n"
    assert talk(box, b"?:-\r\nG\r\nc:10\r\n") == b"001\r\nNG\r\nOK\r\n"
    assert talk(box, b"M:1+P400\r\nH:1\r\nC:11\r\nm:1+p400\r\n") == b"NG\r\nNG\r\nOK\r\nOK\r\n"


def test_a_gsc_stops_at_the_end_of_its_travel_and_says_so() -> None:
    for kind, status in (("gsc-01", b"      4000,K,L,R\r\n"), ("gsc-02", b"      4000,         0,K,L,R\r\n")):
        box, clock = emulator(kind, limits_deg=(-10.0, 10.0))
        box.axes[0].call_position(0.0)
        for text in (b"M:1+P8000\r\n", b"G:\r\n" if kind == "gsc-01" else b"G\r\n"):
            talk(box, text)
        clock.sleep_s(60.0)
        assert talk(box, b"Q:\r\n") == status
        assert box.axes[0].position_deg() == 10.0


def test_speeds_of_a_gsc_belong_to_their_axes() -> None:
    box, _ = emulator("gsc-02")
    assert talk(box, b"D:2S100F4000R200S500F8000R0\r\nQ:\r\n").endswith(b",K,K,R\r\n")
    assert [axis.speed_deg_s for axis in box.axes] == [10.0, 20.0]
    assert box.axes[0].acceleration_deg_s2 == pytest.approx(50.0)
    for wrong in (b"D:1S100F4000R200S100F100R0", b"D:2S100F4000R200", b"D:2S40F4000R200S100F4000R200"):
        assert talk(box, wrong + b"\r\nQ:\r\n").endswith(b",X,K,R\r\n")
    box, _ = emulator("gsc-01")
    assert talk(box, b"D:1S500F4050R200\r\nD:1S50F5000R200\r\n") == b"OK\r\nNG\r\n"
    # Whole hundreds of pulses.
    assert box.axes[0].speed_deg_s == 10.0


def test_a_gsc_02_is_silent_and_must_be_told_the_way_home() -> None:
    box, clock = emulator("gsc-02")
    assert talk(box, b"H:1\r\nQ:\r\n") == b"         0,         0,X,K,R\r\n"
    assert talk(box, b"H:W--\r\nQ:\r\n").endswith(b",K,K,B\r\n")
    # Only what is meant for all axes ends homing.
    assert talk(box, b"L:1\r\nQ:\r\n").endswith(b",K,K,B\r\n")
    assert talk(box, b"L:W\r\n") == b""
    clock.sleep_s(60.0)
    assert not box.axes[0].homed
    # It drives at a letter alone and has relative moves only.
    assert talk(box, b"M:W+P400-P800\r\nG:\r\nQ:\r\n").endswith(b",X,K,R\r\n")
    assert talk(box, b"A:1+P400\r\nQ:\r\n").endswith(b",X,K,R\r\n")
    assert talk(box, b"M:1+P16777215\r\nQ:\r\n").endswith(b",X,K,R\r\n")
    assert talk(box, b"M:W+P400-P800\r\nG\r\n") == b""
    clock.sleep_s(60.0)
    assert talk(box, b"Q:\r\n") == b"       400,-      800,K,K,R\r\n"


def test_a_conex_agp_knows_no_speed() -> None:
    box, _ = emulator("conex-agp")
    assert talk(box, b"1VE\r\n").startswith(b"1VE CONEX-AGP")
    assert talk(box, b"1VA?\r\n1TE\r\n") == b"1TED\r\n"
