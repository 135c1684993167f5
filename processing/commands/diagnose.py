"""The `diagnose` command."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from processing.commands.command_line import run

if TYPE_CHECKING:
    from processing.diagnosis.search.result import Diagnosis, FoundEffect

app = typer.Typer(
    name="diagnose",
    help="Compare captures with an instrument model and find the effect that the model lacks.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


@app.command()
def diagnose_command(
    captures: Annotated[list[Path], typer.Argument(help="Captures of one instrument at one wavelength.")],
    instrument: Annotated[Path, typer.Option(help="Instrument file that the intensities are compared with.")],
    write: Annotated[
        Path | None, typer.Option(help="New file with the effects found: instrument, or material.")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Result as JSON.")] = None,
    report: Annotated[Path | None, typer.Option(help="Report with figures (HTML, one file).")] = None,
    reflectance: Annotated[
        Path | None, typer.Option(help="Material file: the sample is triply degenerate with this dominant process.")
    ] = None,
    geometry: Annotated[Path | None, typer.Option(help="Geometry file of the object, with --reflectance.")] = None,
) -> None:
    """Trace the residual between intensities and model to the effects that explain it; say so if none does."""
    # The problems are many and small: BLAS threads would only wait for one another.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for target in (write, json, report):
        if target is not None and target.exists():
            from processing.errors import ProcessError

            raise ProcessError(f"{target} exists and is not replaced. Give another name.")
    if reflectance is not None or geometry is not None:
        from processing.commands.diagnose_surface import diagnose_reflectance

        diagnose_reflectance(captures, instrument, reflectance, geometry, write, json, report)
        return
    from processing.diagnosis.instrument.run import diagnose_captures
    from processing.instrument.model import InstrumentModel

    def say(line: str) -> None:
        typer.echo(line, err=True)

    model = InstrumentModel.load(instrument)
    judged, problem = diagnose_captures(captures, model, say)
    show(judged.diagnosis)
    if json is not None:
        json.write_text(judged.diagnosis.model_dump_json(indent=2) + "\n", encoding="utf-8")
        typer.echo(str(json))
    if report is not None:
        from processing.diagnosis.instrument.report import write_report

        write_report(report, judged, problem)
        typer.echo(str(report))
    if write is not None:
        from processing.diagnosis.instrument.write import write_instrument

        write_instrument(write, model, judged.diagnosis)
        typer.echo(str(write))


def show(d: Diagnosis) -> None:
    """Print a summary."""
    if d.simulated:
        typer.echo("SIMULATED data")
    typer.echo(f"{d.instrument}, {d.wavelength_nm:g} nm: {d.verdict.replace('_', ' ')}")
    before, after = d.error_before, d.error_after
    typer.echo(f"  error before  {before.rms_percent:8.4f} % of the mean signal, chi2/dof {before.chi2_reduced:.4g}")
    typer.echo(f"  error after   {after.rms_percent:8.4f} % of the mean signal, chi2/dof {after.chi2_reduced:.4g}")
    if d.noise_floor_percent is not None:
        typer.echo(f"  noise floor   {d.noise_floor_percent:8.4f} %")
    typer.echo(f"  held out: {before.held_out}")
    for c in d.captures:
        if c.cut_off:
            states = f"state{'s' if len(c.cut_off) > 1 else ''} {', '.join(str(k) for k in c.cut_off)}"
            typer.echo(f"  left out: {states} of {c.name}, cut off at zero counts; raise the black level")
        if c.dark_fraction > 0:
            typer.echo(f"  left out as too dark, with their rim: {c.dark_fraction:.1%} of the pixels of {c.name}")
        if c.closure_before_percent is not None and c.closure_after_percent is not None:
            typer.echo(f"  closure of {c.name}: {c.closure_before_percent:.3f} % -> {c.closure_after_percent:.3f} %")
    for effect in d.effects:
        _show_effect(effect)
    if d.unexplained is not None:
        typer.echo("  unexplained structure is left:")
        for line in d.unexplained.description:
            typer.echo(f"    {line}")
        if d.unexplained.empirical is not None:
            e = d.unexplained.empirical
            typer.echo(
                f"    empirical {e.kind} would leave {e.rms_percent_in_sample:.4f} % (in sample, names no cause)"
            )
            typer.echo(f"    would also fit: {', '.join(e.would_also_fit)}")
    if d.unobservable:
        typer.echo(f"  cannot be seen with these captures: {', '.join(d.unobservable)}")
    typer.echo(f"  recommendation: {d.recommendation}")


def _show_effect(effect: FoundEffect) -> None:
    doubt = "" if effect.confident else " (it helps, but its name may be wrong)"
    where = f" of {effect.element}" if effect.element else ""
    typer.echo(f"  {effect.kind}{where}: evidence {effect.evidence:.0f}{doubt}")
    for name, p in effect.parameters.items():
        unit, note = "" if p.unit == "1" else f" {p.unit}", f" ({p.note})" if p.note else ""
        typer.echo(f"      {name}: {p.told}{unit}{note}")
    if effect.indistinguishable_from:
        typer.echo(f"      cannot be told from: {', '.join(effect.indistinguishable_from)}")


def main(argv: Sequence[str] | None = None) -> None:
    """Entry point of `diagnose`; ends in SystemExit."""
    run(app, argv)


if __name__ == "__main__":
    main()
