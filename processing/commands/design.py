"""`process design`: score a table of Mueller states, optimize one, or choose the illumination of a Stokes capture."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.command_line import CALIBRATION, command
from processing.whole_file import write_new_text

if TYPE_CHECKING:
    from processing.calibration.state_design import AssumedNoise, Score
    from processing.instrument.model import InstrumentModel
    from processing.instrument.states import StateTable


@command("design", CALIBRATION)
def design_command(
    *,
    instrument: Annotated[Path | None, typer.Argument(help="Instrument file of a Mueller polarimeter.")] = None,
    wavelength: Annotated[float | None, typer.Option(help="Wavelength in nm.")] = None,
    states: Annotated[str, typer.Option(help="Number of states; several for --optimize: 24,30,40.")] = "40",
    ratio: Annotated[float, typer.Option(help="Analyzer retarder angle over generator retarder angle.")] = 4.91,
    step: Annotated[
        float | None, typer.Option(help="Step in degrees; default: one turn, or half of one if its states repeat.")
    ] = None,
    table: Annotated[
        Path | None, typer.Option(help="CSV of your own states: a column of degrees for each axis.")
    ] = None,
    optimize: Annotated[
        str | None, typer.Option(help="What may change: angles, retardances, ratio; several with a comma.")
    ] = None,
    speed: Annotated[
        list[str] | None,
        typer.Option(help="AXIS=DEG_PER_S:DEG_PER_S2 of every axis: --optimize angles also saves motor time."),
    ] = None,
    weighted: Annotated[bool, typer.Option("--weighted", help="Optimize for --electrons and --read-noise.")] = False,
    jitter: Annotated[float, typer.Option(min=0, help="Angles scatter by so many degrees: prefer what bears it.")] = 0,
    electrons: Annotated[
        float, typer.Option(help="Mean signal of a state, electrons, for the standard errors.")
    ] = 20_000,
    read_noise: Annotated[float, typer.Option(help="Read noise, electrons.")] = 3.0,
    out: Annotated[
        Path | None, typer.Option(help="Write the table of the (last) design: CSV, or a plan (.yaml).")
    ] = None,
    stokes: Annotated[bool, typer.Option("--stokes", help="Illumination of a linear Stokes capture instead.")] = False,
    geometry: Annotated[Path | None, typer.Option(help="--stokes: geometry file.")] = None,
    material: Annotated[Path | None, typer.Option(help="--stokes: material file, the dominant process.")] = None,
    camera: Annotated[Path | None, typer.Option(help="--stokes: instrument file of the Stokes camera.")] = None,
    figure: Annotated[Path, typer.Option(help="--stokes: figure to draw (PNG).")] = Path("stokes_design.png"),
    xi0: Annotated[float, typer.Option(min=0.25, max=1, help="--stokes: xi0 that is assumed.")] = 0.4,
    albedo: Annotated[float, typer.Option(min=0, help="--stokes: M00 at normal incidence that is assumed.")] = 0.5,
) -> None:
    """Rank, condition number, equally weighted variance and standard errors of a table, before any motor moves."""
    from processing.doors import require_new
    from processing.errors import ProcessError

    if out is not None:
        require_new(out)
    if stokes:
        if geometry is None or material is None or camera is None:
            raise ProcessError("--stokes needs --geometry FILE, --material FILE and --camera FILE")
        from processing.calibration.illumination_design import Assumptions
        from processing.commands.reflectance import design_stokes

        assumed = Assumptions(xi0=xi0, albedo=albedo, electrons=electrons)
        design_stokes(geometry, material, camera, assumed, figure=figure)
        return
    if instrument is None:
        raise ProcessError("give an instrument file, for instance configs/instruments/rgb950.yaml (or --stokes)")
    from processing.calibration.free_angles import bound_of
    from processing.calibration.state_design import AssumedNoise, score
    from processing.instrument.applied_effects import changes_at
    from processing.instrument.determined_basis import determined_basis
    from processing.instrument.model import InstrumentModel

    model = InstrumentModel.load(instrument)
    if wavelength is None and model.wavelengths_nm and len(model.wavelengths_nm) > 1:
        listed = ", ".join(f"{nm:g}" for nm in model.wavelengths_nm)
        raise ProcessError(f"{instrument} is given at {listed} nm: choose one with --wavelength")
    nm = wavelength if wavelength is not None else (model.wavelengths_nm or (0.0,))[0]
    model = model.at(nm) if nm else model
    noise = AssumedNoise(electrons, read_noise)
    counts = _counts(states)
    if optimize is not None and "angles" in optimize:
        from processing.commands.loaded_late.design_angles import optimize_angles

        now = {n: _present(model, n, ratio, step, table=table) for n in counts}
        chosen = optimize_angles(model, noise, now, optimize, speeds=speed or (), weighted=weighted, jitter_deg=jitter)
    elif optimize is not None:
        chosen = _optimize(model, noise, counts, optimize, ratio=ratio)
    else:
        chosen = _one_table(model, counts, ratio, step, table=table)
        w = model.rows(chosen.angles_deg, changes_at(model, chosen.angles_deg))
        intensities = len(chosen) * len(model.channels)
        result = score(w, noise, determined_basis(model), bound_of(model, intensities))
        at = f", {nm:g} nm" if nm else ""
        _show(f"{model.name}{at}, {len(chosen)} states", result, noise)
        if result.rank == result.full_rank:
            from processing.commands.loaded_late.design_angles import tell_robustness

            tell_robustness(model, chosen.angles_deg)
    if out is not None:
        _write(chosen, out, nm)
        typer.echo(str(out))


def _counts(text: str) -> list[int]:
    from processing.errors import ProcessError

    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError as error:
        raise ProcessError(f"--states {text!r}: give whole numbers, for instance 40 or 24,30,40") from error
    if min(counts) < 1:
        raise ProcessError(f"--states {text!r}: a table has at least one state")
    return counts


def _present(
    model: InstrumentModel, count: int, ratio: float, step: float | None, *, table: Path | None
) -> StateTable | None:
    """The states of the present measurement: the given table, or equal steps where the instrument allows them."""
    from processing.errors import ProcessError

    try:
        return _one_table(model, [count], ratio, step, table=table)
    except ProcessError:
        if table is not None:
            raise
        return None


def _one_table(
    model: InstrumentModel, counts: list[int], ratio: float, step: float | None, *, table: Path | None
) -> StateTable:
    import numpy as np

    from processing.calibration.state_design import read_table
    from processing.errors import ProcessError
    from processing.instrument.states import StateTable, rotating_retarders

    if table is not None:
        return read_table(table, model.axes)
    if len(model.axes) == 1:
        from processing.calibration.motor_time import periods_deg

        # Where rows repeat after half a turn, equal steps over a whole one would take every state twice.
        turn = step if step is not None else periods_deg(model)[model.axes[0]] / counts[0]
        return StateTable.of_angles({model.axes[0]: turn * np.arange(counts[0], dtype=float)})
    turning = [next((e.axis for e in train if e.axis), "") for train in (model.generator, model.analyzer)]
    if sorted(turning) != list(model.axes):
        raise ProcessError(
            f"equal steps are for one axis, or one on either side; {model.name!r} turns "
            f"{', '.join(model.axes) or 'none'}. Give --table FILE or --optimize angles."
        )
    axes = (turning[0], turning[1])
    return rotating_retarders(1.0, counts[0], step if step is not None else 360 / counts[0], ratio, axes=axes)


def _optimize(model: InstrumentModel, noise: AssumedNoise, counts: list[int], free: str, *, ratio: float) -> StateTable:
    from processing.calibration.state_design import optimize, two_retarders
    from processing.commands.progress_bar import progress_bar
    from processing.errors import ProcessError

    names = {name.strip() for name in free.split(",")}
    if not names <= {"retardances", "ratio"}:
        raise ProcessError(f"--optimize {free!r}: what may change is angles, retardances, ratio, or two of them")
    with progress_bar("optimizing", "ratios") as tick:
        designs = optimize(model, noise, counts, dict.fromkeys(names, True), ratio=ratio, progress=tick)
    for d in designs:
        title = (
            f"{d.states} states, ratio {d.ratio:g}, retardances {d.generator_retardance_deg:.1f} (generator) and "
            f"{d.analyzer_retardance_deg:.1f} degrees (analyzer)"
        )
        _show(title, d.score, noise)
    generator, analyzer = two_retarders(model)
    return designs[-1].table((str(generator.axis), str(analyzer.axis)))


def _show(title: str, result: Score, noise: AssumedNoise) -> None:
    typer.echo(title)
    typer.echo(f"  rank {result.rank} of {result.full_rank}, condition number {result.condition_number:.4g}")
    typer.echo(
        f"  equally weighted variance {result.equally_weighted_variance:.4g}; the bound for {result.intensities} "
        f"intensities is {result.bound:.4g}"
    )
    if result.rank < result.full_rank:
        typer.echo(
            "  these states do not determine all that the instrument can: take another ratio, or less regular steps"
        )
        return
    typer.echo(
        f"  standard errors of m_ij / m00, an ideal depolarizer at {noise.electrons:g} electrons a state, read noise "
        f"{noise.read_noise_e:g}:"
    )
    for row in result.element_stderr:
        typer.echo("    " + "  ".join(f"{value:.5f}" if value == value else "   -   " for value in row))


def _write(table: StateTable, path: Path, wavelength_nm: float) -> None:
    names = list(table.angles_deg)
    if path.suffix in (".yaml", ".yml"):
        light = [f"wavelength_nm: {wavelength_nm:g}"] if wavelength_nm else []
        lines = ["kind: plan", *light, "states:", "  kind: table", "  angles:"]
        for name in names:
            lines.append(f"    {name}: [{', '.join(f'{angle:.4f}' for angle in table.angles_deg[name])}]")
        write_new_text(path, "\n".join(lines) + "\n")
        return
    lines = [",".join(names)]
    lines += [",".join(f"{table.angles_deg[name][k]:.6f}" for name in names) for k in range(len(table))]
    write_new_text(path, "\n".join(lines) + "\n")
