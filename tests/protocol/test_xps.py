"""Newport XPS: what is said on each of its connections, and the position compare output."""

import pytest

from drivers.axes import xps
from drivers.errors import LimitError, MotionStopped
from drivers.serial_link import LineRegistry
from simulators.clock import FastClock, ManualClock, patient_clock
from simulators.controllers import xps as xps_emulator
from simulators.serial.emulator import Emulator
from simulators.serial.serve_options import ServeOptions
from simulators.serial.tcp_port import port_for


def test_xps_bytes() -> None:
    emulator = xps_emulator.make(ServeOptions(clock=FastClock(instant=True)))
    talk, motion = emulator.connect(), emulator.connect()
    for line, request, reply in (
        (talk, b"FirmwareVersionGet(char *)", b"0,XPS-C8 Firmware V2.6.x,EndOfAPI"),
        (talk, b"Login(Administrator,Administrator)", b"0,,EndOfAPI"),
        (talk, b"ObjectsListGet(char *)", b"0,Group1;Group2;;Group1.Pos;Group2.Pos,EndOfAPI"),
        (talk, b"GroupStatusGet(Group1,int *)", b"0,0,EndOfAPI"),
        (talk, b"GroupHomeSearch(Group1)", b"-22,GroupHomeSearch(Group1),EndOfAPI"),
        (talk, b"GroupInitialize(Group1)", b"0,,EndOfAPI"),
        (talk, b"GroupStatusGet(Group1,int *)", b"0,42,EndOfAPI"),
        (motion, b"GroupHomeSearch(Group1)", b"0,,EndOfAPI"),
        (talk, b"GroupStatusGet(Group1,int *)", b"0,11,EndOfAPI"),
        (motion, b"GroupMoveAbsolute(Group1.Pos,-12.500000)", b"0,,EndOfAPI"),
        (talk, b"GroupPositionCurrentGet(Group1.Pos,double *)", b"0,-12.5,EndOfAPI"),
        (motion, b"GroupMoveRelative(Group1.Pos,2.5)", b"0,,EndOfAPI"),
        (talk, b"GroupPositionCurrentGet(Group1,double *)", b"0,-10,EndOfAPI"),
        (talk, b"GroupVelocityCurrentGet(Group1,double *)", b"0,0,EndOfAPI"),
        (motion, b"GroupMoveRelative(Group1,-170)", b"-17,GroupMoveRelative(Group1,-170),EndOfAPI"),
        (motion, b"GroupMoveAbsolute(Group1.Pos,999)", b"-17,GroupMoveAbsolute(Group1.Pos,999),EndOfAPI"),
        (talk, b"GroupStatusGet(Group7,int *)", b"-19,GroupStatusGet(Group7,int *),EndOfAPI"),
    ):
        line.receive(request)
        assert line.take_output() == reply
    buffer = bytearray(b"0,12,EndOfAPI0,1.5,EndO")
    assert (xps.framer(buffer), xps.framer(buffer), bytes(buffer)) == (b"0,12", None, b"0,1.5,EndO")


def test_a_move_of_an_xps_holds_up_its_own_connection_alone() -> None:
    clock = ManualClock()
    emulator = xps_emulator.make(ServeOptions(clock=clock, homed=True))
    talk, motion = emulator.connect(), emulator.connect()
    motion.receive(b"GroupMoveAbsolute(Group1.Pos,90)GroupStatusGet(Group1,int *)")
    talk.receive(b"GroupStatusGet(Group1,int *)")
    assert (motion.take_output(), talk.take_output()) == (b"", b"0,44,EndOfAPI")
    talk.receive(b"GroupMoveAbort(Group1)")
    clock.sleep_s(60.0)
    assert talk.take_output() == b"0,,EndOfAPI"
    assert motion.take_output() == b"-27,,EndOfAPI0,12,EndOfAPI"


def test_jog_and_gathering() -> None:
    clock = ManualClock()
    talk = xps_emulator.make(ServeOptions(clock=clock, homed=True, acceleration_deg_s2=100.0)).connect()

    def answer(request: bytes) -> bytes:
        talk.receive(request)
        return talk.take_output().removesuffix(b",EndOfAPI")

    assert answer(b"GroupJogParametersSet(Group1,5,100)").startswith(b"-22,")
    assert answer(b"GatheringRun(10,8)").startswith(b"-22,")
    assert answer(b"GatheringConfigurationSet(Group1.Pos.CurrentPosition,Group1.Pos.CurrentVelocity)") == b"0,"
    assert answer(b"GroupJogModeEnable(Group1)") == b"0,"
    assert answer(b"GroupStatusGet(Group1,int *)") == b"0,47"
    assert answer(b"GroupMoveAbsolute(Group1,5)").startswith(b"-22,")
    assert answer(b"GroupJogParametersSet(Group1,5,100)") == b"0,"
    assert answer(b"GatheringRun(3,8000)") == b"0,"
    clock.sleep_s(1.5)
    assert answer(b"GatheringCurrentNumberGet(int *,int *)") == b"0,2,500000"
    assert answer(b"GatheringDataGet(1,char *)") == b"0,4.875;5\n"
    assert answer(b"GroupJogModeDisable(Group1)").startswith(b"-22,")
    assert answer(b"GroupJogParametersSet(Group1,0,100)") == b"0,"
    clock.sleep_s(1.0)
    assert answer(b"GatheringDataMultipleLinesGet(1,2,char *)") == b"0,4.875;5\n7.5;0\n"
    assert answer(b"GatheringDataGet(3,char *)").startswith(b"-17,")
    assert answer(b"GroupJogModeDisable(Group1)") == b"0,"
    assert answer(b"GroupStatusGet(Group1,int *)") == b"0,15"


def test_an_xps_puts_out_a_pulse_at_every_step_that_it_passes() -> None:
    emulator = xps_emulator.make(ServeOptions(clock=FastClock(100.0, base=patient_clock()), homed=True))
    with port_for(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        config = xps.Config(port=port.path, group="Group1", direction=-1, zero_deg=5.0, poll_s=0.002)
        axis = xps.open("arm", config, lines)
        axis.start_move(0.0).wait()
        axis.output_pulses(10.0, 10.3, 0.1)
        assert axis.puts_out_pulses()
        axis.start_move(20.0).wait()
        axis.start_move(10.15).wait()
        axis.output_no_pulses()
        axis.start_move(0.0).wait()
        assert not axis.puts_out_pulses()
        # The controller counts the other way round: 10 deg is -5 there.
        pulses_deg = emulator.groups["Group1"].compare.pulses_deg
        assert pulses_deg == pytest.approx([-5.0, -5.1, -5.2, -5.3, -5.3, -5.2])
        for ends in ((10.0, 9.0), (10.0, 10.25), (10.0, 400.0)):
            with pytest.raises(LimitError):
                axis.output_pulses(*ends, 0.1)
    talk = xps_emulator.make(ServeOptions(clock=FastClock(instant=True))).connect()
    talk.receive(b"PositionerPositionCompareSet(Group1.Pos,0,10,0.5)")
    assert talk.take_output() == b"-22,PositionerPositionCompareSet(Group1.Pos,0,10,0.5),EndOfAPI"


class HoldsAnAbortedMotionBack:
    """A connection whose answer to a motion that was aborted arrives only after the next motion has been asked for."""

    def __init__(self, conversation: Emulator) -> None:
        self._conversation = conversation
        self.next_output_s = conversation.next_output_s
        self._moves, self._held = 0, b""

    def receive(self, data: bytes) -> None:
        self._moves += data.count(b"GroupMoveAbsolute")
        self._conversation.receive(data)

    def take_output(self) -> bytes:
        output = self._conversation.take_output()
        if output.startswith(b"-27") and self._moves == 1:
            self._held, output = output, b""
        if self._held and self._moves == 2:
            output, self._held = self._held + output, b""
        return output


def test_the_answer_of_an_aborted_motion_is_not_taken_for_that_of_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    emulator = xps_emulator.make(
        ServeOptions(clock=FastClock(20.0, base=patient_clock()), homed=True, speed_deg_s=10.0)
    )
    connect = emulator.connect
    monkeypatch.setattr(emulator, "connect", lambda: HoldsAnAbortedMotionBack(connect()))
    with port_for(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        axis = xps.open("arm", xps.Config(port=port.path, group="Group1", poll_s=0.002), lines)
        motion = axis.start_move(160.0)
        axis.stop()
        with pytest.raises(MotionStopped):
            motion.wait()
        assert axis.start_move(5.0).wait().deg == pytest.approx(5.0, abs=0.05)
