"""The text that `diagnose` prints, and its result as a file."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import typer

from processing.diagnosis.search.result import CaptureReport, Combination, Diagnosis, FoundEffect, Ranked, Unexplained
from processing.whole_file import write_new_text

VERDICTS = {
    "consistent": "consistent, nothing but noise is left",
    "explained": "explained",
    "partly_explained": "partly explained",
    "unexplained": "unexplained",
    "undetermined": "undetermined, a fault of typical size would not have been seen",
}
#: What a diagnosis recommends where no capture would tell more.
NOTHING_NEEDED = "None needed."
#: [causes] That are told with what each would leave alone.
MOST_NEAR = 3


def write_result(path: Path, d: Diagnosis) -> None:
    """Write the result as JSON, and print where."""
    write_new_text(path, d.model_dump_json(indent=2) + "\n")
    typer.echo(str(path))


def show(d: Diagnosis, details: bool = False, written: bool = False) -> None:
    """Print the residual, three lines for each cause, and what to do next; `details` adds all figures.

    `written`: what holds goes into a file.
    """
    short = short_names(d)
    head = "SIMULATED data, " if d.simulated else ""
    refused = d.correction is not None and d.correction.refused is not None
    _say(short, f"{head}{d.instrument}: {VERDICTS[d.verdict]}{', not corrected' if refused else ''}")
    noise = "" if d.noise_floor_percent is None else f"; noise {d.noise_floor_percent:.3g} %"
    kind = "residual" if d.noise_floor_percent is None else "residual beyond noise"
    _say(short, f"{kind} {d.error_before.text_change(d.error_after)} of the mean signal{noise}")
    for c in d.captures:
        _name_capture(short, c)
    for head, text in (("first of all", d.wiring), ("not determined", d.branch)):
        if text is not None:
            _say(short, f"{head}: {text}")
    for line in d.noise.told if d.noise is not None else ():
        _say(short, f"the noise is not what is declared: {line}")
    for left_out in d.left_out:
        _say(short, f"left out of {left_out.capture}: {left_out.text}")
    for number, effect in enumerate(d.effects, 1):
        _show_effect(short, number, effect, noise)
    _show_uncertainty(d, written)
    # Without a mistake of wiring the residual may well be noise: then there is nothing to list.
    if d.unexplained is not None and (d.wiring is None or d.unexplained.description):
        _show_unexplained(short, d.unexplained, d.ranking)
    if details:
        _show_details(short, d)
    _say(short, f"next: {d.recommendation}" if d.recommendation != NOTHING_NEEDED else "no further capture is needed")
    if d.corrects and not written:
        _say(short, "to apply it: the same command with --write NEW.yaml")


def short_names(d: Diagnosis) -> dict[str, str]:
    """A letter for each of several captures."""
    several = d.captures if len(d.captures) > 1 else ()
    return {c.name: _letters(k) for k, c in enumerate(several)}


def _letters(k: int) -> str:
    return (_letters(k // 26 - 1) if k >= 26 else "") + chr(ord("A") + k % 26)


def _say(short: Mapping[str, str], line: str) -> None:
    for name in sorted(short, key=len, reverse=True):
        line = line.replace(name, short[name])
    typer.echo(line)


def _show_effect(short: Mapping[str, str], number: int, effect: FoundEffect, noise: str) -> None:
    """A cause in three lines: name and value; residual without and with it; what becomes of it."""
    where = f" of {effect.element}" if effect.element else ""
    where += f" at {effect.wavelength_nm:g} nm" if effect.wavelength_nm is not None else ""
    where += f" in {effect.capture}" if effect.capture and short else ""
    values = ", ".join(
        f"{name} {p.text}{'' if p.unit == '1' else f' {p.unit}'}{f' ({p.note})' if p.note else ''}"
        for name, p in effect.parameters.items()
    )
    _say(short, f"{number}. {effect.kind}{where} ({_answer(effect)}): {values}")
    if effect.residual_without is not None and effect.residual_with is not None:
        _say(short, f"   residual without it {effect.residual_without.text_change(effect.residual_with)}{noise}")
    _say(short, f"   not applied, because {effect.not_applied}" if effect.not_applied else "   applied")


def _answer(effect: FoundEffect) -> str:
    """How sure the name is, and what else it could be."""
    if not effect.confident:
        return "it helps, but its name may be wrong"
    if effect.indistinguishable_from:
        return f"or {', '.join(effect.could_be)}"
    if effect.probability is None or effect.answer is None:
        return "found"
    # Not more nines than a calibration can show.
    sure = effect.probability >= 0.999
    return (
        f"{effect.answer}, probability over 0.999" if sure else f"{effect.answer}, probability {effect.probability:.3f}"
    )


def _name_capture(short: Mapping[str, str], c: CaptureReport) -> None:
    label = short.get(c.name, "capture")
    line = f"  {label}  {c.name}" + (f", {c.wavelength_nm:g} nm" if c.wavelength_nm else "")
    if short and c.error_before is not None and c.error_after is not None:
        line += f": {c.error_before.text_change(c.error_after)}"
    if c.source_percent is not None:
        line += f"; level of the source projected out, it varies by {c.source_percent:.2g} %"
    typer.echo(line)
    for text in c.evidence:
        _say(short, f"     false frames: {text}")


def _show_uncertainty(d: Diagnosis, written: bool) -> None:
    """How wrong M may be, before and after, with everything that these captures do not show."""
    correction = d.correction
    if correction is None:
        return
    if correction.mueller is not None:
        typer.echo(f"{correction.mueller.text}")
    if correction.refused is not None and not any(e.not_applied for e in d.effects):
        subject = "but for the fitted train, nothing" if d.corrects else "nothing"
        typer.echo(f"{subject} is applied, because {correction.refused}")
    elif not (d.corrects or d.effects or written):
        typer.echo("nothing is corrected")


def _show_details(short: Mapping[str, str], d: Diagnosis) -> None:
    for error, when in ((d.error_before, "before"), (d.error_after, "after")):
        typer.echo(f"rms of single intensities {when}: {error.rms_percent:.4f} %, chi2/dof {error.chi2_reduced:.4g}")
    typer.echo(f"held out: {d.error_before.held_out}")
    for capture in d.captures:
        _show_capture(short, capture)
    for effect in d.effects:
        _say(short, f"{effect.kind}: explains {effect.evidence:.0f} in chi-square")
    if d.correction is not None:
        kinds = ", ".join(dict.fromkeys(e.kind for e in d.correction.effects))
        _say(short, f"correction (means over what the data leave open): {kinds or 'none, or nominal values alone'}")
        for c in d.correction.combinations:
            _say(short, f"determined together: {_combination(c)}")
        for check in d.correction.checks:
            _say(short, f"{check.name}: {' -> '.join(check.shown)}")
    if d.unobservable:
        _say(short, f"cannot be seen with these captures: {', '.join(d.unobservable)}")


def _show_capture(short: Mapping[str, str], c: CaptureReport) -> None:
    """Parts of a capture that were excluded."""
    of = f" of {short[c.name]}" if c.name in short else ""
    if c.cut_off:
        states = f"state{'s' if len(c.cut_off) > 1 else ''} {', '.join(str(k) for k in c.cut_off)}"
        typer.echo(f"left out{of}: {states}, cut off at zero counts; raise the black level")
    if c.binned > 1:
        typer.echo(f"fitted{of}: means over squares of {c.binned} x {c.binned} pixels")
    if c.dark_fraction > 0:
        typer.echo(f"left out{of} as too dark, with their rim: {c.dark_fraction:.1%} of the pixels")
    if c.steep_fraction > 0:
        typer.echo(f"left out{of} at sharp edges: {c.steep_fraction:.1%} of the pixels")
    if c.closure_before_percent is not None and c.closure_after_percent is not None:
        typer.echo(f"closure{of}: {c.closure_before_percent:.3f} % -> {c.closure_after_percent:.3f} %")


def _show_unexplained(short: Mapping[str, str], unexplained: Unexplained, ranking: Sequence[Ranked]) -> None:
    _say(short, "unexplained structure is left:")
    for line in unexplained.description:
        _say(short, f"   {line}")
    for candidate in ranking[:MOST_NEAR]:
        typer.echo(f"   {candidate.candidate} alone would leave {candidate.rms_percent:.4f} %, and is no explanation")


def _combination(c: Combination) -> str:
    """Sum of values with its error, and the possible error of each value in addition."""
    terms = " ".join(f"{w:+.3g} {name}" for name, w in c.weights.items()).removeprefix("+1 ").removeprefix("+")
    unit = "" if c.unit == "1" else f" {c.unit}"
    alone = ", ".join(f"{v:+.2g}" for v in c.open_by.values())
    return f"{terms} = {c.value:.4g} +- {c.stderr:.2g}{unit}; each alone may be off, together by {alone}"
