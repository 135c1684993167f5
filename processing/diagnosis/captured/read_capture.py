"""Read a capture for `diagnose`: counts above black, what is clipped, cut off or too dark, and the noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.calibration.train import known_mueller
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.noise_estimate import estimated_noise
from processing.instrument.changes import Conditions, elapsed
from processing.instrument.model import InstrumentModel
from processing.reduction.counts_to_signal import Correction
from processing.reduction.mueller import angles_of, relative_exposure, sample_states
from processing.reduction.noise import NoiseModel
from processing.storage.capture import Capture, CaptureError

#: Values of a capture that are kept; a larger one is averaged over squares of pixels first.
MOST_VALUES = 40_000_000
#: Pixels whose mean signal is less than this many standard deviations of one intensity are left out: logarithms and
#: powers of such counts do not scatter in proportion to the noise, and they say nothing about polarization.
FAINTEST = 5.0
#: Pixels around dark ones that are left out too: at an edge, image derivatives (over 7 pixels) do not tell what a shift
#: of the image does.
RIM = 4
#: Counts of zero this many standard deviations of the read-out below black are cut off, not noise.
CUT_OFF = 6.0
#: A state is left out if more than this share of its pixels is cut off.
MOST_CUT_OFF = 0.01
#: Below this number of pixels their scatter says nothing about the noise.
FEWEST_PIXELS = 30


def read_capture(capture: Capture, model: InstrumentModel) -> CaptureData:
    """Read the sample states of a capture; `model` is resolved at its wavelength.

    Raises
    ------
    CaptureError : nothing to compare, or angles that the model does not have.
    """
    states = sample_states(capture)
    angles_of(capture, model, states)
    correction = Correction.of(capture)
    raw, clipped, clipped_states, zero = _frames(capture, capture.seen(model), states, correction)
    cut_off = zero.mean(axis=(1, 2)) > MOST_CUT_OFF
    if cut_off.all():
        raise CaptureError(f"{capture.path}: the counts of every state are cut off at zero. Raise the black level.")
    names = tuple(c.name for c in model.channels)
    if raw.shape[1] != len(names):
        raise CaptureError(
            f"{capture.path}: {raw.shape[1]} channel(s), the instrument {model.name!r} has {len(names)}. "
            "Use the instrument file that belongs to the capture."
        )
    detector, integer = capture.header.detector, capture.integer_counts
    top = float(2**detector.bits - 1) - detector.black_level_counts if integer and detector.bits else float(raw.max())
    angles = {name: value[states] for name, value in capture.angles_deg.items()}
    when = elapsed(capture.column("host_time_s")[states], len(states))
    exposure = relative_exposure(capture, states)
    kind = capture.header.sample.kind
    data = CaptureData(
        name=f"{capture.header.title} ({capture.path.name})",
        signal=raw / np.float32(top),
        conditions=Conditions(angles, len(states), names, when, top),
        exposure=exposure,
        sample=None if kind == "unknown" else known_mueller(capture.header.sample).reshape(16),
        slope=np.zeros(len(states)),
        floor=np.full(len(states), (1e-3 * float(np.mean(raw)) / top) ** 2),
        noise_known=False,
        noise_source="not known: too few pixels and no detector constants; the residual itself is the measure",
        clipped=clipped,
        clipped_states=clipped_states,
        usable=np.asarray(np.isfinite(raw).all(axis=(0, 1)) & ~zero[~cut_off].any(axis=0)),
        simulated=capture.simulated,
        wavelength_nm=capture.header.wavelength_nm,
        pitch=model.pitch,
        cut_off=tuple(np.flatnonzero(cut_off).tolist()),
    )
    data = replace(data, signal=np.nan_to_num(data.signal))
    repeats = np.maximum(capture.column("repeats")[states].astype(float), 1)
    noise = NoiseModel.of(detector, integer)
    if noise is not None:
        excess = correction.black.excess(noise, capture.column("exposure_s")[states])
        slope, floor = noise.slope / repeats / top, noise.averaged_floor(repeats, excess) / top**2
        data = replace(data, slope=slope, floor=floor, noise_known=True, noise_source=noise.source)
    stated = capture.sigma
    if stated is not None:
        floor = (stated[states] / top) ** 2
        data = replace(
            data, slope=np.zeros(len(states)), floor=floor, noise_known=True, noise_source="stated per state"
        )
    data = _binned(data)
    if not data.noise_known and data.usable.sum() >= FEWEST_PIXELS:
        data = estimated_noise(data)
    return without_dark_pixels(data) if data.noise_known else data


def without_dark_pixels(data: CaptureData) -> CaptureData:
    """The capture without pixels that show nothing but noise, and without the rim around them.

    Raises
    ------
    CaptureError : nothing else is there.
    """
    mean = data.signal.mean(axis=(0, 1), dtype=np.float64)
    dark = mean < FAINTEST * np.sqrt(np.maximum(data.slope.mean() * mean + data.floor.mean(), 0))
    if dark.all():
        raise CaptureError(
            f"{data.name}: no pixel has a mean signal above {FAINTEST:g} standard deviations of its noise. "
            "Expose longer, or look whether the light was on."
        )
    wide = ndimage.binary_dilation(dark, structure=np.ones((3, 3), dtype=bool), iterations=RIM)
    dark = dark if wide.all() else wide
    return replace(data, usable=data.usable & ~dark, dark_fraction=float(dark.mean()))


def _frames(
    capture: Capture, model: InstrumentModel, states: NDArray[np.int64], correction: Correction
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.bool_], NDArray[np.bool_]]:
    """Counts (N, channels, rows, columns), clipped pixels, clipped states, (N, rows, columns) cut off at zero."""
    level = _clip_level(capture, correction)
    frames, clipped = [], np.zeros(capture.frame_shape, dtype=bool)
    zero = np.zeros((len(states), *capture.frame_shape), dtype=bool)
    has_zero = _cuts_off(capture)
    clipped_states = np.zeros(len(states), dtype=bool)
    exposure = capture.column("exposure_s")[states].astype(float)
    for n, k in enumerate(states):
        frame = capture.frames(int(k)).astype(np.float32)
        if level is not None:
            over = (frame >= level).any(axis=0)
            clipped |= over
            clipped_states[n] = over.any()
        if has_zero:
            zero[n] = (frame <= 0).any(axis=0)
        frame -= correction.black.at(exposure[n])
        frames.append(frame if correction.flat is None else frame / correction.flat.response)
    raw = np.stack(frames)
    if model.mosaic is None:
        return raw, np.asarray(clipped), clipped_states, zero
    rows, columns = len(model.mosaic), len(model.mosaic[0])
    height, width = raw.shape[2] // rows * rows, raw.shape[3] // columns * columns
    raw = raw[:, :, :height, :width]
    where = {name: (r, c) for r, line in enumerate(model.mosaic) for c, name in enumerate(line)}
    planes = [raw[:, 0, where[c.name][0] :: rows, where[c.name][1] :: columns] for c in model.channels]
    cells = (height // rows, rows, width // columns, columns)
    over = np.asarray(clipped[:height, :width].reshape(cells).any(axis=(1, 3)))
    under = np.asarray(zero[:, :height, :width].reshape(-1, *cells).any(axis=(2, 4)))
    return np.stack(planes, axis=1), over, clipped_states, under


def _cuts_off(capture: Capture) -> bool:
    """Whether noise cannot reach zero counts, so that they mean a black level that is too low."""
    detector = capture.header.detector
    if not capture.integer_counts or detector.gain_e_per_count is None:
        return False
    return detector.black_level_counts > CUT_OFF * (detector.read_noise_e or 0.0) / detector.gain_e_per_count


def _clip_level(capture: Capture, correction: Correction) -> float | None:
    detector, level = capture.header.detector, correction.saturation
    if detector.full_well_e is not None and detector.gain_e_per_count is not None:
        well = detector.black_level_counts + detector.full_well_e / detector.gain_e_per_count
        spread = 4 * (detector.read_noise_e or 0.0) / detector.gain_e_per_count
        level = well - spread if level is None else min(level, well - spread)
    return level


def _binned(data: CaptureData) -> CaptureData:
    n, c, height, width = data.signal.shape
    side = int(np.ceil(np.sqrt(data.signal.size / MOST_VALUES)))
    # Many states: the second moments of the states would be larger than the pixels themselves.
    if n * c > 160:
        side = max(side, int(np.ceil(np.sqrt(height * width / 64))))
    if side <= 1:
        return data
    h, w = height // side, width // side
    squares = data.signal[:, :, : h * side, : w * side].reshape(n, c, h, side, w, side)

    def whole(mask: NDArray[np.bool_], how: str) -> NDArray[np.bool_]:
        blocks = mask[: h * side, : w * side].reshape(h, side, w, side)
        return np.asarray(getattr(blocks, how)(axis=(1, 3)))

    return replace(
        data,
        signal=squares.mean(axis=(3, 5), dtype=np.float64).astype(np.float32),
        slope=data.slope / side**2,
        floor=data.floor / side**2 if data.noise_known else data.floor,
        clipped=whole(data.clipped, "any"),
        usable=whole(data.usable, "all"),
        binned=side,
        pitch=data.pitch * side,
    )
