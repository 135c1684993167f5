"""The report of a diagnosis: one HTML file with its figures inside, before and after on the same scales."""

from __future__ import annotations

import base64
import html
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.judge import Judged
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import add_response
from processing.diagnosis.instrument.structure import HARMONICS, Residual
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.space import Space
from processing.errors import ProcessError
from processing.polarization.cloude import xi0_and_dominant

if TYPE_CHECKING:
    from matplotlib.figure import Figure


STYLE = """body{font:15px/1.45 sans-serif;max-width:62em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:1em 0}td,th{border-bottom:1px solid #ccc;padding:.25em .8em;text-align:left}
img{max-width:100%}.warn{background:#fff3cd;padding:.5em 1em}h1{font-size:1.5em}h2{font-size:1.15em;margin-top:2em}"""


def write_report(path: Path, judged: Judged, problem: InstrumentProblem) -> None:
    """Write the report to a new file. Raises ProcessError if it exists."""
    parts = [_summary(judged), _effects(judged), _ranking(judged)]
    for k, data in enumerate(problem.captures):
        parts.append(f"<h2>{html.escape(data.name)}</h2>")
        parts.append(_picture(_maps(judged.before[k], judged.after[k]), "Residual over the image"))
        parts.append(_picture(_states(judged.before[k], judged.after[k]), "Residual of each state, and its harmonics"))
        parts.append(_quantities(judged, problem, k))
    title = f"diagnose: {judged.diagnosis.instrument}"
    text = f"<!doctype html><html lang='en'><meta charset='utf-8'><title>{html.escape(title)}</title>"
    text += f"<style>{STYLE}</style><h1>{html.escape(title)}</h1>" + "\n".join(parts) + "</html>\n"
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except FileExistsError as error:
        raise ProcessError(f"{path} exists and is not replaced. Give another --report.") from error


def _table(head: list[str], rows: list[list[Any]]) -> str:
    cells = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    lines = ["<tr>" + "".join(f"<td>{html.escape(str(c))}</td>" for c in row) + "</tr>" for row in rows]
    return f"<table><tr>{cells}</tr>{''.join(lines)}</table>"


def _summary(judged: Judged) -> str:
    d = judged.diagnosis
    out = "<p class='warn'>SIMULATED data</p>" if d.simulated else ""
    at = ", ".join(f"{w:g}" for w in d.wavelengths_nm)
    out += f"<p><b>{d.verdict.replace('_', ' ')}</b> at {at} nm. Held out: {d.error_before.held_out}.</p>"
    floor = "not known" if d.noise_floor_percent is None else f"{d.noise_floor_percent:.4f}"
    rows = [
        ["before", f"{d.error_before.rms_percent:.4f}", f"{d.error_before.chi2_reduced:.4g}"],
        ["after", f"{d.error_after.rms_percent:.4f}", f"{d.error_after.chi2_reduced:.4g}"],
        ["noise", floor, "1"],
    ]
    out += _table(["", "rms, % of the mean signal", "chi2 / dof"], rows)
    if d.unexplained is not None:
        lines = "".join(f"<li>{html.escape(line)}</li>" for line in d.unexplained.description)
        out += f"<p>Unexplained structure is left:</p><ul>{lines}</ul>"
        if d.unexplained.empirical is not None:
            e = d.unexplained.empirical
            out += f"<p class='warn'>{e.kind}: {e.rms_percent_in_sample:.4f} % in sample; {html.escape(e.note)}</p>"
    if d.unobservable:
        out += f"<p>Cannot be seen with these captures: {html.escape(', '.join(d.unobservable))}.</p>"
    return out + f"<p>Recommendation: {html.escape(d.recommendation)}</p>"


def _effects(judged: Judged) -> str:
    rows = []
    several = len(judged.diagnosis.captures) > 1
    for e in judged.diagnosis.effects:
        for name, p in e.parameters.items():
            # What is told of the effect as a whole stands in its first row.
            kind = e.kind if e.confident else f"{e.kind} (the name may be wrong)"
            place = ", ".join(filter(None, (e.element, e.capture if several else None)))
            sure = e.answer or ""
            if e.probability is not None:
                sure += f", {e.probability:.3f}" if e.probability < 0.999 else ", over 0.999"
            whole = (kind, place, sure, f"{e.evidence:.0f}", ", ".join(e.indistinguishable_from))
            first = whole if name == next(iter(e.parameters)) else ("",) * len(whole)
            # Non-breaking spaces: a number stays on one line with its error and unit.
            value = f"{p.told} {p.unit if p.unit != '1' else ''}".strip().replace(" ", "\u00a0")
            rows.append([*first[:2], name, value, *first[2:]])
    if not rows:
        return "<p>No effect is named.</p>" + _correction(judged)
    head = ["effect", "of", "parameter", "value", "name", "chi2 explained", "or it is"]
    return "<h2>Effects</h2>" + _table(head, rows) + _correction(judged)


def _correction(judged: Judged) -> str:
    """What is written, apart from names: its fate, and the figures that the guard looked at."""
    found = judged.diagnosis.correction
    if found is None:
        return ""
    fate = f"Refused: {found.refused}" if found.refused else "It holds, and is what --write puts into the file."
    rows = [[c.name, f"{c.before:.4g}", f"{c.after:.4g}"] for c in found.checks]
    return f"<h2>Correction</h2><p>{fate}</p>" + _table(["figure", "before", "after"], rows)


def _ranking(judged: Judged) -> str:
    rows = [[r.candidate, f"{r.evidence:.0f}", f"{r.rms_percent:.4f}"] for r in judged.diagnosis.ranking]
    if not rows:
        return ""
    head = ["candidate, alone", "chi2 gain on held-out data", "rms left, %"]
    return "<h2>Candidates of the first round</h2>" + _table(head, rows)


def _picture(figure: Figure, alt: str) -> str:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=100, bbox_inches="tight")
    return f"<img alt='{html.escape(alt)}' src='data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}'>"


def _maps(before: Residual, after: Residual) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 8), layout="constrained")
    axes = figure.subplots(2, 2)
    pairs = ((before, "before"), (after, "after"))
    loud = [np.sqrt(np.mean(r.image.astype(float) ** 2, axis=0)) for r, _ in pairs]
    states = [np.tensordot(before.leading, np.nan_to_num(r.image.astype(float)), 1) for r, _ in pairs]
    top = max(float(np.nanmax(m)) if np.isfinite(m).any() else 1.0 for m in loud)
    wide = max(float(np.abs(m).max()) for m in states) or 1.0
    for column, (_, name) in enumerate(pairs):
        image = axes[0, column].imshow(loud[column], vmin=0, vmax=top)
        axes[0, column].set_title(f"{name}: rms over the states")
        figure.colorbar(image, ax=axes[0, column], label="residual / noise of one intensity")
        image = axes[1, column].imshow(states[column], vmin=-wide, vmax=wide, cmap="RdBu")
        axes[1, column].set_title(f"{name}: leading pattern over the states of before")
        figure.colorbar(image, ax=axes[1, column], label="amplitude / noise of one intensity")
        for axis in axes[:, column]:
            axis.set_xlabel("column, pixels")
            axis.set_ylabel("row, pixels")
    return figure


def _states(before: Residual, after: Residual) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.8), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.plot(before.per_state, "o-", ms=3, label="before")
    left.plot(after.per_state, "o-", ms=3, label="after")
    left.set_xlabel("state (and channel)")
    left.set_ylabel("rms residual / noise of one intensity")
    left.set_title("each state, over the pixels")
    left.set_ylim(bottom=0)
    left.legend()
    orders = np.arange(1, HARMONICS + 1)
    for k, axis in enumerate(before.harmonics):
        right.bar(orders + 0.1 * k - 0.2, before.harmonics[axis], 0.1, color=f"C{k}", alpha=0.4, label=f"{axis} before")
        right.bar(orders + 0.1 * k, after.harmonics[axis], 0.1, color=f"C{k}", label=f"{axis} after")
    right.set_xlabel("harmonic, periods a turn")
    right.set_ylabel("amplitude / noise of one intensity")
    right.set_title("harmonics of the mean residual")
    right.set_xticks(orders)
    if before.harmonics:
        right.legend(fontsize=7)
    return figure


def _quantities(judged: Judged, problem: InstrumentProblem, k: int) -> str:
    """What the correction changes in the Mueller elements and in xi0, where the states allow an inversion."""
    found = judged.found
    first = _mueller(problem, k, found.base, found.before_fit)
    second = _mueller(problem, k, found.space, found.fit)
    if first is None or second is None:
        return "<p>These states do not determine a Mueller matrix; no change of final quantities is given.</p>"
    difference = np.sqrt(np.mean((second - first) ** 2, axis=0)).reshape(4, 4)
    rows = [[f"{v:.5f}" for v in line] for line in difference]
    out = "<p>Change of the Mueller elements over m00, rms over the pixels:</p>" + _table([""] * 4, rows)
    before, after = (xi0_and_dominant(m.reshape(-1, 4, 4))[0] for m in (first, second))
    median = f"{np.nanmedian(before):.5f} to {np.nanmedian(after):.5f}"
    return out + f"<p>Median xi0 {median}, rms change {np.sqrt(np.nanmean((after - before) ** 2)):.5f}.</p>"


def _mueller(problem: InstrumentProblem, k: int, space: Space, fit: Fit) -> Array | None:
    problem, values = problem.near(space, fit.values)
    data = problem.captures[k]
    changes = problem.changes(k, space, values)
    w = problem.models[k].rows(data.conditions.angles_deg, changes).reshape(-1, 16) * data.row_exposure[:, None]
    if np.linalg.matrix_rank(w, rtol=1e-8) < 16:
        return None
    rows, shape = w.shape[0], data.signal.shape[2:]
    y = data.signal.reshape(rows, *shape).astype(float)
    y = add_response(y, problem.coefficients(k, changes), problem.columns(k, changes)).reshape(rows, -1)
    m = (np.linalg.pinv(w) @ y[:, data.usable.reshape(-1)]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        m = m / m[:, :1]
    return np.asarray(m[np.isfinite(m).all(axis=1)])
