"""From raw counts to signal: black, flat, bad and saturated pixels, block by block."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.instrument.changes import places
from processing.reduction.black import Black
from processing.reduction.capture_evidence import evidence_of
from processing.reduction.effects_of_capture import CountsCorrection
from processing.reduction.flat import FlatField
from processing.reduction.lit_darks import leaked_light, resume_lit_darks
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.products.pixel_mask import Mask


@dataclass(frozen=True)
class CountCorrection:
    """Black, flat field and mask that turn counts into signal.

    Attributes
    ----------
    black : of every exposure, from dark states or the header.
    flat : relative response; None for none.
    bad : (rows, columns) bool; None for none.
    saturation : counts from which on a pixel is saturated; None if the range is not known.
    source : in words, for the facts and the console.
    warnings : what the user should know.
    """

    black: Black
    source: str
    flat: FlatField | None = None
    bad: NDArray[np.bool_] | None = None
    saturation: float | None = None
    warnings: tuple[str, ...] = ()

    @classmethod
    def of(
        cls,
        capture: Capture,
        bad: NDArray[np.bool_] | None = None,
        dark_from: Capture | None = None,
        flat_from: Sequence[Capture] = (),
    ) -> "CountCorrection":
        """Correction by the capture's dark states, else by the header's black level, else none with a warning.

        Parameters
        ----------
        bad : (rows, columns), pixels to leave out.
        dark_from : another capture of the same camera whose dark states are used instead.
        flat_from : other captures of the same camera whose flat states, all together, are used instead.

        Raises
        ------
        CaptureError : another capture does not fit, is simulated where this one is measured, or lacks such states.
        """
        for partner, name in ((dark_from, "dark"), *((c, "flat") for c in flat_from)):
            if partner is not None:
                _check_partner(capture, partner, name)
        if bad is not None and bad.shape != capture.stored_shape:
            raise CaptureError(
                f"the bad-pixel map is {bad.shape}, the frames of {capture.path} are {capture.stored_shape}."
            )
        if bad is not None and capture.layout is not None:
            bad = np.any(capture.layout.split(bad), axis=0)
        light = capture.column("exposure_s")[_light(capture)].astype(float)
        black = Black.of(dark_from or capture) or Black.level(capture.header.detector.black_level_counts)
        source = black.in_words(light) + (f" of {dark_from.path.name}" if dark_from else "")
        warnings = black.warnings(light)
        if not black.measured and not black.means.any():
            warnings.append(
                "no dark states and no black level in the capture: nothing was subtracted, and a pedestal would "
                "show as depolarization. Take dark states, or import with --black-level."
            )
        if dark_from is None:
            warnings += _of_light(capture)
            warnings += evidence_of(capture)
        runs = np.unique(capture.run_of_states[_light(capture)]).size
        if runs > 1:
            warnings.append(
                f"the states were taken in {runs} runs, between which the light may have jumped: `diagnose` tells "
                "whether it did (source_jump), and `process reduce --instrument` with the file that it writes mends it"
            )
        top = saturation(capture)
        flat = FlatField.of(list(flat_from) or [capture], black, top)
        if flat is not None and flat.lost.any():
            bad = flat.lost if bad is None else bad | flat.lost
        return cls(black, source, flat, bad, top, tuple(warnings))


def _of_light(capture: Capture) -> list[str]:
    """Warnings where the light was on for the darks, or not on at all."""
    lights = _light(capture)
    look, lit = resume_lit_darks(capture, lights.size)
    if lit is not None:
        return [f"{lit}. Subtracting them leaves no signal: take the capture again with the light shut off"]
    unlit = [look.without_light(float(exposure_s)) for exposure_s in np.unique(capture.column("exposure_s")[lights])]
    leak = leaked_light(capture)
    return [f"{text}: what is left is noise" for text in unlit if text is not None] + ([] if leak is None else [leak])


def _light(capture: Capture) -> NDArray[np.int64]:
    return np.flatnonzero([role != "dark" for role in capture.role])


def saturation(capture: Capture) -> float | None:
    """Counts from which on a pixel is saturated: the end of the range, or the full well where that comes first."""
    detector = capture.header.detector
    if detector.bits is None or not capture.integer_counts:
        return None
    top = capture.full_scale_counts or float(2**detector.bits - 1)
    if detector.full_well_e is None or detector.gain_e_per_count is None:
        return top
    well = detector.black_level_counts + detector.full_well_e / detector.gain_e_per_count
    # Read noise spreads a full well's counts.
    return min(top, well - 4 * (detector.read_noise_e or 0.0) / detector.gain_e_per_count)


def _check_partner(capture: Capture, partner: Capture, role: str) -> None:
    if partner.simulated != capture.simulated:
        kinds = {True: "simulated", False: "measured"}
        raise CaptureError(
            f"{partner.path} is {kinds[partner.simulated]} and {capture.path} is {kinds[capture.simulated]}; "
            "simulated and measured data are never mixed."
        )
    if (partner.channels, partner.frame_shape) != (capture.channels, capture.frame_shape):
        raise CaptureError(
            f"{partner.path} has frames of {partner.channels} x {partner.frame_shape}, {capture.path} has "
            f"{capture.channels} x {capture.frame_shape}; a {role} capture must be of the same camera and size."
        )
    if partner.states_with(role).size == 0:
        raise CaptureError(f"{partner.path} has no {role} states that are done.")


class BlockReader:
    """Corrected signal of the sample states, tile by tile, with the mask filled in passing."""

    def __init__(
        self,
        capture: Capture,
        states: NDArray[np.int64],
        correction: CountCorrection,
        counts: CountsCorrection | None = None,
        *,
        struck: NDArray[np.int64] | None = None,
    ) -> None:
        """`struck` (H, 4): state among `states`, channel, row and column of intensities that are left out."""
        self.capture, self.states, self.correction, self.counts = capture, states, correction, counts
        self.repeats = capture.column("repeats")[states].astype(float)
        exposure = capture.column("exposure_s")[states].astype(float)
        #: Black of each state as a weighted sum of the means of dark states (states, D).
        self.black_weights = correction.black.weights(exposure)
        self._levels, level = np.unique(self.black_weights, axis=0, return_inverse=True)
        self._level = level.reshape(-1)
        self.exposure_s = exposure
        self._buffer: NDArray[np.generic] | None = None
        #: First row of the block that was read last.
        self.first_row = 0
        self._rows = slice(0, 0)
        self._black = np.zeros((1, 1, 1), np.float32)
        self._gain: NDArray[np.float32] | None = None
        self._bad: NDArray[np.bool_] | None = None
        self._all_struck = np.zeros((0, 4), dtype=np.int64) if struck is None else struck
        self._struck: NDArray[np.bool_] | None = None

    def read(self, rows: slice) -> NDArray[np.generic]:
        """Counts (states, channels, pixels) of a row block as stored; the memory is used again by the next call."""
        self.first_row, self._rows = rows.start, rows
        height, width = rows.stop - rows.start, self.capture.frame_shape[1]
        channels = self.capture.channels
        shape = (len(self.states), channels, height, width)
        if self._buffer is None or self._buffer.size < math.prod(shape):
            moved = self.counts is not None and self.counts.moves
            self._buffer = np.empty(math.prod(shape), np.float32 if moved else self.capture.dtype)
        block = self._buffer[: math.prod(shape)].reshape(shape)
        if self.counts is not None and self.counts.moves:
            self._read_moved(rows, block, self.counts)
        else:
            self.capture.read_block(self.states, rows, block)
        means, flat, bad = self.correction.black.means, self.correction.flat, self.correction.bad
        means = means[:, :, rows] if means.shape[2] > 1 else means
        # (levels, channels, pixels), or (1, 1, 1) for a declared black level.
        black = np.tensordot(self._levels, means.reshape(*means.shape[:2], -1), axes=1)
        self._black = np.ascontiguousarray(black, dtype=np.float32)
        self._gain = None if flat is None else 1.0 / flat.response[:, rows].reshape(channels, -1)
        self._bad = None if bad is None else bad[rows].reshape(-1)
        self._struck = self._struck_in(rows, shape)
        return block.reshape(len(self.states), channels, -1)

    def _struck_in(self, rows: slice, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """(states, channels, pixels) of a row block; None for none."""
        struck = self._all_struck[(self._all_struck[:, 2] >= rows.start) & (self._all_struck[:, 2] < rows.stop)]
        if not len(struck):
            return None
        mask = np.zeros(shape, dtype=bool)
        mask[struck[:, 0], struck[:, 1], struck[:, 2] - rows.start, struck[:, 3]] = True
        return mask.reshape(*shape[:2], -1)

    def sound(self, raw: NDArray[np.generic], pixels: slice | NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which intensities (states, channels, pixels) of the block count: neither saturated nor struck."""
        level = self.correction.saturation
        is_sound = np.ones(raw.shape, dtype=bool) if level is None else np.less(raw, level)
        return is_sound if self._struck is None else is_sound & ~self._struck[:, :, pixels]

    def _read_moved(self, rows: slice, block: NDArray[np.generic], counts: CountsCorrection) -> None:
        """Fill `block` with counts of images moved back; beyond an edge of the frame slopes go on.

        The black is moved with them, which matters only where it differs from pixel to pixel.
        """
        from processing.reduction.move_image import REACH, shifted_back

        pitch, shift_px = counts.pitch, counts.shift_px
        blur_px2 = np.broadcast_to(counts.blur_px2, len(self.states))
        # Where the layout has taken the kinds of pixels apart, each image is of one kind.
        apart = pitch * self.capture.frame_shape[0] // self.capture.stored_shape[0]
        margin = (math.ceil(float(np.abs(shift_px).max()) / pitch) + REACH + 1) * apart
        height = self.capture.frame_shape[0]
        first, last = max(rows.start - margin, 0), min(rows.stop + margin, height)
        for k, state in enumerate(self.states):
            (x, y), blur = shift_px[k] / pitch, float(blur_px2[k]) / pitch**2
            frame = self.capture.frames(int(state), slice(first, last)).astype(np.float32)
            for channel, image in enumerate(frame):
                for i, j in np.ndindex(apart, apart):
                    image[i::apart, j::apart] = shifted_back(image[i::apart, j::apart], x, y, blur)
                block[k, channel] = image[rows.start - first : rows.stop - first]

    def load(
        self, frames: NDArray[np.generic], start: int, stop: int, out: NDArray[np.float32], *, mask: NDArray[np.uint8]
    ) -> NDArray[np.float32] | None:
        """Fill `out` (states, channels, stop - start) with signal, flag the mask; returns what `signal` returns."""
        raw = frames[:, :, start:stop]
        flags = mask[start:stop]
        level = self.correction.saturation
        if level is not None:
            flags[raw.max(axis=(0, 1)) >= level] |= np.uint8(Mask.SATURATED)
        if self._struck is not None:
            flags[self._struck[:, :, start:stop].any(axis=(0, 1))] |= np.uint8(Mask.STRUCK)
        if raw.dtype.kind == "f":
            flags[~np.isfinite(raw).all(axis=(0, 1))] |= np.uint8(Mask.NOT_FINITE)
        if self._bad is not None:
            flags[self._bad[start:stop]] |= np.uint8(Mask.BAD)
        return self.signal(raw, slice(start, stop), out)

    def signal(
        self, raw: NDArray[np.generic], pixels: slice | NDArray[np.int64], out: NDArray[np.float32]
    ) -> NDArray[np.float32] | None:
        """Fill `out` with counts minus black over flat; returns 1 / flat (channels, pixels), None without one."""
        np.copyto(out, raw, casting="unsafe")
        black = self._black[..., pixels] if self._black.shape[2] > 1 else self._black
        out -= black if len(black) == 1 else black[self._level]
        gain = None if self._gain is None else self._gain[:, pixels]
        if gain is not None:
            out *= gain
        if self.counts is not None:
            place = (at[self._rows].reshape(-1)[pixels] for at in places(*self.capture.frame_shape))
            self.counts.apply(out, *place)
        return gain
