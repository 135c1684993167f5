"""Conditions under which a state counts; when one opens, the state is thrown away and the axes are held."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from acquisition.errors import InterlockOpened
from acquisition.rig.rig import Rig
from acquisition.screen.observer import StateReport
from acquisition.stop_request import StopRequest
from processing.storage.captures.capture import Capture

#: Exposure in seconds, then the angles of the axes in the order of their names, whole turns apart the same.
Pose = tuple[float, ...]

#: How often an open interlock is looked at.
LOOK_S = 0.05
#: Start of the reason of an interlock that can close by itself.
WAITABLE = ("the door", "the camera")


def _pose(exposure_s: float, angles_deg: Mapping[str, float]) -> Pose:
    return (float(exposure_s), *(round(float(angles_deg[axis]) % 360, 2) % 360 for axis in sorted(angles_deg)))


@dataclass(frozen=True)
class LightSoFar:
    """Counts per second of a capture's first light state, and of the first at each pose and exposure."""

    first: float | None
    at: Mapping[Pose, float]


def light_so_far(capture: Capture) -> LightSoFar:
    """The light that a partial capture has measured, as its interlocks saw it."""
    exposure_s, monitor = capture.column("exposure_s"), capture.column("monitor")
    shortest_s = 1.001 * np.nanmin(capture.planned_column("exposure_s"), initial=np.inf)
    states = [k for k, role in enumerate(capture.role) if role != "dark" and exposure_s[k] <= shortest_s]
    monitor_at: dict[Pose, float] = {}
    for k in states:
        pose = _pose(exposure_s[k], {axis: angles[k] for axis, angles in capture.angles_deg.items()})
        monitor_at.setdefault(pose, float(monitor[k]))
    return LightSoFar(float(monitor[states[0]]) if states else None, monitor_at)


class Interlocks:
    """The interlocks of a rig file, looked at before, during and after each state.

    Parameters
    ----------
    warn : called when one opens and closes.
    go_on : True if the plan lets the run go on by itself when it closes again.

    What the lamp and the drift are held against is the light of the capture's first states, in whichever run they were
    taken: `remember` brings it from the file.
    """

    def __init__(self, rig: Rig, warn: Callable[[str], None], go_on: bool) -> None:
        self.rig = rig
        self.warn = warn
        self.go_on = go_on
        self.events: list[dict[str, str | float]] = []
        self._entries = {entry.kind: entry for entry in rig.config.interlocks}
        self._first_light: float | None = None
        self._light_at: dict[Pose, float] = {}

    def remember(self, light: LightSoFar) -> None:
        """Hold what comes against the light of the states that the capture has already."""
        self._first_light, self._light_at = light.first, dict(light.at)

    def open_now(self) -> str | None:
        """Why no state may be taken now, or None."""
        if "door" in self._entries and self.rig.source is not None and self.rig.source.interlock_open():
            return "the door is open"
        entry = self._entries.get("temperature")
        if entry is not None:
            warm = self.rig.require_camera().temperature_c()
            if warm is not None and warm > entry.limit:
                return f"the camera has {warm:.1f} C, more than {entry.limit:g} C"
        return None

    def judge(self, report: StateReport, meant_to_saturate: bool = False) -> str | None:
        """Why this state cannot count, or None; the long exposures of a bracket are meant to saturate."""
        if meant_to_saturate:
            return None
        entry = self._entries.get("saturation")
        if entry is not None and report.saturated_fraction > entry.limit:
            return f"{100 * report.saturated_fraction:.2f} % of the pixels are saturated"
        return None if report.role == "dark" else self._judge_light(report)

    def _judge_light(self, report: StateReport) -> str | None:
        if self._first_light is None:
            self._first_light = report.monitor
        lamp, drift = self._entries.get("lamp"), self._entries.get("drift")
        if lamp is not None and report.monitor <= lamp.limit * self._first_light:
            return f"the light is {100 * report.monitor / self._first_light:.1f} % of that of the first state"
        pose = _pose(report.exposure_s, {axis: p.deg for axis, p in report.positions.items()})
        before = self._light_at.setdefault(pose, report.monitor)
        if drift is not None and abs(report.monitor - before) > drift.limit * abs(before):
            return f"the light has drifted by {100 * (report.monitor / before - 1):+.2f} % since the same pose before"
        return None

    def hold(self, state: int, why: str, stop: StopRequest) -> None:
        """Hold the axes until the interlock is closed again; reason and duration are kept.

        Raises InterlockOpened: the plan does not go on by itself, or waiting cannot help.
        """
        start_s = self.rig.clock.now_s()
        self.rig.stop()
        event: dict[str, str | float] = {"state": float(state), "why": why}
        self.events.append(event)
        self.warn(f"interlock: {why}; the state is discarded, the axes are held")
        # A door may be shut again by now; light that was wrong does not come right by waiting.
        waiting_helps = self.open_now() is not None or why.startswith(WAITABLE)
        if not (self.go_on and waiting_helps):
            raise InterlockOpened(
                f"interlock: {why}. State {state} was discarded and the axes stopped. "
                "Remove the cause, then continue with --resume."
            )
        while self.open_now() is not None and not stop.requested:
            self.rig.clock.sleep_s(LOOK_S)
        event["duration_s"] = round(self.rig.clock.now_s() - start_s, 3)
        self.warn(f"interlock: closed after {event['duration_s']} s, continuing")
