"""Score and optimize a table of Mueller states before any motor moves.

With rows kron(a, g) of W and a, g = 1/2 (1, s), the equally weighted variance is trace (W^T W)^-1: the sum of the
variances of the 16 elements for unit noise. It is least where s covers the sphere evenly on both sides, independently:
then W^T W = N/16 D (x) D with D = diag(1, 1/3, 1/3, 1/3), and the variance 1600 / N (40 for 40 states).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from processing.arrays import Array
from processing.doors import read_text
from processing.errors import ProcessError
from processing.instrument.determined_basis import determined_elements
from processing.instrument.model import InstrumentModel, Retarder, rank
from processing.instrument.states import Role, StateTable, rotating_retarders
from processing.polarization import mueller

#: Ratios that the optimizer tries: both signs leave the same determination, so only positive ones.
RATIOS = np.round(np.arange(1.0, 12.0001, 0.01), 2)
#: A design that is worse than this many times the bound is not worth refining.
HOPELESS = 20.0


@dataclass(frozen=True)
class AssumedNoise:
    """Detection noise of one intensity: read noise and the shot noise of a depolarizing sample.

    Attributes
    ----------
    electrons : mean signal of a state, for an ideal depolarizer; 0 leaves shot noise out.
    read_noise_e : standard deviation, electrons.
    """

    electrons: float
    read_noise_e: float

    def __post_init__(self) -> None:
        if not (self.electrons > 0 and self.read_noise_e >= 0):
            raise ProcessError(
                f"noise needs a positive signal and a read noise of 0 or more electrons; got {self.electrons:g} and "
                f"{self.read_noise_e:g}"
            )


@dataclass(frozen=True)
class Score:
    """How well a state table determines a Mueller matrix.

    Attributes
    ----------
    intensities : rows of W.
    rank : of W.
    full_rank : rank that the instrument can have; below it the other numbers are infinite.
    condition_number : of W, among what the instrument can determine.
    equally_weighted_variance : trace (W^T W)^-1, of the same.
    bound : the least that any table with as many intensities can have.
    element_stderr : (4, 4), standard error of m_ij / m00 for the stated noise, without the error of m00; NaN for
        elements that the instrument cannot determine.
    """

    intensities: int
    rank: int
    full_rank: int
    condition_number: float
    equally_weighted_variance: float
    bound: float
    element_stderr: Array


def score(w: Array, noise: AssumedNoise, basis: Array | None = None, bound: float | None = None) -> Score:
    """Score a measurement matrix (..., 16), rows kron(a, g) as `InstrumentModel.rows` gives them.

    `basis` (16, rank) and `bound` are those of the instrument (`free_angles`); default: all 16 elements.
    """
    w = np.asarray(w, dtype=float).reshape(-1, 16)
    basis = np.eye(16) if basis is None else basis
    n, determined, needed = len(w), rank(w), basis.shape[1]
    bound = 1600 / n if bound is None else bound
    if determined < needed:
        return Score(n, determined, needed, np.inf, np.inf, bound, np.full((4, 4), np.inf))
    inverse = basis @ np.linalg.pinv(w @ basis)
    # An ideal depolarizer of throughput m00 gives every state m00 w_n0.
    m00 = noise.electrons / w[:, 0].mean()
    variance = m00 * w[:, 0] + noise.read_noise_e**2
    stderr = np.sqrt((inverse**2) @ variance) / m00
    # An element is determined where it lies in the span of the basis, and so are ratios to m00.
    stderr[~determined_elements(basis)] = np.nan
    size = np.linalg.svd(w @ basis, compute_uv=False)
    variance_sum = equally_weighted_variance(w @ basis)
    return Score(n, determined, needed, float(size[0] / size[-1]), variance_sum, bound, stderr.reshape(4, 4))


def equally_weighted_variance(w: Array) -> float:
    """Trace of (W^T W)^-1; infinite where W lacks full rank."""
    values = np.linalg.eigvalsh(w.T @ w)
    return float(np.sum(1 / values)) if values[0] > 1e-10 * values[-1] else float("inf")


@dataclass(frozen=True)
class Design:
    """A table with equal steps over one turn, and the instrument's retardances for it, with its score."""

    states: int
    ratio: float
    generator_retardance_deg: float
    analyzer_retardance_deg: float
    score: Score

    def table(self, axes: tuple[str, str], exposure_s: float = 1.0) -> StateTable:
        """State table of the design; the first axis is the generator's."""
        return rotating_retarders(exposure_s, self.states, 360 / self.states, self.ratio, axes=axes)


def read_table(path: Path, axes: Sequence[str]) -> StateTable:
    """State table of a CSV file with a header: one column of degrees for each axis of the instrument.

    Raises ProcessError: a column is missing, or a value is no number.
    """
    lines = [line for line in read_text(path).splitlines() if line.strip()]
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    missing = [axis for axis in axes if axis not in header]
    if missing or len(lines) < 2:
        raise ProcessError(
            f"{path}: needs a header and one line a state, with a column of degrees for each of: {', '.join(axes)}; "
            f"found the columns: {', '.join(header) or 'none'}, {max(len(lines) - 1, 0)} states"
        )
    columns: dict[str, list[float]] = {axis: [] for axis in axes}
    for number, line in enumerate(lines[1:], 2):
        cells = line.split(",")
        for axis in axes:
            at = header.index(axis)
            try:
                columns[axis].append(float(cells[at]))
            except (ValueError, IndexError) as error:
                raise ProcessError(
                    f"{path}, state line {number}: column {axis!r} holds no number of degrees"
                ) from error
    n = len(lines) - 1
    sample: Role = "sample"
    try:
        return StateTable(
            {axis: np.array(values) for axis, values in columns.items()},
            np.ones(n),
            (sample,) * n,
            np.ones(n, dtype=np.int64),
        )
    except ValueError as error:
        raise ProcessError(f"{path}: {error}") from error


def two_retarders(model: InstrumentModel) -> tuple[Retarder, Retarder]:
    """The one turning retarder of the generator and the one of the analyzer.

    Raises ProcessError: the instrument is not of that kind, so there is nothing to optimize here.
    """
    retarders: list[Retarder] = []
    for side, train in (("generator", model.generator), ("analyzer", model.analyzer)):
        turning = [e for e in train if e.axis is not None]
        if len(turning) != 1 or not isinstance(turning[0], Retarder) or len(model.channels) != 1:
            names = ", ".join(e.name for e in turning) or "none"
            raise ProcessError(
                f"only dual rotating retarders with one channel are optimized; the {side} of {model.name!r} has the "
                f"turning elements: {names}. Score a table of your own with --table instead."
            )
        retarders.append(turning[0])
    return retarders[0], retarders[1]


def rows_of_design(
    states: int, ratio: float, generator_rad: float, analyzer_rad: float, *, zeros_rad: tuple[float, float, float]
) -> Array:
    """W (states, 16) of ideal elements; zeros are those of the generator retarder, analyzer retarder and analyzer."""
    angle = 2 * np.pi / states * np.arange(states)
    g = mueller.retarder(angle + zeros_rad[0], generator_rad)[..., :, :2] @ np.array([0.5, 0.5])
    analyzer = mueller.polarizer(zeros_rad[2])[0]
    a = analyzer @ mueller.retarder(ratio * angle + zeros_rad[1], analyzer_rad)
    return np.asarray((a[:, :, None] * g[:, None, :]).reshape(states, 16))


def optimize(
    model: InstrumentModel,
    noise: AssumedNoise,
    states: Sequence[int],
    free: Mapping[str, bool],
    *,
    ratio: float,
    progress: Callable[[int, int], None] | None = None,
) -> list[Design]:
    """Best table for each number of states: least equally weighted variance.

    Parameters
    ----------
    model : dual rotating retarder polarimeter, resolved at a wavelength.
    states : numbers of states to try, 16 or more.
    free : which of "retardances" and "ratio" may change; both retardances move together with their own values.
    ratio : where the ratio is not free, and always tried too.
    progress : called with (done, in all).

    Returns
    -------
    One design for each number of states, in their order.

    Raises
    ------
    ProcessError : not a dual rotating retarder, or fewer than 16 states.
    """
    if min(states) < 16:
        raise ProcessError(f"a Mueller matrix has 16 elements: {min(states)} states cannot determine it")
    generator, analyzer = two_retarders(model)
    fixed = _radians(generator.retardance_deg), _radians(analyzer.retardance_deg)
    zeros = _radians(generator.azimuth_deg), _radians(analyzer.azimuth_deg), _analyzer_azimuth(model)
    ratios = np.unique([ratio, *RATIOS]) if free.get("ratio") else np.array([ratio])
    done, total = 0, len(states) * len(ratios)
    designs = []
    for n in states:
        best = (np.inf, float(ratio), *fixed)
        for r in ratios:
            best = min(
                best, _best_retardances(n, float(r), fixed, zeros, free=bool(free.get("retardances")), to_beat=best[0])
            )
            done += 1
            if progress:
                progress(done, total)
        w = rows_of_design(n, best[1], best[2], best[3], zeros_rad=zeros)
        designs.append(Design(n, best[1], float(np.rad2deg(best[2])), float(np.rad2deg(best[3])), score(w, noise)))
    return designs


def _best_retardances(
    n: int, ratio: float, fixed: tuple[float, float], zeros: tuple[float, float, float], *, free: bool, to_beat: float
) -> tuple[float, float, float, float]:
    def cost(x: Array) -> float:
        return equally_weighted_variance(rows_of_design(n, ratio, float(x[0]), float(x[1]), zeros_rad=zeros))

    if not free:
        return cost(np.array(fixed)), ratio, *fixed
    # 127 degrees on both sides is the optimum for well spread angles, so a ratio that is bad there stays bad.
    start = np.deg2rad([127.0, 127.0])
    first = cost(start)
    if first > min(HOPELESS * 1600 / n, 1.5 * to_beat):
        return first, ratio, float(start[0]), float(start[1])
    minimum = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-4, "fatol": 1e-4, "maxiter": 120})
    return float(minimum.fun), ratio, float(minimum.x[0]), float(minimum.x[1])


def _analyzer_azimuth(model: InstrumentModel) -> float:
    elements = [*model.analyzer, *model.channels[0].elements]
    fixed = [e for e in elements if e.axis is None and e.kind == "polarizer"]
    return _radians(fixed[-1].azimuth_deg) if fixed else 0.0


def _radians(value: object) -> float:
    if not isinstance(value, float | int):
        raise ProcessError("the instrument has values for several wavelengths; give --wavelength")
    return float(np.deg2rad(value))
