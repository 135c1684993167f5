"""Which illumination a linear Stokes capture should have, by the standard error of xi0 that it predicts."""

from dataclasses import dataclass

import numpy as np

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.polarization import triply_degenerate
from processing.polarization.xi0 import Xi0Estimate, estimate
from processing.reduction.mueller import Progress
from processing.reflectance.base import ReflectanceModel

#: Jarecki and Kupinski's fifteen arm angles.
PAPER_OMEGA_DEG = tuple(float(v) for v in range(20, 91, 5))
#: Between two linear states, and rows and columns with which the object is sampled.
STEP_DEG, PIXELS = 15.0, 100


def linear_states() -> dict[str, Array]:
    """Stokes vectors of unit power by name: linear at every `STEP_DEG` (horizontal is 0, vertical 90), circular."""
    states: dict[str, Array] = {}
    for angle in np.arange(0.0, 180.0, STEP_DEG):
        name = {0.0: "horizontal", 90.0: "vertical"}.get(float(angle), f"linear {angle:g} deg")
        t = 2 * np.deg2rad(angle)
        states[name] = np.array([1.0, np.cos(t), np.sin(t), 0.0])
    states["right circular"], states["left circular"] = np.array([1.0, 0, 0, 1]), np.array([1.0, 0, 0, -1])
    return states


@dataclass(frozen=True)
class Assumptions:
    """Assumptions of the prediction: a surface with one xi0 and a M00 of cos(incidence) times `albedo`.

    `electrons` is the signal of a channel for M00 = 1 under unpolarized light; `read_noise_e` its read noise.
    """

    xi0: float = 0.4
    albedo: float = 0.5
    electrons: float = 10_000.0
    read_noise_e: float = 2.3


@dataclass(frozen=True)
class Prediction:
    """Standard error of xi0 of one illumination over the object: one entry for each arm angle.

    `p90` is the 90th percentile of all lit pixels (the dark border of the shadow makes any mean depend on a few of
    them), `median` their median, `lost` the fraction whose standard error is over 0.1 or condition number over 100.
    """

    name: str
    stokes: Array
    omega_deg: Array
    p90: Array
    median: Array
    lost: Array
    condition: Array

    @property
    def score(self) -> float:
        """Root mean square of `p90` over all arm angles; smaller is better."""
        return float(np.sqrt(np.mean(self.p90**2)))


def predict(
    view: ViewingGeometry,
    model: ReflectanceModel,
    wavelength_nm: float,
    camera: InstrumentModel,
    *,
    states: dict[str, Array],
    assumptions: Assumptions,
    progress: Progress,
) -> list[Prediction]:
    """Predicted standard errors of each illumination at the paper's arm angles, best first.

    Parameters
    ----------
    camera : instrument whose analyzer channels are those of the Stokes camera; its generator is not used.
    states : Stokes vectors of unit power, by name.
    """
    analyzers = camera.at(wavelength_nm).analyzer_states({})[0]
    columns: dict[str, list[tuple[float, ...]]] = {name: [] for name in states}
    for done, omega in enumerate(PAPER_OMEGA_DEG, 1):
        image = view.at(omega, PIXELS, PIXELS)
        m0 = model.mueller_jones(image.points, wavelength_nm)
        for name, stokes in states.items():
            columns[name].append(
                _summary(predict_estimate(m0, image.points, analyzers, stokes, assumptions=assumptions))
            )
        progress(done, len(PAPER_OMEGA_DEG))
    predictions = []
    for name, stokes in states.items():
        p90, median, lost, condition = np.array(columns[name]).T
        predictions.append(Prediction(name, stokes, np.array(PAPER_OMEGA_DEG), p90, median, lost, condition))
    return sorted(predictions, key=lambda p: p.score)


def predict_estimate(
    m0: Array, points: ScatteringGeometry, analyzers: Array, stokes: Array, *, assumptions: Assumptions
) -> Xi0Estimate:
    """Estimate from noise-free intensities with the variance that noise would have: its standard errors count."""
    normal, source = points.normal, points.to_source
    m00 = assumptions.albedo * np.einsum("...i,...i->...", normal, source)
    m = triply_degenerate.mueller_matrix(m0, assumptions.xi0, m00)
    # Analyzer rows hold the factor 1/2 of a polarizer, so unpolarized light gives `electrons` for M00 = 1.
    w = (2 * assumptions.electrons * analyzers[:, :, None] * stokes).reshape(len(analyzers), 16)
    signal = w @ m.reshape(-1, 16).T
    return estimate(signal, signal + assumptions.read_noise_e**2, w, m0)


def _summary(e: Xi0Estimate) -> tuple[float, float, float, float]:
    stderr = np.nan_to_num(e.xi0_stderr, nan=1.0, posinf=1.0)
    return (
        float(np.percentile(stderr, 90)),
        float(np.median(stderr)),
        float(np.mean(~e.valid)),
        float(np.nanmax(e.condition)),
    )
