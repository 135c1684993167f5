"""An emulator at a port of its own, and waiting for what a client does in its own time."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from simulators.clock import FastClock
from simulators.rig.controller_kinds import served_kinds
from simulators.serial.emulator import Emulator
from simulators.serial.serve_options import ServeOptions
from simulators.serial.tcp_port import port_for


@contextmanager
def served(kind: str, speed: float = 20.0, **options: Any) -> Iterator[tuple[Emulator, str]]:
    emulator = served_kinds()[kind](ServeOptions(clock=FastClock(speed), **options))
    with port_for(emulator) as port:
        yield emulator, port.path


def wait_until(state: str, condition: Callable[[], bool], allowed_s: float = 8.0) -> None:
    give_up_s = time.monotonic() + allowed_s
    while not condition():
        if time.monotonic() > give_up_s:
            pytest.fail(f"not within {allowed_s} s: {state}")
        time.sleep(0.01)
