"""What `diagnose` prints, and its result as a file."""

from __future__ import annotations

from pathlib import Path

import typer

from processing.diagnosis.search.result import (
    CaptureReport,
    Combination,
    Correction,
    Diagnosis,
    FoundEffect,
    Unexplained,
)
from processing.whole_file import write_new_text


def write_result(path: Path, d: Diagnosis) -> None:
    """Write the result as JSON, and print where."""
    write_new_text(path, d.model_dump_json(indent=2) + "\n")
    typer.echo(str(path))


def show(d: Diagnosis) -> None:
    """Print a summary."""
    if d.simulated:
        typer.echo("SIMULATED data")
    wavelengths = ", ".join(f"{w:g}" for w in d.wavelengths_nm)
    typer.echo(f"{d.instrument}, {wavelengths} nm: {d.verdict.replace('_', ' ')}")
    if d.verdict == "undetermined":
        typer.echo("  nothing can be said: a fault of typical size would not have been seen")
    if d.wiring is not None:
        typer.echo(f"  first of all: {d.wiring}")
    before, after = d.error_before, d.error_after
    typer.echo(f"  error before  {before.rms_percent:8.4f} % of the mean signal, chi2/dof {before.chi2_reduced:.4g}")
    typer.echo(f"  error after   {after.rms_percent:8.4f} % of the mean signal, chi2/dof {after.chi2_reduced:.4g}")
    if d.noise_floor_percent is not None:
        typer.echo(f"  noise floor   {d.noise_floor_percent:8.4f} %")
    typer.echo(f"  held out: {before.held_out}")
    for capture in d.captures:
        _show_capture(capture, several=len(d.wavelengths_nm) > 1)
    for line in d.noise.told if d.noise is not None else ():
        typer.echo(f"  the noise is not what is declared: {line}")
    for left_out in d.left_out:
        typer.echo(f"  left out of {left_out.capture}: {left_out.told}")
    for effect in d.effects:
        _show_effect(effect)
    if d.correction is not None:
        _show_correction(d.correction, d.corrects)
    if d.unexplained is not None:
        _show_unexplained(d.unexplained)
    if d.unobservable:
        typer.echo(f"  cannot be seen with these captures: {', '.join(d.unobservable)}")
    typer.echo(f"  recommendation: {d.recommendation}")


def _show_capture(c: CaptureReport, several: bool) -> None:
    """What was left out of a capture; its own residual where there are several wavelengths."""
    if several and c.rms_before_percent is not None:
        typer.echo(f"  {c.wavelength_nm:g} nm: {c.rms_before_percent:.4f} % -> {c.rms_after_percent:.4f} %, {c.name}")
    if c.cut_off:
        states = f"state{'s' if len(c.cut_off) > 1 else ''} {', '.join(str(k) for k in c.cut_off)}"
        typer.echo(f"  left out: {states} of {c.name}, cut off at zero counts; raise the black level")
    if c.binned > 1:
        typer.echo(f"  fitted: means over squares of {c.binned} x {c.binned} pixels of {c.name}")
    if c.dark_fraction > 0:
        typer.echo(f"  left out as too dark, with their rim: {c.dark_fraction:.1%} of the pixels of {c.name}")
    if c.steep_fraction > 0:
        typer.echo(f"  left out at sharp edges: {c.steep_fraction:.1%} of the pixels of {c.name}")
    if c.closure_before_percent is not None and c.closure_after_percent is not None:
        typer.echo(f"  closure of {c.name}: {c.closure_before_percent:.3f} % -> {c.closure_after_percent:.3f} %")


def _show_unexplained(unexplained: Unexplained) -> None:
    typer.echo("  unexplained structure is left:")
    for line in unexplained.description:
        typer.echo(f"    {line}")
    if unexplained.empirical is not None:
        e = unexplained.empirical
        typer.echo(f"    empirical {e.kind} would leave {e.rms_percent_in_sample:.4f} % (in sample, names no cause)")
        typer.echo(f"    would also fit: {', '.join(e.would_also_fit)}")


def _show_effect(effect: FoundEffect) -> None:
    where = f" of {effect.element}" if effect.element else ""
    where += f" at {effect.wavelength_nm:g} nm" if effect.wavelength_nm is not None else ""
    where += f", {effect.capture}" if effect.capture else ""
    typer.echo(f"  {effect.kind}{where}: {_answer(effect)}")
    for name, p in effect.parameters.items():
        unit, note = "" if p.unit == "1" else f" {p.unit}", f" ({p.note})" if p.note else ""
        typer.echo(f"      {name}: {p.told}{unit}{note}")
    if effect.indistinguishable_from:
        typer.echo(f"      cannot be told from: {', '.join(effect.could_be)}")


def _show_correction(correction: Correction, corrects: bool) -> None:
    """What would be written, apart from names: how much of it, and the figures that were looked at."""
    kinds = ", ".join(dict.fromkeys(e.kind for e in correction.effects))
    fate = f"refused: {correction.refused}" if correction.refused else "holds"
    told = f"{kinds or 'the nominal values'}; {fate}" if kinds or corrects else "nothing is corrected"
    typer.echo(f"  correction (means over what the data leave open): {told}")
    for c in correction.combinations:
        typer.echo(f"      determined together: {_combination(c)}")
    if correction.mueller is not None:
        typer.echo(f"      {correction.mueller.told}")
    for check in correction.checks:
        typer.echo(f"      {check.name}: {check.before:.4g} -> {check.after:.4g}")


def _combination(c: Combination) -> str:
    """Sum of values with its error, and by how much each may be off beside it."""
    terms = " ".join(f"{w:+.3g} {name}" for name, w in c.weights.items()).removeprefix("+1 ").removeprefix("+")
    unit = "" if c.unit == "1" else f" {c.unit}"
    alone = ", ".join(f"{v:+.2g}" for v in c.open_by.values())
    return f"{terms} = {c.value:.4g} +- {c.stderr:.2g}{unit}; each alone may be off, together by {alone}"


def _answer(effect: FoundEffect) -> str:
    """How sure the name is, in words and numbers."""
    explains = f"explains {effect.evidence:.0f} in chi-square"
    if not effect.confident:
        return f"{explains}; it helps, but its name may be wrong"
    if effect.answer is None or effect.probability is None:
        return explains
    # Not more nines than a calibration can show.
    probability = f"{effect.probability:.3f}" if effect.probability < 0.999 else "over 0.999"
    return f"{effect.answer}, probability {probability}; {explains}"
