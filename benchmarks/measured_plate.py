"""What the half-wave plate of the Wollaston polarimeter is, by fits with nothing in common with `diagnose`.

    OPENBLAS_NUM_THREADS=1 python benchmarks/measured_plate.py

Both runs of ../shared/data/drr-wollaston-nir (air, and the plate as an unknown Mueller matrix) are fitted together to
the normalised difference of the channels, so the source does not count: train, channel gain, extinctions, and the
ellipticity of the light, which is either one value or one for each run; or each run has its own light, and plates with
an ellipticity and a diattenuation of their own. Half a minute. Results only; no data are copied.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from processing.polarization import mueller

FOLDER = Path(__file__).resolve().parents[1].parent / "shared/data/drr-wollaston-nir"
#: Retardances, azimuths of both plates, of the prism, gain of the right channel, two extinctions; then the ellipticity
#: of the light, ellipticities and diattenuations of both plates.
VALUES, TRAIN, ELLIPTICITY = 13, 8, 8
#: Of the last five, those that are fitted at all and those that are fitted for each run, in every kind of fit.
KINDS = {"one": (1, 0), "one each": (1, 1), "own plates": (5, 5)}
#: Plausible size of ellipticities (radians) and diattenuations, which hardly determined ones stay within.
PLAUSIBLE, PULL = 0.03, 3e-4
STARTS = 40
#: Rms of the difference below which a train is found.
FOUND = 0.006
Array = NDArray[np.float64]


def measured(wavelength_nm: int, sample: bool) -> tuple[Array, Array]:
    """Angle of the first plate in radians and normalised difference of the channels, both (N,)."""
    prefix, file = ("", "sample_results.json") if sample else ("Cal_", "cal_results.json")
    data = json.loads((FOLDER / file).read_text(encoding="utf-8"))
    names = (f"{prefix}theta{wavelength_nm}", f"{prefix}Il_{wavelength_nm}", f"{prefix}Ir_{wavelength_nm}")
    theta, left, right = (np.array(data[name]) for name in names)
    return theta, (left - right) / (left + right)


def plate(azimuth: Array, retardance: float, ellipticity: float, diattenuation: float) -> Array:
    """Mueller matrices (N, 4, 4) of a turning plate: of its axes, elliptical by so much, one lets more light pass."""
    into = mueller.retarder(azimuth + np.pi / 4, 2 * ellipticity)
    lost = mueller.diattenuator(azimuth, 1 + diattenuation, 1 - diattenuation)
    return np.asarray(lost @ into @ mueller.retarder(azimuth, retardance) @ np.swapaxes(into, -1, -2))


def difference(train: Array, theta: Array, sample: Array) -> Array:
    """Normalised difference (N,) of the model."""
    d1, d2, t1, t2, prism, gain, leak_left, leak_right, ellipticity, e1, e2, lost1, lost2 = train
    light = np.array([1, np.cos(2 * ellipticity), 0, np.sin(2 * ellipticity)])
    stokes = plate(5 * theta + t2, d2, e2, lost2) @ sample @ plate(theta + t1, d1, e1, lost1) @ light
    along = stokes[:, 1] * np.cos(2 * prism) + stokes[:, 2] * np.sin(2 * prism)
    left = (1 + leak_left) * stokes[:, 0] + (1 - leak_left) * along
    right = gain * ((1 + leak_right) * stokes[:, 0] - (1 - leak_right) * along)
    return np.asarray((left - right) / (left + right))


def train_of_air(theta: Array, seen: Array) -> Array:
    """The train (13,) that fits air best, of many starts; linear light, plain plates."""
    random, best = np.random.default_rng(0), None

    def residual(x: Array) -> Array:
        return difference(np.r_[x, np.zeros(5)], theta, np.eye(4)) - seen

    for _ in range(STARTS):
        start = np.r_[np.pi / 2, np.pi / 2, random.uniform(-1.6, 1.6, 2), 0, 1, 0.005, 0.005]
        fit = least_squares(residual, start, max_nfev=60)
        if best is None or fit.cost < best.cost:
            best = fit
        if np.sqrt(2 * best.cost / theta.size) < FOUND:
            break
    assert best is not None
    return np.asarray(np.r_[best.x, np.zeros(5)])


def report(wavelength_nm: int, kind: str) -> str:
    """One line: residuals of both runs, retardance and diattenuation of the sample."""
    (air, seen_air), (turned, seen) = measured(wavelength_nm, False), measured(wavelength_nm, True)
    begin = train_of_air(air, seen_air)
    fitted, own = KINDS[kind]
    free = np.concatenate([np.arange(VALUES) < TRAIN + fitted, np.arange(5) < own, np.ones(15, dtype=bool)])

    def parts(x: Array) -> tuple[Array, Array, Array]:
        """Train in air, train with the sample, and the sample."""
        whole = np.zeros(free.size)
        whole[free] = x
        train, other = whole[:VALUES], whole[:VALUES].copy()
        other[TRAIN : TRAIN + own] = whole[VALUES : VALUES + own]
        return train, other, np.r_[1.0, whole[VALUES + 5 :]].reshape(4, 4)

    def residual(x: Array) -> Array:
        train, other, sample = parts(x)
        at = difference(train, air, np.eye(4)) - seen_air, difference(other, turned, sample) - seen
        return np.concatenate([*at, PULL / PLAUSIBLE * np.r_[train[TRAIN + 1 :], other[TRAIN + 1 :]]])

    starts = [np.r_[begin, np.zeros(5), mueller.retarder(azimuth, 3.1).reshape(-1)[1:]] for azimuth in (0.0, 1.5)]
    fit = min((least_squares(residual, start[free], max_nfev=50) for start in starts), key=lambda f: float(f.cost))
    train, other, sample = parts(fit.x)
    u, _, v = np.linalg.svd(sample[1:, 1:])
    retardance = np.degrees(np.arccos(np.clip((np.trace(u @ v) - 1) / 2, -1, 1)))
    runs = np.split(fit.fun[: air.size + turned.size], [air.size])
    left = [100 * np.sqrt(np.sum(part**2) / (part.size - values)) for part, values in zip(runs, (9, 15), strict=True)]
    light = np.degrees([train[ELLIPTICITY], other[ELLIPTICITY]])
    return (
        f"{wavelength_nm} | {kind} | {light[0]:.2f}, {light[1]:.2f} | "
        f"{left[0]:.3f}, {left[1]:.3f} | {retardance:.2f} | {np.linalg.norm(sample[0, 1:]):.4f}"
    )


def main() -> None:
    """Print the table of docs/studies/measured-instruments.md."""
    print("nm | ellipticity | degrees, air and plate | residual, air and plate, % | retardance | diattenuation")
    for wavelength_nm in (1200, 1300, 1600, 1950):
        for kind in KINDS:
            print(report(wavelength_nm, kind), flush=True)


if __name__ == "__main__":
    main()
