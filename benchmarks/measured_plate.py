"""What the half-wave plate of the Wollaston polarimeter is, by fits with nothing in common with `diagnose`.

    OPENBLAS_NUM_THREADS=1 python benchmarks/measured_plate.py

Both runs of ../shared/data/drr-wollaston-nir (air, and the plate as an unknown Mueller matrix) are fitted together to
the normalised difference of the channels, so the source does not count: train, channel gain, extinctions, and the
ellipticity of the light, which is either one value or one for each run. Some seconds. Results only; no data are copied.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from processing.polarization import mueller

FOLDER = Path(__file__).resolve().parents[1].parent / "shared/data/drr-wollaston-nir"
#: Retardances, azimuths of both plates, of the prism, gain of the right channel, two extinctions, then ellipticity.
TRAIN, ELLIPTICITY = 8, 8
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


def difference(train: Array, theta: Array, sample: Array) -> Array:
    """Normalised difference (N,) of the model."""
    d1, d2, t1, t2, prism, gain, leak_left, leak_right, ellipticity = train
    light = np.array([1, np.cos(2 * ellipticity), 0, np.sin(2 * ellipticity)])
    stokes = mueller.retarder(5 * theta + t2, d2) @ sample @ mueller.retarder(theta + t1, d1) @ light
    along = stokes[:, 1] * np.cos(2 * prism) + stokes[:, 2] * np.sin(2 * prism)
    left = (1 + leak_left) * stokes[:, 0] + (1 - leak_left) * along
    right = gain * ((1 + leak_right) * stokes[:, 0] - (1 - leak_right) * along)
    return np.asarray((left - right) / (left + right))


def train_of_air(theta: Array, seen: Array) -> Array:
    """The train (9,) that fits air best, of many starts; linear light."""
    random, best = np.random.default_rng(0), None

    def residual(x: Array) -> Array:
        return difference(np.r_[x, 0.0], theta, np.eye(4)) - seen

    for _ in range(STARTS):
        start = np.r_[np.pi / 2, np.pi / 2, random.uniform(-1.6, 1.6, 2), 0, 1, 0.005, 0.005]
        fit = least_squares(residual, start, max_nfev=60)
        if best is None or fit.cost < best.cost:
            best = fit
        if np.sqrt(2 * best.cost / theta.size) < FOUND:
            break
    assert best is not None
    return np.asarray(np.r_[best.x, 0.0])


def report(wavelength_nm: int, own_ellipticity: bool) -> str:
    """One line: residuals of both runs, retardance and diattenuation of the plate."""
    (air, seen_air), (turned, seen) = measured(wavelength_nm, False), measured(wavelength_nm, True)
    begin = train_of_air(air, seen_air)

    def residual(x: Array) -> Array:
        other = x[:9].copy()
        if own_ellipticity:
            other[ELLIPTICITY] = x[9]
        plate = np.r_[1.0, x[10:]].reshape(4, 4)
        at = difference(x[:9], air, np.eye(4)), difference(other, turned, plate)
        return np.concatenate([at[0] - seen_air, at[1] - seen])

    starts = [np.r_[begin, 0.0, mueller.retarder(azimuth, 3.1).reshape(-1)[1:]] for azimuth in (0.0, 1.5)]
    fit = min((least_squares(residual, start) for start in starts), key=lambda f: float(f.cost))
    plate = np.r_[1.0, fit.x[10:]].reshape(4, 4)
    u, _, v = np.linalg.svd(plate[1:, 1:])
    retardance = np.degrees(np.arccos(np.clip((np.trace(u @ v) - 1) / 2, -1, 1)))
    runs = np.split(fit.fun, 2)
    left = [100 * np.sqrt(np.mean(part**2) * part.size / free) for part, free in zip(runs, (37, 31), strict=True)]
    light = np.degrees(fit.x[[8, 9]] if own_ellipticity else fit.x[[8, 8]])
    return (
        f"{wavelength_nm} | {'one each' if own_ellipticity else 'one'} | {light[0]:.2f}, {light[1]:.2f} | "
        f"{left[0]:.3f}, {left[1]:.3f} | {retardance:.2f} | {np.linalg.norm(plate[0, 1:]):.4f}"
    )


def main() -> None:
    """Print the table of docs/closing-the-loop.md."""
    print("nm | ellipticity | degrees, air and plate | residual, air and plate, % | retardance | diattenuation")
    for wavelength_nm in (1200, 1300, 1600, 1950):
        for own in (False, True):
            print(report(wavelength_nm, own), flush=True)


if __name__ == "__main__":
    main()
