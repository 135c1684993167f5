"""Reduce the frames of a polarization mosaic to a linear Stokes image: S0, S1, S2, DoLP, AoLP with standard errors."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import NotDetermined
from processing.instrument.applied_effects import changes_at
from processing.instrument.changes import MAD_TO_SIGMA, Changes
from processing.instrument.model import InstrumentModel
from processing.polarization.magnitude import directions, interval
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.cut_off import without_cut_off
from processing.reduction.effects_of_capture import CountsCorrection, capture_changes, counts_correction, references
from processing.reduction.exclusions import Exclusions
from processing.reduction.facts import in_words
from processing.reduction.instrument_of_capture import require_one_colour
from processing.reduction.measurement_matrix import exposure_fact
from processing.reduction.mosaic.demosaic import demosaic
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.mosaic.merge import MergedFrame, merge
from processing.reduction.mosaic.noise import neighbour_correlation, stokes_covariance
from processing.reduction.mosaic.pixel_response import corrected_frame
from processing.reduction.mueller import Progress
from processing.reduction.noise import NoiseModel
from processing.reduction.sample_states import sample_states
from processing.reduction.systematic import Systematic
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane, Step, is_lit
from processing.storage.products.product_writer import ProductWriter

#: The method that docs/mosaic.md found best.
DEFAULT_METHOD = "oriented"
LINEAR = 3

_COVARIANCE = "covariance of (s0, s1, s2): 00, 11, 22, 01, 02, 12"
PLANES = {
    "s0": Plane((), "count", "S0, total intensity"),
    "s1": Plane((), "count", "S1 = I(0) - I(90)"),
    "s2": Plane((), "count", "S2 = I(45) - I(135)"),
    "s0_errors": Plane((), "count", "standard errors of s0"),
    "s1_errors": Plane((), "count", "standard errors of s1"),
    "s2_errors": Plane((), "count", "standard errors of s2"),
    "stokes_covariance": Plane((6,), "count2", _COVARIANCE),
    "dolp": Plane((), "", "degree of linear polarization, without what noise adds to S1^2 + S2^2; over S0"),
    "dolp_errors": Plane((), "", "half the 68 % interval of dolp"),
    "dolp_95": Plane((2,), "", "lower and upper bound of the 95 % interval of dolp"),
    "aolp_deg": Plane((), "degree", "angle of linear polarization, 0 to 180, from +x of the analyzer frame"),
    "aolp_deg_errors": Plane((), "degree", "half the 68 % interval of aolp_deg; 90: any angle"),
    "aolp_deg_95": Plane((2,), "degree", "lower and upper bound of the 95 % interval of aolp_deg"),
    "closure": Plane((), "count", "what the model cannot explain of the four channels: I0 + I90 - I45 - I135 if ideal"),
    "pixel_flags": Plane((), "", f"0 = good; bits: {Mask.meaning()}", np.uint8),
}

_LEFT = "what is uncertain in the instrument; it does not average"
SYSTEMATIC = {
    "s1_systematic": Plane((), "count", f"systematic standard errors of s1 (of S1/S0, times S0): {_LEFT}"),
    "s2_systematic": Plane((), "count", f"systematic standard errors of s2 (of S2/S0, times S0): {_LEFT}"),
    "dolp_systematic": Plane((), "", f"systematic standard errors of dolp: {_LEFT}"),
    "aolp_deg_systematic": Plane((), "degree", f"systematic standard errors of aolp_deg: {_LEFT}"),
}

#: Without light there is no degree and no angle of polarization; S itself is a measurement all the same.
RATIOS = tuple(f"{name}{part}" for name in ("dolp", "aolp_deg") for part in ("", "_errors", "_95", "_systematic"))


def channel_rows(
    capture: Capture, model: InstrumentModel, states: NDArray[np.int64], changes: Changes | None = None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows of W (4, 16), and analyzer rows (4, 3) for (S0, S1, S2), the same in all states.

    Raises
    ------
    CaptureError : the states differ in their generator or analyzer, so their frames cannot be averaged.
    NotDetermined : the channels do not determine a linear Stokes vector.
    """
    angles = {name: values[states] for name, values in capture.angles_deg.items()} if model.axes else {}
    if changes is None:
        rows = model.rows(angles)
        light = model.generator_states(angles)
    else:
        every = angles or {"": np.zeros(len(states))}
        rows, light = model.rows(every, changes), model.generator_states(every, changes)
    if np.ptp(model.rows(angles, changes_at(model, angles)), axis=0).max(initial=0.0) > 1e-6:
        raise CaptureError(
            f"{capture.path}: the {len(states)} states of this mosaic capture have different angles, and one Stokes "
            "image comes from frames that are alike. Capture one generator state, or split the capture."
        )
    # The mean frame belongs to the mean row. rows = kron(a, g), also with what effects do to the channels.
    mean = np.asarray(rows.mean(axis=0))
    analyzers = (mean.reshape(-1, 4, 4) @ light[0] / (light[0] @ light[0]))[:, :LINEAR]
    rank = int(np.linalg.matrix_rank(analyzers))
    if rank < LINEAR:
        raise NotDetermined(f"{capture.path}: the mosaic's analyzers have rank {rank}; a linear Stokes vector needs 3.")
    return mean, np.asarray(analyzers)


def reduce_stokes(
    capture: Capture,
    model: InstrumentModel,
    out: Path,
    steps: tuple[Step, ...],
    *,
    method: str = DEFAULT_METHOD,
    correction: CountCorrection | None = None,
    noise: NoiseModel | None = None,
    response: NDArray[np.float32] | None = None,
    left_out: Exclusions | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write the Stokes image of a mosaic capture; returns the facts that the product holds.

    Several states with the same angles are averaged first. `response` (3, rows, columns) holds the analysis vectors of
    the raw pixels, where they were calibrated; else the channels' ideal ones. Of `left_out` the states count here; its
    pixels belong into `correction`.

    Raises
    ------
    CaptureError, NotDetermined : see `channel_rows`.
    MosaicError : the frame does not hold whole super-pixels.
    """
    mosaic = capture.header.mosaic or model.mosaic
    if mosaic is None:
        raise CaptureError(f"{capture.path} is not a mosaic capture; it reduces to a Mueller image.")
    require_one_colour(capture)
    left_out = left_out or Exclusions()
    states, cut_off = without_cut_off(capture, left_out.rest_of(sample_states(capture), capture.path))
    cut_off = [*left_out.warnings, *cut_off]
    changes = capture_changes(capture, model, states)
    model_rows, analyzers = channel_rows(capture, model, states, changes)
    layout = MosaicLayout.of(mosaic, [c.name for c in model.channels], analyzers)
    systematic = _systematic(capture, model, states)
    correction = correction or CountCorrection.of(capture)
    noise = noise or NoiseModel.of(capture.header.detector, integer=capture.integer_counts)
    assumed = noise or NoiseModel(1.0, correction.black.frame_variance, 0.0, "black level")
    merged = merge(capture, states, correction, assumed, counts=counts_correction(changes, model), progress=progress)
    frame = merged.signal
    if response is not None:
        frame = corrected_frame(frame, response, layout, analyzers)
    if noise is None:
        merged = with_noise_of_closure(merged, frame, layout, analyzers)
    channels = demosaic(frame, layout, method)
    maps = stokes(channels, analyzers, layout, method, merged=merged, frame=frame)
    planes = PLANES
    if systematic is not None:
        planes = PLANES | SYSTEMATIC
        maps |= systematic_errors(systematic, maps)
    maps["pixel_flags"] = _spread(merged.mask, channels.shape[1:])
    lost = (maps["pixel_flags"] & ~np.uint8(Mask.SATURATED)) != 0
    dark = ~(maps["s0"] > 0)
    for name, values in maps.items():
        if name != "pixel_flags":
            values[..., lost | dark if name in RATIOS else lost] = np.nan
    rows, columns = channels.shape[1:]
    facts = _facts(maps, analyzers, noise, correction, method=method, states=len(states))
    facts["warnings"] += cut_off
    facts |= references(capture, model) | exposure_fact(capture, states)
    with ProductWriter(
        out, "stokes", capture.header, (rows, columns), planes=planes, steps=steps, overwrite=overwrite
    ) as product:
        product.array("measurement_matrix", model_rows, "", "W (channel, 16): intensity = W . vec(M), row-major")
        solve = tuple(map(tuple, np.linalg.pinv(analyzers).tolist()))
        for name, parts in (("neighbour_correlation", (1, 2)), ("neighbour_correlation_s0", (0,))):
            text = f"of the noise of {', '.join(f'S{k}' for k in parts)} by distance in rows and columns"
            product.array(name, neighbour_correlation(layout, method, solve, parts), "", text)
        product.array("analyzers", analyzers, "", "rows (channel, 3): intensity = row . (S0, S1, S2)")
        facts |= systematic.store(product) if systematic is not None else {}
        product.write(slice(0, rows), **maps)
        product.seal(facts)
    return facts


def stokes(
    channels: NDArray[np.float32],
    analyzers: NDArray[np.float64],
    layout: MosaicLayout,
    method: str,
    *,
    merged: MergedFrame,
    frame: NDArray[np.float32] | None = None,
) -> dict[str, NDArray[Any]]:
    """Stokes planes and their errors from demosaiced channels (4, rows, columns); names as in PLANES.

    `frame` is the mosaic frame that they come from.
    """
    solve = np.asarray(np.linalg.pinv(analyzers), dtype=float)
    null = _null(analyzers)
    s0, s1, s2 = np.tensordot(solve.astype(np.float32), channels, axes=1)
    closure = np.tensordot(null.astype(np.float32), channels, axes=1)
    shot, floor = _by_channel(merged.shot, layout, channels), _by_channel(merged.floor, layout, channels)
    light = np.maximum(channels, 0.0)
    variance = shot * light + floor
    if merged.relative is not None:
        variance += _by_channel(merged.relative, layout, channels) * light**2
    covariance = stokes_covariance(variance, layout, method, solve, frame=frame)
    maps = {"s0": s0, "s1": s1, "s2": s2, "closure": closure, "stokes_covariance": covariance}
    maps |= {f"s{k}_errors": np.sqrt(covariance[k]) for k in range(LINEAR)}
    maps |= linear_polarization(s0, s1, s2, covariance)
    return {name: np.asarray(values, dtype=np.float32) for name, values in maps.items()}


def _null(analyzers: NDArray[np.float64]) -> NDArray[np.float64]:
    """What of four channels no light explains, (4,): of ideal analyzers I0 + I90 - I45 - I135."""
    null = np.linalg.svd(analyzers)[0][:, LINEAR]
    return np.asarray(null / np.abs(null).max() * np.sign(null[0]))


def with_noise_of_closure(
    merged: MergedFrame, frame: NDArray[np.float32], layout: MosaicLayout, analyzers: NDArray[np.float64]
) -> MergedFrame:
    """A merged frame with a noise model, from the closure of its super-pixels, where the gain is not known.

    Demosaicing would smooth the closure. In the brighter half of the image it contains the shot noise, beside the noise
    of the darks. Without darks the other half tells the two apart, unless it is as bright.

    Parameters
    ----------
    merged : with the shot noise of a gain of 1.
    """
    null, count = _null(analyzers), range(len(layout.channels))
    cells, shot, floor = (
        np.stack([layout.samples(np.broadcast_to(part, frame.shape), k).astype(float).ravel() for k in count])
        for part in (frame, merged.shot, merged.floor)
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        closure, light = null @ cells, cells.sum(axis=0)
        closure -= np.nanmedian(closure / light) * light
    by_light, by_floor = null**2 @ (shot * np.maximum(cells, 0)), null**2 @ floor
    known = np.isfinite(closure)
    bright = by_light >= np.median(by_light[known])

    def typical(half: NDArray[np.bool_]) -> tuple[float, float]:
        variance = np.square(MAD_TO_SIGMA * np.median(np.abs(closure[half])))
        return float(np.median(by_light[half])), float(variance - np.median(by_floor[half]))

    high, more = typical(known & bright)
    low, less = typical(known & ~bright) if (known & ~bright).any() else (high, more)
    slope, read = max(more, 0.0) / high if high > 0 else 0.0, 0.0
    if not merged.floor.any() and high > 1.5 * low:
        slope = min(max(more - less, 0.0) / (high - low), slope)
        read = max(more - slope * high, 0.0) / float(null @ null)
    # Computed frames have no noise but rounding.
    slope = max(slope, float(np.finfo(np.float32).eps))
    return replace(merged, shot=merged.shot * np.float32(slope), floor=merged.floor + np.float32(read), relative=None)


def linear_polarization(
    s0: NDArray[np.floating], s1: NDArray[np.floating], s2: NDArray[np.floating], covariance: NDArray[np.floating]
) -> dict[str, NDArray[np.floating]]:
    """Degree and angle of linear polarization with their intervals, as in `PLANES`.

    `covariance` (6, ...) is packed as `stokes_covariance`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = np.hypot(s1, s2)
        dolp = linear / s0
        aolp = np.mod(0.5 * np.arctan2(s2, s1), np.pi)
        c00, c11, c22, c01, c02, c12 = covariance
        u, v = s1 / linear, s2 / linear
        along = u * u * c11 + v * v * c22 + 2 * u * v * c12
        cross = u * c01 + v * c02
        dolp_variance = (along - 2 * dolp * cross + dolp**2 * c00) / s0**2
        moments = ((c11 + c22) / s0**2, (c11**2 + c22**2 + 2 * c12**2) / s0**4)
        degree = interval(dolp, np.maximum(dolp_variance, 0.0), *moments)
        half, low, high = (np.rad2deg(part) / 2 for part in directions(np.stack([s1, s2]), np.stack([c11, c22, c12])))
    angle = np.rad2deg(aolp)
    maps = {"dolp": degree.value, "dolp_errors": degree.error, "dolp_95": np.stack([degree.low, degree.high])}
    maps |= {"aolp_deg": angle, "aolp_deg_errors": half}
    return maps | {"aolp_deg_95": np.stack([angle + low, angle + high])}


def _systematic(capture: Capture, model: InstrumentModel, states: NDArray[np.int64]) -> Systematic | None:
    def rows(variant: InstrumentModel) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        w, analyzers = channel_rows(capture, variant, states, capture_changes(capture, variant, states))
        return w[None], analyzers[None]

    def counts(variant: InstrumentModel) -> CountsCorrection | None:
        return counts_correction(capture_changes(capture, variant, states), variant)

    return Systematic.of(model, rows, counts, np.eye(LINEAR))


def systematic_errors(systematic: Systematic, maps: dict[str, NDArray[Any]]) -> dict[str, NDArray[np.float32]]:
    """Planes `SYSTEMATIC` of an image of s0, s1 and s2."""
    s = np.stack([maps[name] for name in ("s0", "s1", "s2")])
    moved = np.stack(list(systematic.moves(s.reshape(LINEAR, -1)))).reshape(-1, *s.shape)
    each = (moved[:, 1], moved[:, 2], *moved_polarization(s, moved))
    return {name: np.sqrt(np.sum(e**2, axis=0), dtype=np.float32) for name, e in zip(SYSTEMATIC, each, strict=True)}


def moved_polarization(s: NDArray[np.floating], moved: NDArray[np.float64]) -> tuple[NDArray[Any], NDArray[Any]]:
    """By how much dolp and aolp_deg change where S (3, ...) moves by `moved` (D, 3, ...), its S0 held."""
    with np.errstate(divide="ignore", invalid="ignore"):
        linear = np.hypot(s[1], s[2])
        u, v = s[1:] / linear
        along, across = u * moved[:, 1] + v * moved[:, 2], u * moved[:, 2] - v * moved[:, 1]
        return along / s[0], np.rad2deg(across / linear / 2)


def _by_channel(raw: NDArray[np.float32], layout: MosaicLayout, channels: NDArray[np.float32]) -> NDArray[np.float32]:
    """Values of raw pixels (rows, columns) for each channel's image: those of its own pixel in the super-pixel."""
    if raw.size == 1:
        return raw[None]
    cell = np.stack([layout.samples(raw, k) for k in range(len(layout.channels))])
    step = channels.shape[1] // cell.shape[1]
    return np.asarray(cell if step == 1 else cell.repeat(step, axis=1).repeat(step, axis=2), dtype=np.float32)


def _spread(mask: NDArray[np.uint8], shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Flags of raw pixels, carried to every pixel whose value a bilinear method takes from them."""
    if shape[0] < mask.shape[0]:
        return np.asarray(mask[0::2, 0::2] | mask[0::2, 1::2] | mask[1::2, 0::2] | mask[1::2, 1::2])
    if not mask.any():
        return mask
    from scipy.ndimage import maximum_filter

    flags = np.zeros_like(mask)
    for flag in Mask:
        bit = np.uint8(flag)
        flags |= maximum_filter(mask & bit, 3)
    return flags


def _facts(
    maps: dict[str, NDArray[Any]],
    analyzers: NDArray[np.float64],
    noise: NoiseModel | None,
    correction: CountCorrection,
    *,
    method: str,
    states: int,
) -> dict[str, Any]:
    mask, warnings = maps["pixel_flags"], list(correction.warnings)
    counts = {flag.name.lower(): int(np.sum((mask & np.uint8(flag)) != 0)) for flag in Mask if flag.name}
    good = (mask & ~np.uint8(Mask.SATURATED)) == 0
    if not good.any():
        raise CaptureError(f"no pixel could be reduced: {in_words(counts)} of {mask.size} pixels. Nothing was written.")
    if any(counts.values()):
        warnings.append(f"of {mask.size} pixels: {in_words(counts)} (pixel_flags says where)")
    if noise is None:
        warnings.append("the gain is not known: the noise is estimated from the channels' closure")
    # Medians of a ninth of the pixels are plenty.
    some = good.copy()
    if good[::3, ::3].sum() > 1000:
        some[:] = False
        some[::3, ::3] = good[::3, ::3]
    lit = some & is_lit(maps["s0"], maps["s0_errors"])
    closure = maps["closure"][lit] / maps["s0"][lit]
    return {
        "states": states,
        "method": method,
        "condition_number": condition_number_linear(analyzers),
        "black": correction.source,
        "flat": correction.flat.source if correction.flat else "none",
        "noise": noise.source if noise else "estimated from the closure",
        "median_closure_over_s0": float(np.median(closure)) if lit.any() else float("nan"),
        "rms_closure_over_s0": float(np.sqrt(np.mean(closure**2))) if lit.any() else float("nan"),
        "median_dolp": _median(maps["dolp"][lit]),
        "median_dolp_error": _median(maps["dolp_errors"][lit]),
        "pixels": mask.size,
        "pixels_with_light": int(np.sum(is_lit(maps["s0"], maps["s0_errors"]))),
        "masked": counts,
        "warnings": warnings,
    }


def condition_number_linear(analyzers: NDArray[np.float64]) -> float:
    """Condition number of the analyzer matrix (channels, 3)."""
    singular = np.linalg.svd(analyzers, compute_uv=False)
    return float(singular[0] / singular[-1])


def _median(values: NDArray[Any]) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
