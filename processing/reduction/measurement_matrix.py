"""The measurement matrix W of a capture: from the angles read back, scaled with the exposure."""

import numpy as np
from numpy.typing import NDArray

from processing.instrument.changes import Changes
from processing.instrument.model import InstrumentModel
from processing.reduction.effects_of_capture import extra_retardance, with_extra
from processing.reduction.instrument_of_capture import require_belongs, require_one_colour
from processing.reduction.solvers.field import Field
from processing.storage.captures.capture import Capture, CaptureError


def angles_of(capture: Capture, model: InstrumentModel, states: NDArray[np.int64]) -> dict[str, NDArray[np.float64]]:
    """Angles as read back, axis name to (states,), in degrees.

    Raises CaptureError: the capture is not of this instrument, or of several colours, or an axis has no angle in some
    state.
    """
    require_one_colour(capture)
    angles = {name: value[states] for name, value in capture.angles_deg.items()}
    require_belongs(capture, model)
    read = [np.isfinite(angles[axis]) for axis in model.axes]
    bad = ~np.all([np.ones(len(states), dtype=bool), *read], axis=0)
    if np.any(bad):
        raise CaptureError(
            f"{capture.path}: no read-back angle in state(s) {short_list(states[bad])}; they cannot be reduced."
        )
    return angles


def measurement_matrix(
    capture: Capture, model: InstrumentModel, states: NDArray[np.int64], changes: Changes | None = None
) -> NDArray[np.float64]:
    """W (states, channels, 16) from the read-back angles, rows scaled with the exposure (longest = 1).

    `changes` is what the model's effects do to this capture (`effects_of_capture.capture_changes`). Raises
    CaptureError: see `angles_of`.
    """
    w = model.rows(angles_of(capture, model, states), changes)
    return w * relative_exposure(capture, states)[:, None, None]


def field_of(
    capture: Capture,
    model: InstrumentModel,
    states: NDArray[np.int64],
    changes: Changes | None,
    *,
    level: NDArray[np.float64] | None = None,
) -> Field | None:
    """W where retardances vary over the image; None where W is the same everywhere.

    `level` (states,) : of the source.
    """
    if changes is None or not changes.field_retardance_rad:
        return None
    angles, exposure = angles_of(capture, model, states), relative_exposure(capture, states)

    def matrix(extra: NDArray[np.float64]) -> NDArray[np.float64]:
        w = model.rows(angles, with_extra(changes, extra)) * exposure[:, None, None]
        return (w if level is None else w * level[:, None, None]).reshape(-1, 16)

    return Field(matrix, lambda x, y: extra_retardance(changes, x, y))


def exposure_fact(capture: Capture, states: NDArray[np.int64]) -> dict[str, float]:
    """Exposure in seconds that the counts of a product refer to, the longest of the states; none if not known."""
    exposure = capture.column("exposure_s")[states].astype(float)
    return {"exposure_s": float(exposure.max())} if np.isfinite(exposure).all() else {}


def relative_exposure(capture: Capture, states: NDArray[np.int64]) -> NDArray[np.float64]:
    """Exposure of each state over the longest one, (states,); 1 where the capture does not know exposures."""
    exposure = capture.column("exposure_s")[states].astype(float)
    if not np.any(np.isfinite(exposure)):
        return np.ones(len(states))
    if not np.all(np.isfinite(exposure)) or np.any(exposure <= 0):
        raise CaptureError(
            f"{capture.path}: exposure_s is given for some states only, or not positive; give it for all or none."
        )
    return np.asarray(exposure / exposure.max())


def short_list(values: NDArray[np.int64]) -> str:
    """The first five numbers, for a message."""
    shown = ", ".join(str(v) for v in values[:5])
    return shown + (" ..." if len(values) > 5 else "")
