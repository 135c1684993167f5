"""Effects of an instrument file (found by `diagnose`) applied to one capture before its reduction."""

from collections import defaultdict
from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from processing.instrument.applied_effects import changes_of, instrument_effects
from processing.instrument.changes import STRAIGHT_BELOW, Changes, Conditions, elapsed, field_terms
from processing.instrument.model import InstrumentModel
from processing.instrument.nominal import KIND
from processing.reduction.sample_states import states_of_sample
from processing.storage.captures.capture import Capture


@dataclass(frozen=True)
class CountsCorrection:
    """Correction of the signal u = counts above black over full scale: u + sum of coefficient times feature(u).

    Attributes
    ----------
    full_scale : counts above black.
    response : feature to coefficient, one number or one for each intensity (states, channels).
    shift_px : (states, 2), by how much the image moved to the right and down; it is moved back.
    pitch : pixels from one pixel to the next of its kind: 2 on a polarization mosaic, whose kinds are moved one by one.
    blur_px2 : (states,) or (1,), variance of a blur along each axis, beyond the usual one; it is taken off.
    """

    full_scale: float
    response: dict[str, NDArray[np.float64]]
    shift_px: NDArray[np.float64]
    pitch: int = 1
    blur_px2: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))

    @property
    def moves(self) -> bool:
        """Whether any state's image has moved, or is blurred."""
        return bool(np.any(self.shift_px) or np.any(self.blur_px2))

    def apply(self, signal: NDArray[np.float32], x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
        """Correct signals (states, channels, pixels) in counts above black, in place.

        Of pixels at x and y (pixels,), from -1 to 1 to the right and down.
        """
        if not self.response:
            return
        u = signal / np.float32(self.full_scale)
        added = np.zeros_like(u)
        for name, coefficient in self.response.items():
            c = np.asarray(coefficient, dtype=np.float32)
            added += (c.reshape(*c.shape, 1) if c.ndim == 2 else c) * _feature(name, u, x, y)
        signal += added * np.float32(self.full_scale)


def full_scale(capture: Capture, states: NDArray[np.int64]) -> float:
    """Top of the range above black, counts; the largest value of frames whose bits are not known."""
    if (top := capture.header.detector.range_counts) is not None:
        return top
    return float(max(np.nanmax(capture.frames(int(k))) for k in states)) - capture.header.detector.black_level_counts


def capture_changes(capture: Capture, model: InstrumentModel, states: NDArray[np.int64]) -> Changes | None:
    """Changes by the model's effects in some states of a capture; None for a model without effects.

    Effects that belong to single captures (a slip, a drift) count only for those.
    """
    if not model.effects:
        return None
    # An effect counts the states of the sample as `diagnose` saw them, also where some of them are left out here.
    of_sample = states_of_sample(capture)
    of_diagnosis = of_sample if np.isin(states, of_sample).all() else states
    angles = {name: value[of_diagnosis] for name, value in capture.angles_deg.items()}
    channels = tuple(c.name for c in model.channels)
    when = elapsed(capture.column("host_time_s")[of_diagnosis], len(of_diagnosis))
    top, run = full_scale(capture, of_diagnosis), capture.run_of_states[of_diagnosis]
    conditions = Conditions(angles, len(of_diagnosis), channels, when, top, run)
    return changes_of(model, conditions, capture.name).of_states(np.searchsorted(of_diagnosis, states))


def references(capture: Capture, model: InstrumentModel) -> dict[str, str]:
    """Fact `reference` of a product: at which moment it holds, where effects of the capture depend on time."""
    effects = [e for e in model.effects if e.scope == "instrument" or capture.name in e.captures]
    moments = {e.kind: instrument_effects()[e.kind].reference for e in effects if e.kind != KIND}
    texts = [f"{moment} ({kind})" for kind, moment in moments.items() if moment is not None]
    return {"reference": "; ".join(texts)} if texts else {}


def extra_retardance(changes: Changes, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Retardance (elements, pixels), radians, that varies over the image, in the order of `field_retardance_rad`.

    x, y (pixels,) run from -1 to 1, to the right and down.
    """
    parts = [coefficients @ field_terms(x, y) for coefficients in changes.field_retardance_rad.values()]
    return np.stack(parts) if parts else np.zeros((0, np.size(x)))


def with_extra(changes: Changes, extra: NDArray[np.float64]) -> Changes:
    """The changes at a place with these extra retardances (elements,)."""
    retardance = defaultdict(lambda: np.zeros(()), changes.retardance_rad)
    for element, value in zip(changes.field_retardance_rad, extra, strict=True):
        retardance[element] = retardance[element] + float(value)
    shifted = copy(changes)
    shifted.retardance_rad = retardance
    return shifted


def counts_correction(changes: Changes | None, model: InstrumentModel) -> CountsCorrection | None:
    """The part of the changes that acts on the counts; None if there is none."""
    if changes is None:
        return None
    response = {name: np.asarray(value, dtype=float) for name, value in changes.response.items() if np.any(value)}
    counts = CountsCorrection(changes.conditions.full_scale, response, changes.shift_px, model.pitch, changes.blur_px2)
    return counts if response or counts.moves else None


#: Features by which counts are corrected.
FEATURES = ("one", "square", "cube", "fourth", "log", "log_square", "log_cube", "right", "down")


def _feature(
    name: str, u: NDArray[np.float32], x: NDArray[np.float64], y: NDArray[np.float64]
) -> NDArray[np.float32] | np.float32:
    if name == "one":
        return np.float32(1.0)
    if name in ("right", "down"):
        return u * (x if name == "right" else y).astype(np.float32)
    powers = {"square": 2, "cube": 3, "fourth": 4}
    if name in powers:
        return np.asarray(u ** powers[name])
    log = np.log(np.maximum(u, np.float32(STRAIGHT_BELOW)))
    return np.asarray(u * log ** {"log": 1, "log_square": 2, "log_cube": 3}[name])
