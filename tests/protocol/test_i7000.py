"""A relay that opens without a heartbeat: the one device that shuts the light when no program is left."""

import time

import pytest

from drivers.errors import CommandRejected
from drivers.serial_link import LineRegistry
from drivers.sources import i7000
from simulators.clock import FastClock, patient_clock
from simulators.controllers.i7000 import I7060Emulator
from simulators.serial.pty_port import PtyPort


@pytest.fixture
def module():
    emulator = I7060Emulator(FastClock(base=patient_clock()))
    with PtyPort(emulator) as port, LineRegistry(clock=patient_clock()) as lines:
        yield emulator, i7000.open(i7000.Config(port=port.path, watchdog_s=0.5), lines)


def test_the_relay_opens_without_a_heartbeat_and_closes_again_when_asked(module):
    emulator, relay = module
    relay.set_light(True)
    for _ in range(10):
        time.sleep(0.1)
        relay.feed()
        assert relay.is_on()
    while emulator.light_at(662):
        time.sleep(0.01)
    assert not relay.is_on()
    # Dark as asked, although the module ignores the command.
    relay.set_light(False)
    relay.set_light(True)
    assert emulator.light_at(662)


def test_a_watchdog_that_runs_out_in_the_middle_is_told(module, monkeypatch):
    emulator, relay = module
    monkeypatch.setattr(relay, "feed", lambda: setattr(emulator, "_status", 0x04))
    with pytest.raises(CommandRejected, match="watchdog has run out"):
        relay.set_light(True)
