"""The time that motors need for a table of states, its best order, and what a faster table costs in variance."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from processing.arrays import Array
from processing.calibration.free_angles import Cost, FreeDesign, Goal, design_of, free_design
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel

#: Weights of the log of the motor time against the log of the variance, from "time does not matter" on.
WEIGHTS = (0.0, 0.1, 0.3, 1.0, 3.0)
#: Rounds of exchanging two pieces of the order; each looks at all pairs of states.
ROUNDS = 20
#: Smooths the slower of the axes, and a move around zero, so that the time has a gradient; degrees.
SMOOTH_DEG = 0.5


@dataclass(frozen=True)
class Speed:
    """Speed and acceleration of an axis, degrees per second and per second squared."""

    deg_s: float
    deg_s2: float

    @classmethod
    def parse(cls, text: str) -> "tuple[str, Speed]":
        """AXIS=SPEED or AXIS=SPEED:ACCELERATION, degrees and seconds; without acceleration one of half a second."""
        name, _, numbers = text.partition("=")
        try:
            parts = [float(part) for part in numbers.split(":")]
            speed = parts[0]
            acceleration = parts[1] if len(parts) > 1 else 2 * speed
        except ValueError as error:
            raise ProcessError(f"--speed {text!r}: give AXIS=DEG_PER_S or AXIS=DEG_PER_S:DEG_PER_S2") from error
        if not name or not (speed > 0 and acceleration > 0 and np.isfinite([speed, acceleration]).all()):
            raise ProcessError(f"--speed {text!r}: a speed and an acceleration are positive numbers of degrees")
        return name, cls(speed, acceleration)

    def seconds(self, distance_deg: Array) -> Array:
        """Duration of moves (...) in degrees from rest to rest, on a trapezoid of speed."""
        d = np.abs(distance_deg)
        ramp = self.deg_s**2 / self.deg_s2
        return np.where(d < ramp, 2 * np.sqrt(d / self.deg_s2), d / self.deg_s + self.deg_s / self.deg_s2)


def periods_deg(model: InstrumentModel) -> dict[str, float]:
    """Turn after which the rows of an axis repeat: 180 degrees for plates and polarizers, else 360."""
    random = np.random.default_rng(0)
    angles = {axis: random.uniform(0, 360, 8) for axis in model.axes}
    rows = model.rows(angles)
    periods = {}
    for axis in model.axes:
        half = model.rows(angles | {axis: angles[axis] + 180})
        periods[axis] = 180.0 if np.allclose(half, rows, atol=1e-9) else 360.0
    return periods


def unwound(angles: Array, periods: Array) -> Array:
    """The same poses (axes, states), every move the short way round."""
    step = np.diff(angles, axis=1)
    step -= periods[:, None] * np.round(step / periods[:, None])
    first = angles[:, :1] % periods[:, None]
    return np.asarray(np.concatenate([first, first + np.cumsum(step, axis=1)], axis=1))


def move_seconds(angles: Array, speeds: Sequence[Speed]) -> float:
    """Time of all moves of a table (axes, states), axes moving at once."""
    step = np.diff(angles, axis=1)
    return float(np.max([s.seconds(step[k]) for k, s in enumerate(speeds)], axis=0).sum())


def order_states(angles: Array, periods: Array, speeds: Sequence[Speed]) -> Array:
    """(axes, states) in an order that takes little time: nearest first, then pieces turned round while that helps."""
    n = angles.shape[1]
    apart = angles[:, :, None] - angles[:, None, :]
    apart -= periods[:, None, None] * np.round(apart / periods[:, None, None])
    cost = np.max([s.seconds(apart[k]) for k, s in enumerate(speeds)], axis=0)
    pending, route = set(range(1, n)), [0]
    while pending:
        nearest = min(pending, key=lambda k: cost[route[-1], k])
        route.append(nearest)
        pending.remove(nearest)
    path = np.array(route)
    for _ in range(ROUNDS):
        changed = False
        for i in range(1, n - 1):
            for j in range(i + 1, n):
                before = cost[path[i - 1], path[i]] + (cost[path[j], path[j + 1]] if j + 1 < n else 0)
                after = cost[path[i - 1], path[j]] + (cost[path[i], path[j + 1]] if j + 1 < n else 0)
                if after < before - 1e-9:
                    path[i : j + 1] = path[i : j + 1][::-1]
                    changed = True
        if not changed:
            break
    return unwound(angles[:, path], periods)


@dataclass(frozen=True)
class Point:
    """One table on the front of variance against time."""

    design: FreeDesign
    seconds: float


def front(
    model: InstrumentModel,
    states: int,
    speeds: Mapping[str, Speed],
    goal: Goal | None = None,
    *,
    free_retardances: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> list[Point]:
    """Tables from the least variance to the least time of the motors; none is worse than another in both.

    Raises ProcessError: an axis of the instrument has no speed.
    """
    missing = [axis for axis in model.axes if axis not in speeds]
    if missing:
        raise ProcessError(f"--speed is missing for: {', '.join(missing)}")
    rates = [speeds[axis] for axis in model.axes]
    turn = np.array([periods_deg(model)[axis] for axis in model.axes])
    best = free_design(model, states, goal, free_retardances, progress=progress)
    cost = Cost(model, states, goal or Goal(), tuple(best.retardances_deg) if free_retardances else ())
    angles = order_states(np.stack([best.angles_deg[axis] for axis in model.axes]), turn, rates)
    retardances = np.deg2rad([best.retardances_deg[name] for name in cost.free])
    points = []
    for weight in WEIGHTS:
        if weight:
            x = np.concatenate([np.deg2rad(angles).reshape(-1), retardances])
            solved = minimize(_timed(cost, rates, weight), x, jac=True, method="L-BFGS-B", options={"maxiter": 300})
            moved, retardances = cost.split(np.asarray(solved.x))
            angles = order_states(np.rad2deg(moved), turn, rates)
        design = design_of(model, cost, np.concatenate([np.deg2rad(angles).reshape(-1), retardances]), best.bound)
        points.append(Point(design, move_seconds(angles, rates)))
    points.sort(key=lambda p: p.design.variance)
    return [p for k, p in enumerate(points) if all(p.seconds < q.seconds for q in points[:k])]


def _timed(cost: Cost, speeds: Sequence[Speed], weight: float) -> Callable[[Array], tuple[float, Array]]:
    pace = np.array([[s.deg_s] for s in speeds])

    def value(x: Array) -> tuple[float, Array]:
        first, gradient = cost(x)
        angles, _ = cost.split(x)
        step = np.rad2deg(np.diff(angles, axis=1)) / pace
        small = SMOOTH_DEG / float(pace.max())
        # The slower axis decides: a high power of both is a smooth maximum.
        root = np.sum(step**8, axis=0) + small**8
        seconds = root ** (1 / 8)
        total = seconds.sum()
        slope = step**7 / root ** (7 / 8) / total
        by_angle = np.zeros_like(angles)
        by_angle[:, 1:] += slope
        by_angle[:, :-1] -= slope
        by_angle *= np.rad2deg(1.0) / pace
        gradient = gradient.copy()
        gradient[: by_angle.size] += weight * by_angle.reshape(-1)
        return first + weight * float(np.log(total)), gradient

    return value
