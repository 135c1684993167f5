"""The flat field: relative response of each pixel and unevenness of the light, from flat states."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from processing.reduction.black import Black
from processing.reduction.noise import NoiseModel
from processing.storage.captures.capture import Capture, CaptureError

#: A response below this is a dead pixel; dividing by less would blow its noise up without end.
LEAST_RESPONSE = 1e-3
#: Part of a region's pixels that may be at the top of the range, as hot pixels are, in a state that is used.
FEW = 1e-3
#: Wavelengths nearer than this are one filter.
SAME_NM = 0.5


@dataclass(frozen=True)
class FlatField:
    """Relative response.

    Attributes
    ----------
    response : (channels, rows, columns) float32, mean 1 in each channel.
    frames : how many frames it is the mean of.
    level : (channels,), counts above black of one frame.
    lost : (rows, columns) bool, pixels whose response is not known because they saturate or are no brighter than black.
    source : in words.
    """

    response: NDArray[np.float32]
    frames: int
    level: NDArray[np.float64]
    lost: NDArray[np.bool_]
    source: str

    @classmethod
    def of(
        cls, captures: list[Capture], black: Black | None = None, saturation: float | None = None
    ) -> "FlatField | None":
        """From all flat states of some captures of one camera; None without any.

        Parameters
        ----------
        black : for captures without dark states of their own.
        saturation : counts from which on a pixel is saturated; a flat state with more than a few such is left out.

        Raises
        ------
        CaptureError : every flat state is saturated, or they are no brighter than the black.
        """
        captures = [c for c in captures if c.states_with("flat").size]
        if not captures:
            return None
        total = np.zeros((captures[0].channels, *captures[0].frame_shape))
        lost = np.zeros(captures[0].frame_shape, bool)
        used = frames = 0
        for capture in captures:
            black_of = Black.of(capture) or black or Black.level(capture.header.detector.black_level_counts)
            exposure, repeats = capture.column("exposure_s").astype(float), capture.column("repeats")
            for k in capture.states_with("flat"):
                frame = capture.frames(int(k))
                clipped = np.zeros(lost.shape, bool) if saturation is None else (frame >= saturation).any(axis=0)
                # In a bracket the long exposures saturate; the others hold the same response.
                if clipped.mean() <= FEW:
                    total += frame - black_of.at(exposure[k])
                    lost |= clipped
                    used += 1
                    frames += int(repeats[k])
        names = ", ".join(c.path.name for c in captures)
        if not used:
            raise CaptureError(f"{names}: every flat state is saturated; retake them with less exposure.")
        with np.errstate(invalid="ignore", divide="ignore"):
            level = np.nanmean(total, axis=(1, 2)) / used
            response = total / used / level[:, None, None]
        if not np.all(np.isfinite(response)) or np.mean(response <= 0) > 0.01:
            raise CaptureError(
                f"{names}: the flat states are no brighter than the black; retake them or leave them out."
            )
        lost |= (response < LEAST_RESPONSE).any(axis=0)
        response = np.maximum(response, LEAST_RESPONSE).astype(np.float32)
        return cls(response, frames, level, lost, f"mean of {frames} flat frame(s) of {names}")

    def relative_variance(self, noise: NoiseModel) -> NDArray[np.float32]:
        """Variance (channels, rows, columns) of the response over its square."""
        light = self.level[:, None, None] * self.response
        return np.asarray((noise.slope * light + noise.floor) / (self.frames * light**2), dtype=np.float32)


@dataclass(frozen=True)
class FlatCapture:
    """A capture of the flat field, and the properties by which it belongs to other captures."""

    path: Path
    simulated: bool
    mosaic: tuple[tuple[str, ...], ...] | None
    wavelength_nm: float
    frame_shape: tuple[int, int]
    time_s: float

    @classmethod
    def of(cls, capture: Capture) -> "FlatCapture | None":
        """None unless every state with light is a flat state."""
        if not capture.states_with("flat").size or set(capture.role) - {"flat", "dark"}:
            return None
        header = capture.header
        return cls(
            capture.path, capture.simulated, header.mosaic, header.wavelength_nm, capture.frame_shape, _time_s(capture)
        )


def flat_captures(folder: Path) -> list[FlatCapture]:
    """All captures of the flat field under a folder."""
    flats = []
    for path in sorted(folder.rglob("*.h5")):
        try:
            with Capture(path) as capture:
                flat = FlatCapture.of(capture)
        except CaptureError:
            continue
        if flat is not None:
            flats.append(flat)
    return flats


def nearest_flat(flats: Sequence[FlatCapture], capture: Capture) -> Path | None:
    """The flat of the same camera and wavelength that was taken nearest in time; None without any."""
    kind = (capture.simulated, capture.header.mosaic, capture.frame_shape)
    same = [
        flat
        for flat in flats
        if (flat.simulated, flat.mosaic, flat.frame_shape) == kind
        and abs(flat.wavelength_nm - capture.header.wavelength_nm) < SAME_NM
    ]
    time_s = _time_s(capture)
    return min(same, key=lambda flat: abs(flat.time_s - time_s)).path if same else None


def _time_s(capture: Capture) -> float:
    times = capture.column("host_time_s").astype(float)
    return float(np.nanmean(times)) if np.isfinite(times).any() else 0.0
