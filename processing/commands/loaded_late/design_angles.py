"""`process design --optimize angles`: every angle free, and motor time as a second goal."""

from collections.abc import Mapping, Sequence

import typer

from processing.arrays import Array
from processing.calibration.free_angles import FreeDesign, Goal, bound_of, free_design, with_retardances
from processing.calibration.motor_time import Point, Speed, front, move_seconds
from processing.calibration.robustness import ERRORS, errors_of_table
from processing.calibration.state_design import AssumedNoise, score
from processing.commands.progress_bar import progress_bar
from processing.errors import ProcessError
from processing.instrument.determined_basis import determined_basis
from processing.instrument.model import InstrumentModel
from processing.instrument.states import StateTable, rotating_retarders

MAY_CHANGE = {"angles", "retardances"}
#: Of a table without rank: `Cost.value` says 1e12.
SINGULAR = 1e9


def optimize_angles(
    model: InstrumentModel,
    noise: AssumedNoise,
    now: Mapping[int, StateTable | None],
    free: str,
    *,
    speeds: Sequence[str],
    weighted: bool,
    jitter_deg: float,
) -> StateTable:
    """Optimize, print, and return the (last) best table; `now` has what is measured now for each number of states.

    Raises ProcessError: what may change is no such thing, an axis is unknown, or no table determines all.
    """
    names = {name.strip() for name in free.split(",")}
    if not names <= MAY_CHANGE:
        raise ProcessError(f"--optimize {free!r}: free angles go with retardances, not with a ratio")
    model = model.model_copy(update={"effects": ()})
    goal = Goal(noise if weighted else None, jitter_deg)
    limits = dict(Speed.parse(text) for text in speeds)
    unknown = sorted(set(limits) - set(model.axes))
    if unknown:
        raise ProcessError(f"--speed {unknown[0]}: the instrument turns {', '.join(model.axes)}")
    for n, present in now.items():
        with progress_bar(f"{n} states", "starts") as tick:
            if limits:
                points = front(model, n, limits, goal, free_retardances="retardances" in names, progress=tick)
            else:
                points = [Point(free_design(model, n, goal, "retardances" in names, progress=tick), float("nan"))]
        best = points[0].design
        if best.variance >= SINGULAR:
            raise ProcessError(f"no {n} states of {model.name!r} were found that determine all that it can; take more")
        _show(model, n, best)
        if present is not None:
            _show_present(model, noise, present, "retardances" in names)
        if limits:
            _show_front(model, n, points, limits)
        tell_robustness(with_retardances(model, best.retardances_deg), best.angles_deg)
    return StateTable.of_angles(best.angles_deg)


def tell_robustness(model: InstrumentModel, angles_deg: Mapping[str, Array]) -> None:
    """Print what errors of the bench would do to a matrix that a table gives."""
    typer.echo("  rms error of m_ij / m00 that an undeclared error of the bench makes (a sample with rms m_ij of 0.3):")
    for name, value in errors_of_table(model, angles_deg).items():
        typer.echo(f"    {ERRORS[name]}: {value:.5f}")


def _show(model: InstrumentModel, states: int, best: FreeDesign) -> None:
    plates = ", ".join(f"{name} {value:.1f}" for name, value in best.retardances_deg.items())
    suffix = f", retardances {plates} degrees" if plates else ""
    typer.echo(f"{states} states, free angles, rank {best.rank}{suffix}")
    typer.echo(
        f"  equally weighted variance {best.variance:.4f}; the bound for {states * len(model.channels)} intensities "
        f"is {best.bound:.4f} ({best.variance / best.bound - 1:+.2%})"
    )


def _show_present(model: InstrumentModel, noise: AssumedNoise, now: StateTable, with_plates: bool) -> None:
    basis, intensities = determined_basis(model), len(now) * len(model.channels)
    result = score(model.rows(now.angles_deg), noise, basis, bound_of(model, intensities))
    is_whole = result.rank == result.full_rank
    variance = f"{result.equally_weighted_variance:.4f}" if is_whole else f"rank {result.rank} of {result.full_rank}"
    change = "the table, and plates of these retardances" if with_plates else "the table alone"
    typer.echo(f"  the table as it is, {len(now)} states: {variance}; to change at the bench: {change}")


def _show_front(model: InstrumentModel, states: int, points: Sequence[Point], speeds: dict[str, Speed]) -> None:
    typer.echo("  variance   motor time")
    for point in points:
        typer.echo(f"  {point.design.variance:8.3f}   {point.seconds:8.1f} s")
    if len(model.axes) == 2:
        import numpy as np

        equal = rotating_retarders(1.0, states, 360 / states, axes=(model.axes[0], model.axes[1])).angles_deg
        angles = np.stack([equal[axis] for axis in model.axes])
        seconds = move_seconds(angles, [speeds[axis] for axis in model.axes])
        typer.echo(f"  (equal steps, ratio 4.91: {seconds:.1f} s)")
