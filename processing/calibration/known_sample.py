"""Mean signals of a region in a capture of a known sample, and the signals that a model predicts.

The sample is known up to one throughput for each pixel, so the throughput is eliminated: for every trial of the
parameters it has its least-squares value (variable projection).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.instrument.applied_effects import changes_at
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.flat import FEW
from processing.reduction.measurement_matrix import relative_exposure
from processing.reduction.sample_states import sample_states
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import Sample


class CalibrationError(ProcessError):
    """A calibration was asked for that cannot be made."""


def known_mueller(sample: Sample) -> NDArray[np.float64]:
    """Mueller matrix (4, 4) of a known sample, up to its throughput; CalibrationError for an unknown one."""
    if sample.kind == "air":
        return np.eye(4)
    if sample.kind == "mirror":
        return mueller.IDEAL_MIRROR
    if sample.kind == "mueller" and sample.mueller is not None:
        return np.asarray(sample.mueller, dtype=float).reshape(4, 4)
    raise CalibrationError(
        "the sample of this capture is not known, and retardances cannot be told from an unknown sample "
        "(docs/conventions.md). Capture air or a mirror, or import with --sample."
    )


def region_means(capture: Capture, rows: slice, columns: slice) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Mean signal (N, channels) of a region, black subtracted, and the states of the sample that it belongs to.

    States in which the region saturates are left out.
    """
    correction = CountCorrection.of(capture)
    black = correction.black
    means_of_dark = black.means if black.means.shape[2] == 1 else black.means[:, :, rows, columns]
    means, used = [], []
    for k in sample_states(capture):
        frame = capture.frames(int(k), rows)[:, :, columns]
        if correction.saturation is None or np.mean(frame >= correction.saturation) <= FEW:
            means.append(frame.mean(axis=(1, 2)))
            used.append(int(k))
    if not means:
        raise CalibrationError(f"{capture.path}: the region is saturated in every state; take less exposure.")
    if means[0].size == 0 or not np.all(np.isfinite(means)):
        raise CalibrationError(f"{capture.path}: the region holds no pixels, or no numbers; choose another one.")
    share = black.weights(capture.column("exposure_s")[used].astype(float))
    return np.asarray(means) - np.asarray(share @ means_of_dark.mean(axis=(2, 3))), np.array(used)


@dataclass(frozen=True)
class KnownCapture:
    """One capture of a joint fit.

    Attributes
    ----------
    model : resolved at the wavelength of the capture.
    angles_deg : axis name to (N,), as read back.
    signal : (N, channels) counts above black, or (N, channels, pixels): one throughput for each pixel.
    sample : (4, 4) up to a factor.
    exposure : (N,) relative, default 1.
    wavelength_nm : parts of one wavelength share all parameters.
    """

    model: InstrumentModel
    angles_deg: dict[str, NDArray[np.float64]]
    signal: NDArray[np.float64]
    sample: NDArray[np.float64]
    exposure: NDArray[np.float64] | None = None
    wavelength_nm: float = 0.0

    @property
    def data(self) -> NDArray[np.float64]:
        """(N * channels, pixels)."""
        return self.signal.reshape(self.signal.shape[0] * self.signal.shape[1], -1)

    @property
    def throughputs(self) -> int:
        """Numbers that are eliminated: one for each pixel, in each state where the level of the source is free."""
        pixels = int(self.data.shape[1])
        return pixels * len(self.signal) if self.model.projects_source else pixels

    def residual(self, model: InstrumentModel) -> NDArray[np.float64]:
        """(N * channels * pixels,), over the mean signal, with the best throughputs."""
        weight = np.ones(self.signal.shape[0]) if self.exposure is None else self.exposure
        w = model.rows(self.angles_deg, changes_at(model, self.angles_deg)) * weight[:, None, None]
        shape = w.reshape(-1, 16) @ self.sample.reshape(16)
        # What has a throughput in common: a state, or all of them.
        shape = shape.reshape(len(weight) if model.projects_source else 1, -1, 1)
        data = self.data.reshape(*shape.shape[:2], -1)
        throughput = np.sum(shape * data, axis=1, keepdims=True) / np.sum(shape**2, axis=1, keepdims=True)
        return np.asarray((data - shape * throughput).reshape(-1) / np.mean(data))


def part_of(capture: Capture, model: InstrumentModel, rows: slice, columns: slice) -> KnownCapture:
    """The region means of a capture of a known sample, for `fit_trains`; `model` is at its wavelength."""
    sample = known_mueller(capture.header.sample)
    signal, states = region_means(capture, rows, columns)
    angles = {name: values[states] for name, values in capture.angles_deg.items()}
    return KnownCapture(model, angles, signal, sample, relative_exposure(capture, states), capture.header.wavelength_nm)
