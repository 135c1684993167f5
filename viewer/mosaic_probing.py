"""A super-pixel of a polarization camera looked at closely: its analyzers in every state, one Stokes vector for all."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import ProcessError
from processing.reduction.counts_to_signal import BlockReader, CountCorrection
from processing.reduction.cut_off import without_cut_off
from processing.reduction.effects_of_capture import capture_changes, counts_correction
from processing.reduction.instrument_of_capture import choose_model, require_one_colour
from processing.reduction.measurement_matrix import relative_exposure
from processing.reduction.mosaic.layout import MosaicLayout
from processing.reduction.noise import noise_of
from processing.reduction.sample_states import sample_states
from processing.reduction.stokes import channel_rows
from processing.storage.captures.capture import Capture
from viewer.probing import MOST, Region, analyzer_names, finite


class SuperPixelReducer:
    """Fits one linear Stokes vector to whole super-pixels of a mosaic capture; opened once, asked often.

    Parameters
    ----------
    instrument : file to use instead of the model in the capture.
    """

    def __init__(self, path: Path, instrument: Path | None = None) -> None:
        self._path = path
        with Capture(path) as capture:
            require_one_colour(capture)
            self._model = model = choose_model(capture, instrument)
            self._states, _ = without_cut_off(capture, sample_states(capture))
            states, changes = self._states, capture_changes(capture, model, self._states)
            self._counts, self._correction = counts_correction(changes, model), CountCorrection.of(capture)
            self._noise = noise_of(capture, states)
            mosaic = capture.header.mosaic or model.mosaic or ()
            _, self._analyzers = channel_rows(capture, model, states, changes)
            self._layout = MosaicLayout.of(mosaic, [channel.name for channel in model.channels], self._analyzers)
            self._relative = relative_exposure(capture, states)

    def curve(self, region: Region) -> dict[str, Any]:
        """Signal of each analyzer in each state with the fitted one, residuals in units of noise, and Stokes values.

        The region is widened to whole super-pixels, whose pixels of one analyzer are averaged. Raises ProcessError: it
        is too large.
        """
        block, signal = self._signal(region)
        pixels = block.pixels // len(self._layout.channels)
        a = np.kron(self._relative[:, None], self._analyzers)
        solve = np.linalg.pinv(a)
        s = solve @ signal
        fitted = a @ s
        variance = self._variance(fitted, len(self._layout.channels)) / pixels
        has_noise = self._noise is not None
        if not has_noise:
            variance = np.full(len(signal), np.sum((signal - fitted) ** 2) / max(len(signal) - len(s), 1))
        residual = (signal - fitted) / np.sqrt(variance)
        covariance = (solve * variance) @ solve.T
        return {
            "states": np.repeat(self._states, len(self._layout.channels)).tolist(),
            "series": analyzer_names(self._layout.channels),
            "signal": signal.tolist(),
            "fitted": fitted.tolist(),
            "noise": finite(np.sqrt(variance)),
            "residual": finite(residual),
            "chi_square": finite(np.sum(residual**2) / max(len(signal) - len(s), 1)),
            "noise_known": has_noise,
            "stokes": _stokes(s, covariance),
            "told": f"{self._model.name}; {block}; black: {self._correction.source}",
        }

    def _signal(self, region: Region) -> tuple[Region, NDArray[np.float64]]:
        with Capture(self._path) as capture:
            rows, columns = (
                slice(part.start // 2 * 2, min(-(-part.stop // 2) * 2, size // 2 * 2))
                for part, size in zip((region.rows, region.columns), capture.frame_shape, strict=True)
            )
            block = Region(rows, columns)
            if (rows.stop - rows.start) * capture.frame_shape[1] * len(self._states) > MOST:
                raise ProcessError(f"{region} is more than is reduced at once; draw a smaller one")
            reader = BlockReader(capture, self._states, self._correction, self._counts)
            frames = reader.read(rows)
            signal = np.empty(frames.shape, np.float32)
            reader.signal(frames, slice(None), signal)
            width = capture.frame_shape[1]
        image = signal.reshape(len(self._states), -1, width)[:, :, columns]
        means = [image[:, row::2, column::2].mean(axis=(1, 2), dtype=float) for row, column in self._layout.offsets]
        return block, np.stack(means, axis=1).ravel()

    def _variance(self, signal: NDArray[np.float64], channels: int) -> NDArray[np.float64]:
        """Of one raw pixel (N channels,), counts^2."""
        noise = self._noise
        if noise is None:
            return np.full(len(signal), np.nan)
        with Capture(self._path) as capture:
            repeats = np.repeat(np.maximum(capture.column("repeats")[self._states].astype(float), 1), channels)
        return np.asarray(noise.slope * np.maximum(signal, 0) / repeats + noise.floor_of_rows(repeats, 0.0, channels))


def _stokes(s: NDArray[np.float64], covariance: NDArray[np.float64]) -> dict[str, dict[str, float | None]]:
    """S0, the normalized parameters, DoLP and AoLP with standard errors to first order."""
    with np.errstate(divide="ignore", invalid="ignore"):
        s0, s1, s2 = s
        linear = np.hypot(s1, s2)
        gradients = {
            "S0": (s0, [1, 0, 0]),
            "S1/S0": (s1 / s0, [-s1 / s0**2, 1 / s0, 0]),
            "S2/S0": (s2 / s0, [-s2 / s0**2, 0, 1 / s0]),
            "DoLP": (linear / s0, [-linear / s0**2, s1 / linear / s0, s2 / linear / s0]),
            "AoLP / degrees": (
                np.rad2deg(0.5 * np.arctan2(s2, s1)) % 180,
                np.rad2deg([0, -0.5 * s2 / linear**2, 0.5 * s1 / linear**2]),
            ),
        }
        return {
            name: {"value": finite(value), "error": finite(np.sqrt(np.asarray(g) @ covariance @ np.asarray(g)))}
            for name, (value, g) in gradients.items()
        }
