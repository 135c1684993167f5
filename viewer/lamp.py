"""The light of the lamp through a capture, separated from the effect of polarization on the mean of a frame.

The mean of a frame, dark subtracted, is linear in the mean Mueller matrix of the scene: sixteen numbers explain it in
every state, and what is left over, in parts of the fit, is the lamp. States that repeat the first pose see the same
polarization, and tell the lamp without any model.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.reduction.effects_of_capture import capture_changes
from processing.reduction.measurement_matrix import angles_of
from processing.storage.captures.capture import Capture

#: Leverage above which the other states do not determine one: the noise of its lamp would be ten times its own.
TELLING = 0.9
#: States more than unknowns before a fit tells anything.
SPARE = 4


def lamp(capture: Capture) -> dict[str, Any]:
    """Ratio of measured to expected light of each light state: states, ratio, and the method in words."""
    light = np.flatnonzero([role != "dark" for role in capture.role])
    if not light.size:
        return {"states": [], "ratio": [], "told": "no light state is done yet"}
    signal = _dark_corrected(capture, light)
    try:
        fitted = _fitted(capture, light, signal)
    except ProcessError as error:
        return {"states": [], "ratio": [], "told": str(error)}
    if fitted is not None:
        method = "dark-corrected mean of each state over what polarization makes of it by the other states"
        return _lamp_entry(capture, light, signal / fitted, method)
    repeats = _repeats(capture, light)
    if repeats.sum() > 1:
        method = f"dark-corrected mean of the {int(repeats.sum())} states that repeat the pose of the first one"
        return _lamp_entry(capture, light[repeats], signal[repeats] / signal[repeats][0], method)
    method = "shown once enough states separate the lamp from polarization"
    return {"states": [], "ratio": [], "told": method}


def _lamp_entry(capture: Capture, states: NDArray[np.int64], ratio: NDArray[np.float64], method: str) -> dict[str, Any]:
    keep = np.isfinite(ratio)
    return {"states": capture.done[states][keep].tolist(), "ratio": ratio[keep].tolist(), "told": method}


def _dark_corrected(capture: Capture, light: NDArray[np.int64]) -> NDArray[np.float64]:
    """Counts a second above the dark states of the same exposure, else above the declared black level."""
    monitor, exposure_s = capture.column("monitor").astype(float), capture.column("exposure_s").astype(float)
    signal = monitor[light].copy()
    dark = capture.states_with("dark")
    for k, state in enumerate(light):
        matching = dark[np.isclose(exposure_s[dark], exposure_s[state])]
        if matching.size:
            signal[k] -= monitor[matching].mean()
    return signal


def _repeats(capture: Capture, light: NDArray[np.int64]) -> NDArray[np.bool_]:
    targets = capture.planned_targets_deg()
    exposure_s = capture.column("exposure_s")[light]
    is_same = np.isclose(exposure_s, exposure_s[0])
    for column in targets.values():
        angle_deg = np.abs(column[capture.done[light]] - column[capture.done[light[0]]]) % 360
        is_same &= np.minimum(angle_deg, 360 - angle_deg) < 0.01
    return np.asarray(is_same)


def _fitted(capture: Capture, light: NDArray[np.int64], signal: NDArray[np.float64]) -> NDArray[np.float64] | None:
    model = capture.instrument
    if model is None or not model.axes:
        return None
    changes = capture_changes(capture, model, light)
    # Beams and the analyzers of a mosaic have as many pixels each: the mean of a frame is that of all.
    w = model.rows(angles_of(capture, model, light), changes).mean(axis=1)
    is_finite = np.isfinite(signal)
    if is_finite.sum() < np.linalg.matrix_rank(w[is_finite], rtol=1e-6) + SPARE:
        return None
    return np.asarray(_predict_from_others(w, signal, is_finite))


def _predict_from_others(
    w: NDArray[np.float64], signal: NDArray[np.float64], valid: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Prediction of each state by the others: a fit with all of them would follow a flash halfway."""
    u, s, _ = np.linalg.svd(w[valid], full_matrices=False)
    u = u[:, s > 1e-8 * s[0]]
    leverage = np.square(u).sum(axis=1)
    residual = signal[valid] - u @ (u.T @ signal[valid])
    out = np.full(len(signal), np.nan)
    # A state that alone tells one of the numbers tells nothing of the lamp.
    with np.errstate(divide="ignore", invalid="ignore"):
        out[valid] = np.where(leverage < TELLING, signal[valid] - residual / (1 - leverage), np.nan)
    return out
