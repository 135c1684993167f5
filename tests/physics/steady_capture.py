"""A capture of one channel whose noise is known."""

import numpy as np

from processing.diagnosis.captures.capture_data import CaptureData
from processing.instrument.changes import Conditions


def steady_capture(signal, sigma, slope=0.0, sample=None):
    """Data of intensities (N, H, W) with a standard deviation `sigma` without light, and a variance of `slope` with it.

    `sample` (16,) is None where it is unknown.
    """
    states, *shape = signal.shape
    return CaptureData(
        name="steady",
        signal=signal[:, None].astype(np.float32),
        conditions=Conditions({}, states, ("all",), np.arange(states) / states, 4095.0),
        exposure=np.ones(states),
        sample=sample,
        slope=np.full(states, slope),
        floor=np.full(states, sigma**2),
        noise_known=True,
        noise_source="",
        clipped=np.zeros(shape, dtype=bool),
        clipped_states=np.zeros(states, dtype=bool),
        usable=np.ones(shape, dtype=bool),
        simulated=True,
        wavelength_nm=662.0,
    )
