"""What each close look at a capture begins with: states of the sample, what changes in them, black and noise."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.reduction.counts_to_signal import BlockReader, Correction
from processing.reduction.cut_off import without_cut_off
from processing.reduction.effects_of_capture import capture_changes, counts_correction
from processing.reduction.instrument_of_capture import choose_model, require_one_colour
from processing.reduction.noise import NoiseModel, noise_of
from processing.reduction.sample_states import sample_states
from processing.storage.captures.capture import Capture


class SampleStates:
    """The states of a capture's sample with all that their reduction needs, as `process reduce` takes them.

    Parameters
    ----------
    instrument : file to use instead of the model in the capture.

    Attributes
    ----------
    model : of the instrument, at the capture's wavelength.
    numbers : of the states (N,) in the file.
    changes : what the instrument's effects change from state to state.
    correction : black, flat and masks.
    noise : of one frame; None where the camera's is not known.
    """

    def __init__(self, capture: Capture, instrument: Path | None = None) -> None:
        require_one_colour(capture)
        self.model = choose_model(capture, instrument)
        self.numbers, _ = without_cut_off(capture, sample_states(capture))
        self.changes = capture_changes(capture, self.model, self.numbers)
        self.correction = Correction.of(capture)
        self.noise: NoiseModel | None = noise_of(capture, self.numbers)

    def read(self, capture: Capture, rows: slice) -> tuple[BlockReader, NDArray[Any], NDArray[np.float32]]:
        """A reader with its counts of a row block, and their signal above black, both (N, channels, pixels)."""
        reader = BlockReader(capture, self.numbers, self.correction, counts_correction(self.changes, self.model))
        frames = reader.read(rows)
        signal = np.empty(frames.shape, np.float32)
        reader.signal(frames, slice(None), signal)
        return reader, frames, signal
