"""What free fits leave of two measured polarimeters, with nothing in common with `diagnose`: a floor for its figures.

    OPENBLAS_NUM_THREADS=1 python benchmarks/measured_floor.py

dual-beam-charis-nir: each of the 22 wavelengths by itself, the normalised difference of the channels by two turning
elements, a source and two detectors that may be anything (44 numbers, of which the data determine 23).
drr-single-detector-vis: noise of one row of the table from neighbouring rows, and what the train (6 values), faults in
the list of `diagnose` (20) and retardances that vary with the turn (24) leave of one row and of the mean of eleven
(20 nm). Twenty seconds of processor time. Results only; no data are copied.
"""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from processing.polarization import mueller

SHARED = Path(__file__).resolve().parents[1].parent / "shared/data"
FOLDS = 5
Array = NDArray[np.float64]
Model = Callable[[Array, NDArray[np.int64]], Array]


def fitted(model: Model, seen: Array, start: Array, use: NDArray[np.int64], width: Array) -> Array:
    """Values (K,) that fit the states `use` of `seen` best, drawn to `start` by one part in a thousand of `width`."""

    def residual(x: Array) -> Array:
        return np.concatenate([model(x, use) - seen[use], 1e-3 * (x - start) / width])

    return np.asarray(least_squares(residual, start, max_nfev=40).x)


def left(model: Model, seen: Array, start: Array, width: Array, values: int) -> tuple[float, float]:
    """Rms residual in percent for each degree of freedom of all states, and of states that the fit did not see."""
    states = np.arange(seen.size)
    x = fitted(model, seen, start, states, width)
    square = float(np.sum((model(x, states) - seen) ** 2))
    fold, held = np.random.default_rng(0).permutation(seen.size) % FOLDS, 0.0
    for k in range(FOLDS):
        part = states[fold == k]
        other = fitted(model, seen, x, states[fold != k], width)
        held += float(np.sum((model(other, part) - seen[part]) ** 2))
    return 100 * np.sqrt(square / (seen.size - values)), 100 * np.sqrt(held / seen.size)


class Telescope:
    """Difference over sum of the channels of one wavelength, of a train in which nothing is taken for granted."""

    #: Azimuths of the polarizer, the half-wave plate and the image rotator, and both retardances, in radians.
    NEAR = np.deg2rad([90.0, 88.0, 89.6, 169.8, 87.6])
    #: At this wavelength; the others begin where their neighbour ends.
    NEAR_NM = 1630.0
    #: Numbers of the train that the 64 differences determine.
    DETERMINED = 23

    def __init__(self, rows: list[dict[str, str]]) -> None:
        def column(name: str) -> Array:
            return np.array([float(row[name]) for row in rows])

        self.plate, self.rotator = (np.deg2rad(column(n)) for n in ("hwp_deg", "image_rotator_deg"))
        total = column("left") + column("right")
        self.seen = (column("left") - column("right")) / total
        self.noise_percent = 100 * float(np.mean(column("stderr") / total))

    def anything(self, x: Array, states: NDArray[np.int64]) -> Array:
        """Model of 44 numbers: Stokes vector of the light, Mueller matrices of both elements, two detectors."""
        plate, rotator = x[4:20].reshape(4, 4), x[20:36].reshape(4, 4)
        first, second = mueller.rotation(self.plate[states]), mueller.rotation(self.rotator[states])
        stokes = (first @ plate @ np.swapaxes(first, 1, 2)) @ x[:4]
        seen = np.einsum("nij,nj->ni", second @ rotator @ np.swapaxes(second, 1, 2), stokes)
        return np.asarray(seen @ (x[36:40] - x[40:]) / (seen @ (x[36:40] + x[40:])))

    def begin(self, train: Array) -> Array:
        """The 44 numbers of a plain train."""
        light, plate, rotator, half, other = train
        stokes = [1.0, np.cos(2 * light), np.sin(2 * light), 0.0]
        elements = mueller.retarder(plate, half).reshape(16), mueller.retarder(rotator, other).reshape(16)
        return np.concatenate([stokes, *elements, [1, 1, 0, 0], [1, -1, 0, 0]])

    def train(self, start: Array) -> Array:
        """The five values of a plain train that fit best."""
        states = np.arange(self.seen.size)
        return np.asarray(least_squares(lambda v: self.anything(self.begin(v), states) - self.seen, start).x)


class SingleDetector:
    """Signal of two plates that turn at 6 n and 30 n degrees, over its mean."""

    #: Scale, azimuth and retardance of both plates, azimuth of the analyzer; then offset and drift, transmission once
    #: and twice a turn, azimuth once a turn; then retardance once a turn: cosines and sines, of one plate after the
    #: other.
    BEGIN = np.concatenate([[1, 0.02, np.pi / 2, 0.02, np.pi / 2, 0], np.zeros(18)])
    WIDTH = np.concatenate([np.full(6, 10.0), np.full(18, 0.02)])
    #: So many of them are fitted.
    SIZES = (6, 20, 24)

    def __init__(self, volts: Array) -> None:
        self.seen = volts / volts.mean()

    def signal(self, x: Array, states: NDArray[np.int64]) -> Array:
        """Model of the first of the values, the others zero."""
        x = np.pad(x, (0, self.BEGIN.size - x.size))
        scale, a1, d1, a2, d2, analyzer, offset, drift = x[:8]
        stokes, light = np.broadcast_to([1.0, 1.0, 0.0, 0.0], (states.size, 4)), 1 + drift * (states - 30) / 30
        for plate, azimuth, retardance in ((0, a1, d1), (1, a2, d2)):
            turned = np.deg2rad((6, 30)[plate] * states)
            once, twice = (np.stack([np.cos(k * turned), np.sin(k * turned)], axis=-1) for k in (1, 2))
            passed, turn, thickness = (x[at + n * plate :][:n] for at, n in ((8, 4), (16, 2), (20, 2)))
            element = mueller.retarder(turned + azimuth + once @ turn, retardance + once @ thickness)
            stokes = np.einsum("nij,nj->ni", element, stokes)
            light = light * np.exp(once @ passed[:2] + twice @ passed[2:])
        behind = stokes[:, 0] + np.cos(2 * analyzer) * stokes[:, 1] + np.sin(2 * analyzer) * stokes[:, 2]
        return np.asarray(scale * behind * light + offset)


def telescope() -> None:
    """One line for each wavelength."""
    by_wavelength: dict[float, list[dict[str, str]]] = {}
    with (SHARED / "dual-beam-charis-nir/fluxes.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            by_wavelength.setdefault(float(row["wavelength_nm"]), []).append(row)
    data = {nm: Telescope(rows) for nm, rows in by_wavelength.items()}
    order, trains = sorted(data), dict[float, Array]()
    first = int(np.argmin(np.abs(np.array(order) - Telescope.NEAR_NM)))
    for way in (order[first:], order[first::-1]):
        train = Telescope.NEAR
        for nm in way:
            trains[nm] = train = data[nm].train(train)
    print("nm | photon noise, % | in sample, % | held out, %")
    for nm, one in sorted(data.items()):
        figures = left(one.anything, one.seen, one.begin(trains[nm]), np.full(44, 0.1), Telescope.DETERMINED)
        print(f"{nm:.0f} | {one.noise_percent:.3f} | {figures[0]:.3f} | {figures[1]:.3f}", flush=True)


def single_detector() -> None:
    """One line for each of three wavelengths."""
    rows = np.genfromtxt(SHARED / "drr-single-detector-vis/air_2021.csv", delimiter=",", skip_header=1)
    print("nm | noise of a row, % | values: in sample, held out of one row; of the mean of eleven")
    for nm in (450, 850, 1000):
        at = int(np.argmin(np.abs(rows[:, 0] - nm)))
        volts = rows[at - 5 : at + 6, 1:]
        # Rows are 2 nm apart and see 10 nm each: what differs from one to the next, slope and bend apart, is noise.
        bend = np.diff(volts / volts.mean(axis=1, keepdims=True), 3, axis=0)
        line = f"{nm} | {100 * np.sqrt(np.mean(bend**2) / 20):.2f}"
        for n in SingleDetector.SIZES:
            line += f" | {n}:"
            for one in (SingleDetector(rows[at, 1:]), SingleDetector(volts.mean(axis=0))):
                line += " {:.2f}, {:.2f};".format(*left(one.signal, one.seen, one.BEGIN[:n], one.WIDTH[:n], n))
        print(line, flush=True)


if __name__ == "__main__":
    single_detector()
    telescope()
