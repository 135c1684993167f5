"""Read a capture for `diagnose`: counts above black, what is clipped, cut off or too dark, and the noise.

Only one frame is in memory as stored, so a large sensor takes no more memory than what is kept of it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.arrays import Array
from processing.calibration.known_sample import known_mueller
from processing.diagnosis.captures.binning import means, side_for, squares
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.dark_noise import without_noise_of_darks
from processing.diagnosis.captures.rounding import Planes, Rounding
from processing.diagnosis.captures.unstated_noise import estimated_noise
from processing.diagnosis.search.rules import FEWEST_PIXELS, LIMIT, LITTLE, MOST_SPOILT
from processing.instrument.changes import Conditions, elapsed, elapsed_error
from processing.instrument.model import InstrumentModel
from processing.reduction.capture_evidence import evidence_of
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.measurement_matrix import angles_of, relative_exposure
from processing.reduction.noise import NoiseModel
from processing.reduction.sample_states import sample_states
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.captures.frame_layout import Cells

#: [pixels] Around dark ones that are left out too: image derivatives over 7 pixels do not tell there what a shift does.
DARK_RIM = 4
#: [intensities] Of a capture that are read; a larger one is averaged over squares of pixels.
MOST_READ = 20_000_000
#: [intensities of a pixel] Beyond which few pixels are kept: second moments of the states would be larger than those.
MANY_VALUES = 160
#: [pixels] That are kept then; of fewer, states are held out and not tiles of the image.
FEW_PIXELS = 64


@dataclass(frozen=True)
class Frames:
    """Frames of a capture as they were read.

    Attributes
    ----------
    counts : (N, channels, rows, columns) above black, means over squares of `side` pixels of a channel.
    top : largest count above black before averaging.
    clipped : (rows, columns) some pixel of the square is at the top of the range in some state.
    clipped_states : (N,) in which some pixel is.
    zero : (N, rows, columns) some pixel of the square is cut off at zero; zero_share : (N,) share of the pixels.
    rounding : (N,) variance, counts^2, that rounding gives the mean of all pixels, which more of them do not average.
    variance_ratio : (N,) variance of a pixel over that with independent errors of rounding; black_variance_ratio : (D,)
        the same of the dark frames of each exposure.
    """

    counts: NDArray[np.float32]
    top: float
    clipped: NDArray[np.bool_]
    clipped_states: NDArray[np.bool_]
    zero: NDArray[np.bool_]
    zero_share: NDArray[np.float64]
    side: int
    rounding: Array
    variance_ratio: Array
    black_variance_ratio: Array


def read_frames(
    capture: Capture, model: InstrumentModel, states: NDArray[np.int64], correction: CountCorrection
) -> Frames:
    """Read some states of a capture one after the other, as `model` sees them."""
    planes_of = _planes_of(model)
    exposure = capture.column("exposure_s")[states].astype(float)
    level, has_zero = _clip_level(capture, correction), _cuts_off(capture)
    counts: list[NDArray[np.float32]] = []
    clipped: list[NDArray[np.bool_]] = []
    zero: list[NDArray[np.bool_]] = []
    share, tops, side = np.zeros(len(states)), [], 1
    rounding, of_rounding = Rounding(capture, planes_of, correction.black), []
    for n, k in enumerate(states):
        frame = capture.frames(int(k)).astype(np.float32)
        over = np.asarray(planes_of(frame >= (np.inf if level is None else level)).any(axis=0))
        under = np.asarray(planes_of((frame <= 0) & has_zero).any(axis=0))
        shift, unsure, ratio = rounding.of_frame(int(k), frame)
        frame -= correction.black.at(exposure[n])
        planes = planes_of(frame if correction.flat is None else frame / correction.flat.response)
        planes = planes + shift.astype(np.float32)[:, None, None] if shift.any() else planes
        of_rounding.append((unsure.max(), ratio.mean()))
        side = _side(len(states) * len(planes), *planes.shape[1:])
        tops.append(float(planes.max(initial=-np.inf, where=np.isfinite(planes))))
        share[n] = under.mean()
        counts.append(means(planes, side))
        clipped.append(np.asarray(squares(over, side).any(axis=(-3, -1))))
        zero.append(np.asarray(squares(under, side).any(axis=(-3, -1))))
    over_states = np.stack(clipped)
    return Frames(
        counts=np.stack(counts),
        top=max(tops),
        clipped=np.asarray(over_states.any(axis=0)),
        clipped_states=np.asarray(over_states.any(axis=(1, 2))),
        zero=np.stack(zero),
        zero_share=share,
        side=side,
        rounding=np.array(of_rounding)[:, 0],
        variance_ratio=np.array(of_rounding)[:, 1],
        black_variance_ratio=rounding.of_black[:, 3].mean(axis=1),
    )


def _planes_of(model: InstrumentModel) -> Planes:
    """Function that makes frames (channels, rows, columns) of stored ones, which with a mosaic are one."""
    if model.mosaic is None:
        return lambda frames: frames
    cells, rows, columns = Cells(model.mosaic, tuple(c.name for c in model.channels)), *np.shape(model.mosaic)

    def planes(frames: NDArray[Any]) -> NDArray[Any]:
        height, width = frames.shape[1] // rows * rows, frames.shape[2] // columns * columns
        return cells.split(frames[0, :height, :width])

    return planes


def _side(values: int, height: int, width: int) -> int:
    """Side of the squares of pixels that are averaged, of images with so many values in each pixel."""
    side = side_for(values * height * width, MOST_READ)
    if values > MANY_VALUES:
        side = max(side, int(np.ceil(np.sqrt(height * width / FEW_PIXELS))))
    return side


def _cuts_off(capture: Capture) -> bool:
    """Whether noise cannot reach zero counts, so that they mean a black level that is too low."""
    detector = capture.header.detector
    if not capture.integer_counts or detector.gain_e_per_count is None:
        return False
    return detector.black_level_counts > LIMIT * (detector.read_noise_e or 0.0) / detector.gain_e_per_count


def _clip_level(capture: Capture, correction: CountCorrection) -> float | None:
    detector, level = capture.header.detector, correction.saturation
    if detector.full_well_e is not None and detector.gain_e_per_count is not None:
        well = detector.black_level_counts + detector.full_well_e / detector.gain_e_per_count
        spread = LIMIT * (detector.read_noise_e or 0.0) / detector.gain_e_per_count
        level = well - spread if level is None else min(level, well - spread)
    return level


def read_capture(capture: Capture, model: InstrumentModel) -> CaptureData:
    """Read the sample states of a capture; `model` is resolved at its wavelength.

    Raises CaptureError: nothing to compare, or angles that the model does not have.
    """
    states = sample_states(capture)
    angles_of(capture, model, states)
    correction = CountCorrection.of(capture)
    frames = read_frames(capture, capture.adapt(model), states, correction)
    raw, side = frames.counts, frames.side
    cut_off = frames.zero_share > MOST_SPOILT
    if cut_off.all():
        raise CaptureError(f"{capture.path}: the counts of every state are cut off at zero. Raise the black level.")
    names = tuple(c.name for c in model.channels)
    detector = capture.header.detector
    top = frames.top if detector.range_counts is None else detector.range_counts
    angles = {name: value[states] for name, value in capture.angles_deg.items()}
    host_s, camera_s = capture.column("host_time_s")[states], capture.column("camera_time_ns")[states] * 1e-9
    when, when_error = elapsed(host_s, len(states)), elapsed_error(host_s, camera_s)
    exposure = relative_exposure(capture, states)
    kind = capture.header.sample.kind
    data = CaptureData(
        name=capture.name,
        signal=np.nan_to_num(raw / np.float32(top)),
        conditions=Conditions(angles, len(states), names, when, top, capture.run_of_states[states], when_error),
        exposure=exposure,
        sample=None if kind == "unknown" else known_mueller(capture.header.sample).reshape(16),
        slope=np.zeros(len(states)),
        # Where it is not known, what counts are weighted with does not matter.
        floor=np.full(len(states), (LITTLE * float(np.mean(raw)) / top) ** 2),
        noise_known=False,
        noise_source="not known: too few pixels and no detector constants; the residual itself is the measure",
        clipped=frames.clipped,
        clipped_states=frames.clipped_states,
        usable=np.asarray(np.isfinite(raw).all(axis=(0, 1)) & ~frames.zero[~cut_off].any(axis=0)),
        evidence=evidence_of(capture),
        simulated=capture.simulated,
        wavelength_nm=capture.header.wavelength_nm,
        binned=side,
        pitch=model.pitch * side,
        place_px=_places_px(capture.adapt(model), side),
        rounding=frames.rounding / top**2,
        cut_off=tuple(np.flatnonzero(cut_off).tolist()),
    )
    repeats = np.maximum(capture.column("repeats")[states].astype(float), 1)
    noise = NoiseModel.of(detector, capture.integer_counts)
    if noise is not None:
        excess = correction.black.excess(noise, capture.column("exposure_s")[states])
        slope, floor = noise.slope / repeats / top, noise.averaged_floor(repeats, excess) / top**2
        slope, floor = slope * frames.variance_ratio / side**2, floor * frames.variance_ratio / side**2
        data = replace(data, slope=slope, floor=floor, noise_known=True, noise_source=noise.source)
    stated = capture.sigma
    black = correction.black
    if noise is not None and stated is None:
        of_means = black.mean_variance(noise) * frames.black_variance_ratio
        data = without_noise_of_darks(data, capture, model, states=states, black=black, variance=of_means)
    if stated is not None:
        floor = (stated[states] / top / side) ** 2
        data = replace(
            data, slope=np.zeros(len(states)), floor=floor, noise_known=True, noise_source="stated per state"
        )
    if not data.noise_known and data.usable.sum() >= FEWEST_PIXELS:
        data = estimated_noise(data)
        if black.measured:
            of_means = np.where(np.isnan(black.scatter), data.floor.mean() * (top * side) ** 2, black.scatter)
            of_means = of_means / black.states
            data = without_noise_of_darks(data, capture, model, states=states, black=black, variance=of_means)
            data = estimated_noise(data)
    return without_dark_pixels(data) if data.noise_known else data


def _places_px(model: InstrumentModel, side: int) -> Array | None:
    """Position of each channel of a mosaic (channels, 2), from the middle of a super-pixel, in pixels as read."""
    if model.mosaic is None:
        return None
    where = {name: (c, r) for r, line in enumerate(model.mosaic) for c, name in enumerate(line)}
    places = np.array([where[channel.name] for channel in model.channels], dtype=float)
    return np.asarray((places - places.mean(axis=0)) / (model.pitch * side))


def without_dark_pixels(data: CaptureData) -> CaptureData:
    """The capture without pixels that show nothing but noise, and without the rim around them.

    Raises CaptureError: nothing else is there.
    """
    mean = data.signal.mean(axis=(0, 1), dtype=np.float64)
    dark = mean < LIMIT * np.sqrt(np.maximum(data.slope.mean() * mean + data.floor.mean(), 0))
    if dark.all():
        raise CaptureError(
            f"{data.name}: no pixel has a mean signal above {LIMIT:g} standard deviations of its noise. "
            "Expose longer, or look whether the light was on."
        )
    wide = ndimage.binary_dilation(dark, structure=np.ones((3, 3), dtype=bool), iterations=DARK_RIM)
    dark = dark if wide.all() else wide
    return replace(data, usable=data.usable & ~dark, dark_fraction=float(dark.mean()))
