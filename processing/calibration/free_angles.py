"""State tables with every angle free: least variance for any instrument whose axes turn.

The information of state n is u_n u_n^T, u_n = B^T w_n / sigma_n, where B spans what any states of the instrument can
determine: all 16 elements for a dual rotating retarder, 4 for a Stokes polarimeter. The cost is the trace of the
inverse of the summed information; its gradient by an angle follows from the rows at that angle moved a little, all
states at once.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from processing.arrays import Array
from processing.calibration.state_design import AssumedNoise
from processing.computing.blas import one_blas_thread
from processing.errors import ProcessError
from processing.instrument.determined_basis import DRAWN, determined_basis
from processing.instrument.model import InstrumentModel, Retarder

#: Step of the central difference of a row by an angle, radians: truncation and rounding are both near 1e-9 there.
STEP = 1e-4
#: Random starts at most; the search ends earlier where a start reaches the bound.
STARTS = 40
#: A design this close to the bound is not improved further.
AT_BOUND = 1.002


@dataclass(frozen=True)
class Goal:
    """Criterion by which a table of states is optimized.

    Attributes
    ----------
    noise : weigh each state by its shot and read noise at this light; None: equal weights.
    jitter_deg : standard deviation of every angle in every state, which acts like noise on a polarizing sample.
    polarization : rms of m_ij / m00 that the sample is expected to have, for `jitter_deg`.
    """

    noise: AssumedNoise | None = None
    jitter_deg: float = 0.0
    polarization: float = 0.3


@dataclass(frozen=True)
class FreeDesign:
    """A table of free angles.

    Attributes
    ----------
    angles_deg : axis name to (states,).
    retardances_deg : element name to retardance; those of the model where they were not free.
    variance : trace of the inverse information of what the instrument determines, for unit noise.
    bound : the least that any table of as many intensities can have.
    rank : number of elements, or combinations of them, that are determined.
    """

    angles_deg: Mapping[str, Array]
    retardances_deg: Mapping[str, float]
    variance: float
    bound: float
    rank: int


def bound_of(model: InstrumentModel, intensities: int) -> float:
    """Least trace of the inverse information of `intensities` rows.

    A side whose vectors 1/2 (1, s) cover a d-dimensional sphere evenly has information N/4 diag(1, 1/d, ...) and a
    trace of 4 (1 + d^2) / N; a side that stands still has one direction, of its own length.
    """
    random = np.random.default_rng(0)
    angles = {axis: random.uniform(0, 360, DRAWN) for axis in model.axes}
    product = 1.0
    for side in (model.generator_states(angles), model.analyzer_states(angles).reshape(-1, 4)):
        size = np.linalg.svd(side, compute_uv=False)
        dimension = int(np.sum(size > 1e-8 * size[0])) - 1
        length = float(np.max(np.sum(side**2, axis=1)))
        product *= 4 * (1 + dimension**2) if dimension else 1 / length
    return product / intensities


class Cost:
    """Trace of the inverse information and its gradient, of angles (axes, states) in radians and retardances."""

    def __init__(self, model: InstrumentModel, states: int, goal: Goal, free: Sequence[str]) -> None:
        self.model, self.states, self.goal, self.free = model, states, goal, tuple(free)
        self.axes = tuple(model.axes)
        self.basis = determined_basis(model)

    def split(self, x: Array) -> tuple[Array, Array]:
        """Angles (axes, states) and free retardances, radians."""
        angles = x[: len(self.axes) * self.states].reshape(len(self.axes), self.states)
        return angles, x[angles.size :]

    def rows(self, angles: Array, retardances: Array) -> Array:
        """W (states, channels, 16)."""
        model = with_retardances(self.model, dict(zip(self.free, np.rad2deg(retardances), strict=True)))
        w = model.rows({axis: np.rad2deg(angles[k]) for k, axis in enumerate(self.axes)})
        return np.asarray(w)

    def _weighted(self, w: Array, angles: Array, retardances: Array) -> Array:
        """Rows in the determined basis over their standard deviations."""
        variance = np.ones(w.shape[:2])
        noise = self.goal.noise
        if noise is not None:
            level = noise.electrons / max(float(w[..., 0].mean()), 1e-12)
            # Relative to the signal, so that unit noise and no noise have one scale.
            variance = (level * np.maximum(w[..., 0], 0) + noise.read_noise_e**2) / (
                noise.electrons + noise.read_noise_e**2
            )
        if self.goal.jitter_deg:
            variance = variance + self._jitter(angles, retardances)
        return np.asarray(w @ self.basis / np.sqrt(variance)[..., None])

    def _jitter(self, angles: Array, retardances: Array) -> Array:
        """Variance of the intensities by angles that scatter, over that of the noise."""
        noise = self.goal.noise or AssumedNoise(20_000, 0)
        size = np.deg2rad(self.goal.jitter_deg) * self.goal.polarization * np.sqrt(noise.electrons)
        total = np.zeros((self.states, 1))
        for k in range(len(self.axes)):
            step = np.zeros((len(self.axes), 1))
            step[k] = STEP
            change = (self.rows(angles + step, retardances) - self.rows(angles - step, retardances)) / (2 * STEP)
            total = total + np.sum(change[..., 1:] ** 2, axis=-1) * size**2
        return total

    def _information(self, u: Array) -> Array:
        flat = u.reshape(-1, u.shape[-1])
        return np.asarray(flat.T @ flat)

    def value(self, angles: Array, retardances: Array) -> float:
        """Trace of the inverse information; very large where it is singular."""
        u = self._weighted(self.rows(angles, retardances), angles, retardances)
        values = np.linalg.eigvalsh(self._information(u))
        return float(np.sum(1 / values)) if values[0] > 1e-10 * values[-1] else 1e12

    def __call__(self, x: Array) -> tuple[float, Array]:
        """Logarithm of the cost, and its gradient."""
        angles, retardances = self.split(x)
        # A row has angles of its own alone: those of all steps are made at once.
        steps = [sign * STEP * axis[:, None] for axis in np.eye(len(self.axes)) for sign in (1, -1)]
        w, *stepped = np.split(
            self.rows(np.hstack([angles, *(angles + s for s in steps)]), retardances), 1 + len(steps)
        )
        u = self._weighted(w, angles, retardances)
        information = self._information(u)
        # A little of the unit matrix keeps the first steps of a poor start finite.
        inverse = np.linalg.inv(information + 1e-9 * np.trace(information) * np.eye(len(information)))
        cost = float(np.trace(inverse))
        square = inverse @ inverse
        moved = (self._weighted(w, angles + s, retardances) for w, s in zip(stepped, steps, strict=True))
        power = np.array([np.einsum("nci,ij,ncj->n", v, square, v) for v in moved])
        gradient = -(power[::2] - power[1::2]) / (2 * STEP)
        by_retardance = np.empty_like(retardances)
        for k in range(retardances.size):
            step = np.zeros_like(retardances)
            step[k] = STEP
            by_retardance[k] = (self.value(angles, retardances + step) - self.value(angles, retardances - step)) / (
                2 * STEP
            )
        return float(np.log(cost)), np.concatenate([gradient.reshape(-1), by_retardance]) / cost


@one_blas_thread()
def free_design(
    model: InstrumentModel,
    states: int,
    goal: Goal | None = None,
    free_retardances: bool = False,
    *,
    first: Mapping[str, Array] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> FreeDesign:
    """The best table of `states` states that many random starts find.

    Parameters
    ----------
    model : InstrumentModel
        Resolved at a wavelength, without effects.
    states : int
    goal : Goal or None
        What is to be small; None: the equally weighted variance.
    free_retardances : bool
        Those of turning retarders may change too.
    first : mapping of axis to array (states,), or None
        A table to start from besides, degrees.
    progress : callable or None
        Called with (starts done, starts in all).

    Returns
    -------
    FreeDesign

    Raises
    ------
    ProcessError
        Nothing turns, or too few states for what the instrument can determine.

    Examples
    --------
    >>> model = InstrumentModel.load("instrument.yaml").at(662)
    >>> design = free_design(model, states=16)
    >>> design.rank, design.angles_deg["psg"].shape
    (16, (16,))
    """
    if not model.axes:
        raise ProcessError(f"no element of {model.name!r} turns, so there are no states to choose.")
    free = turning_retarders(model) if free_retardances else ()
    cost = Cost(model, states, goal or Goal(), free)
    intensities = states * len(model.channels)
    if intensities < cost.basis.shape[1]:
        raise ProcessError(
            f"{states} states give {intensities} intensities, and {model.name!r} can determine {cost.basis.shape[1]} "
            "numbers: they cannot all be determined. Take more states."
        )
    bound = bound_of(model, intensities)
    nominal = np.deg2rad([retardance_deg(model, name) for name in free])
    random = np.random.default_rng(0)
    best: tuple[float, Array] | None = None
    for start in range(STARTS):
        if first is not None and start == 0:
            angles = np.deg2rad([np.asarray(first[axis], dtype=float) for axis in cost.axes])
        else:
            angles = random.uniform(0, np.pi, (len(cost.axes), states))
        spread = random.normal(0, 0.2, nominal.size) if start else 0.0
        x = np.concatenate([angles.reshape(-1), nominal + spread])
        minimum = minimize(cost, x, jac=True, method="L-BFGS-B", options={"maxiter": 500, "maxcor": 20})
        if best is None or minimum.fun < best[0]:
            x = np.asarray(minimum.x)
            x[: len(cost.axes) * states] %= 2 * np.pi
            best = (float(minimum.fun), x)
        if progress:
            progress(start + 1, STARTS)
        plain = _plain(model, cost, best[1])
        if plain < AT_BOUND * bound:
            if progress:
                progress(STARTS, STARTS)
            break
    assert best is not None
    return design_of(model, cost, best[1], bound)


def design_of(model: InstrumentModel, cost: Cost, x: Array, bound: float) -> FreeDesign:
    """The design of a vector of angles and retardances in radians."""
    angles, retardances = cost.split(x)
    named = {name: retardance_deg(model, name) for name in turning_retarders(model)}
    return FreeDesign(
        angles_deg={axis: np.rad2deg(angles[k]) for k, axis in enumerate(cost.axes)},
        retardances_deg=named | dict(zip(cost.free, np.rad2deg(retardances).tolist(), strict=True)),
        variance=_plain(model, cost, x),
        bound=bound,
        rank=cost.basis.shape[1],
    )


def _plain(model: InstrumentModel, cost: Cost, x: Array) -> float:
    """Equally weighted variance of what was found, whatever it was found for."""
    return Cost(model, cost.states, Goal(), cost.free).value(*cost.split(x))


def turning_retarders(model: InstrumentModel) -> tuple[str, ...]:
    """Names of the retarders that an axis turns."""
    return tuple(e.name for e in model.elements() if isinstance(e, Retarder) and e.axis is not None)


def with_retardances(model: InstrumentModel, retardances_deg: Mapping[str, float]) -> InstrumentModel:
    """A copy of the model with other retardances."""
    values = {name: {"retardance_deg": float(value)} for name, value in retardances_deg.items()}
    return model.with_values(values) if values else model


def retardance_deg(model: InstrumentModel, name: str) -> float:
    """Retardance of an element at the model's wavelength; ProcessError where several are given."""
    value = model.value_of(f"{name}.retardance_deg")
    if not isinstance(value, float | int):
        raise ProcessError("the instrument has values for several wavelengths; give --wavelength")
    return float(value)
