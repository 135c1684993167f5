"""`acquire stop`: every axis of a rig is sent a stop, also while another program measures on it.

A program that measures holds its serial ports for itself, and two programs on one line would garble each other. So a
running `acquire` is told to stop, with the two signals that a second Ctrl-C amounts to: it stops its axes within a
second and keeps its partial file. Once it has let go of the ports, the stop is sent again from here and the axes are
watched until they rest. Other programs are named and left alone: what they do with a signal is not known.
"""

import os
import signal
import time
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from acquisition.rig.config import RigConfig, clock_of
from drivers.errors import CommandRejected, DeviceError, PortBusy
from drivers.motion import AxisConfig, MotionAxis
from drivers.registry import open_axis
from drivers.serial_link import LineRegistry
from drivers.serial_ports import port_holders

#: Longest wait for a running `acquire` to seal its file and let go of the ports.
LET_GO_S = 15.0
#: Longest time for which a program that is gone still holds a port.
DYING_S = 2.0
#: Longest wait for rest after a stop; an Elliptec runs a started move to its end.
REST_S = 5.0
REST_UNSTOPPABLE_S = 30.0

Tell = Callable[[str], None]


def stop_axes(config: RigConfig, tell: Tell, let_go: Collection[int] = ()) -> bool:
    """Stop every axis, each line for itself so that a silent one holds up no other; True if all came to rest.

    Parameters
    ----------
    tell : prints a line, from several threads.
    let_go : processes that are ending: their ports are waited for.
    """
    lines: dict[str, dict[str, AxisConfig]] = {}
    for name, entry in config.axes.items():
        lines.setdefault(os.path.realpath(entry.port), {})[name] = entry
    pids = set(let_go) or _tell_running(list(lines), tell)
    with LineRegistry(clock=clock_of(config)) as registry, ThreadPoolExecutor(max(1, len(lines))) as threads:
        results = threads.map(lambda port: _stop_line(port, lines[port], registry, pids, tell=tell), lines)
        return all(list(results))


def _tell_running(ports: list[str], tell: Tell) -> set[int]:
    """Signal every running `acquire` that holds one of the ports; returns their process ids."""
    holders = {pid: program for port in ports for pid, program in port_holders(port) if pid != os.getpid()}
    pids = set()
    for pid, program in holders.items():
        if not _is_acquire(pid):
            tell(f"{program} holds a port of this rig; it is not acquire and gets no signal")
            continue
        try:
            # Two different signals: a second one of the same kind could merge with the first.
            os.kill(pid, signal.SIGINT)
            os.kill(pid, signal.SIGTERM)
        except ProcessLookupError:
            continue
        except PermissionError:
            tell(f"{program} measures on this rig under another user: stop it there, with Ctrl-C twice")
            continue
        tell(f"{program} measures on this rig: asked to stop at once, as by Ctrl-C twice")
        pids.add(pid)
    return pids


def _is_acquire(pid: int) -> bool:
    try:
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except OSError:
        return False
    return any(Path(word).name == "acquire" for word in words[:2]) or "acquisition.commands.application" in words[:3]


def _stop_line(
    port: str, entries: Mapping[str, AxisConfig], lines: LineRegistry, pids: set[int], *, tell: Tell
) -> bool:
    _wait_let_go(port, pids)
    axes = []
    busy: dict[str, AxisConfig] = {}
    for name, entry in entries.items():
        try:
            axes.append(_stop_let_go(name, entry, lines) if pids else _stop_axis(name, entry, lines))
        except CommandRejected as error:
            tell(f"{name}: answers no question now ({error.came_back}); asked again until it does")
            busy[name] = entry
        except DeviceError as error:
            _tell_failed(name, error, tell)
    # An Elliptec module refuses everything while it moves, and would not stop anyway.
    for name, entry in busy.items():
        try:
            axes.append(_stop_when_free(name, entry, lines))
        except DeviceError as error:
            _tell_failed(name, error, tell)
    rested = [_rests(axis, tell) for axis in axes]
    return len(axes) == len(entries) and all(rested)


def _stop_axis(name: str, entry: AxisConfig, lines: LineRegistry) -> MotionAxis:
    axis = open_axis(name, entry, lines)
    axis.stop()
    return axis


def _stop_let_go(name: str, entry: AxisConfig, lines: LineRegistry) -> MotionAxis:
    """Stop an axis whose port a program has just let go of: one that dies holds it a moment longer than it is seen."""
    end_s = time.monotonic() + DYING_S
    while True:
        try:
            return _stop_axis(name, entry, lines)
        except PortBusy:
            if time.monotonic() > end_s:
                raise
            time.sleep(0.02)


def _stop_when_free(name: str, entry: AxisConfig, lines: LineRegistry) -> MotionAxis:
    end_s = lines.clock.now_s() + REST_UNSTOPPABLE_S
    while True:
        try:
            return _stop_axis(name, entry, lines)
        except CommandRejected:
            if lines.clock.now_s() > end_s:
                raise
            lines.clock.sleep_s(0.1)


def _tell_failed(name: str, error: DeviceError, tell: Tell) -> None:
    outcome = "NOT STOPPED" if isinstance(error, PortBusy) else "not known whether it stopped"
    tell(f"{name}: {outcome}. {error}. If it moves, switch its power off")


def _wait_let_go(port: str, pids: set[int]) -> None:
    # Real time: it is another program that lets go.
    end_s = time.monotonic() + LET_GO_S
    while time.monotonic() < end_s and any(pid in pids for pid, _ in port_holders(port)):
        time.sleep(0.05)


def _rests(axis: MotionAxis, tell: Tell) -> bool:
    note = "" if axis.can_stop_a_move else " (this kind runs a started move to its end)"
    end_s = axis.clock.now_s() + (REST_S if axis.can_stop_a_move else REST_UNSTOPPABLE_S)
    try:
        while axis.is_moving():
            if axis.clock.now_s() > end_s:
                tell(f"{axis.name}: stop sent, STILL MOVING{note}. Switch its power off")
                return False
            axis.clock.sleep_s(axis.config.poll_s)
        where = f"at {axis.read_position().deg:.4f} {axis.config.unit}" if axis.is_homed() else "without a reference"
    except DeviceError as error:
        tell(f"{axis.name}: stop sent, then {error}")
        return False
    tell(f"{axis.name}: stop sent, at rest {where}{note}")
    return True
