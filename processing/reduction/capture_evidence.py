"""Evidence against the frames of a capture, from its file."""

import numpy as np

from processing.reduction.frame_evidence import FrameFinding, Kind, brightness_steps
from processing.storage.captures.capture import Capture


def evidence_of(capture: Capture) -> tuple[str, ...]:
    """Evidence against the frames of a capture, in words: reports of its runs, and findings in its columns."""
    record = capture.closing.get("evidence")
    reported = [entry for entry in record if isinstance(entry, dict)] if isinstance(record, list) else []
    texts = [str(entry.get("text", "")) for entry in reported]
    kinds = {(entry.get("kind"), entry.get("state")) for entry in reported}
    findings = [*_identical(capture), *_numbers_again(capture), *_steps(capture)]
    return tuple(dict.fromkeys([*texts, *(f.text for f in findings if (f.kind, f.state) not in kinds)]))


def _identical(capture: Capture) -> list[FrameFinding]:
    first: dict[bytes, int] = {}
    again: dict[int, list[int]] = {}
    for k, sums in enumerate(capture.row_sums()):
        # A frame of one value, as one that is saturated everywhere, has equal rows.
        if len(sums) > 1 and np.any(sums != sums[0]):
            earlier = first.setdefault(sums.tobytes(), k)
            if earlier != k:
                again.setdefault(earlier, []).append(int(capture.done[k]))
    return [
        FrameFinding(
            states[0],
            "identical",
            f"{len(states)} states have the frame of state {capture.done[earlier]}, pixel by pixel, the first of them "
            f"state {states[0]}: the camera was frozen, and what is made of them is wrong. Take the capture again",
        )
        for earlier, states in again.items()
    ]


def _numbers_again(capture: Capture) -> list[FrameFinding]:
    """Frame numbers and times of the camera's clock that two states of one run share."""
    findings: list[FrameFinding] = []
    columns: tuple[tuple[Kind, str, str], ...] = (
        ("number", "frame_id", "frame number"),
        ("time", "camera_time_ns", "time of the camera's clock"),
    )
    for kind, name, quantity in columns:
        values = capture.column(name)
        for run in np.unique(capture.run_of_states):
            index = np.flatnonzero((capture.run_of_states == run) & (values != 0))
            again = index[1:][values[index[1:]] == values[index[:-1]]]
            if again.size:
                state = int(capture.done[again[0]])
                text = f"{again.size} states have the {quantity} of the state before, the first of them state {state}"
                findings.append(FrameFinding(state, kind, text))
    return findings


def _steps(capture: Capture) -> list[FrameFinding]:
    """Steps of the brightness in each run, by the mean of each frame that `acquire` noted."""
    model, findings = capture.instrument, []
    if model is None or not model.axes:
        return []
    for run in np.unique(capture.run_of_states):
        light = [role not in ("dark", "flat") for role in capture.role]
        chosen = np.flatnonzero(np.array(light) & (capture.run_of_states == run))
        monitor = capture.column("monitor")[chosen].astype(float)
        if not len(chosen) or not np.isfinite(monitor).all() or not set(model.axes) <= capture.angles_deg.keys():
            continue
        angles = {axis: capture.angles_deg[axis][chosen] for axis in model.axes}
        if not all(np.isfinite(column).all() for column in angles.values()):
            continue
        rows = model.model_copy(update={"effects": ()}).rows(angles).mean(axis=1)
        findings += brightness_steps(capture.done[chosen], rows, monitor)
    return findings
