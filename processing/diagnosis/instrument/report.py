"""The report of a diagnosis: one HTML file with its figures inside, before and after on the same scales."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.arrays import Array
from processing.diagnosis.instrument.diagnose import Judged
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.projection import add_response
from processing.diagnosis.instrument.structure import Residual
from processing.diagnosis.search.fit import Fit
from processing.diagnosis.search.range_of import rank_of
from processing.diagnosis.search.rules import HARMONICS
from processing.diagnosis.search.space import Space
from processing.polarization.cloude import xi0_and_dominant
from processing.reports.colours import SIGNED
from processing.reports.design import style, templates
from processing.reports.figure_style import png
from processing.reports.template import Figure as Picture
from processing.whole_file import write_new_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_report(path: Path, judged: Judged, problem: InstrumentProblem) -> None:
    """Write the report to a new file. Raises ProcessError if it exists."""
    found = judged.diagnosis
    text = (
        templates()
        .get_template("diagnosis_report.html")
        .render(
            title=f"diagnose: {found.instrument}",
            style=style(),
            simulated=found.simulated,
            d=found,
            errors=_errors(judged),
            effects=_effects(judged),
            ranking=_ranking(judged),
            captures=[_capture(judged, problem, k) for k in range(len(problem.captures))],
        )
    )
    write_new_text(path, text)


def _errors(judged: Judged) -> list[list[str]]:
    d = judged.diagnosis
    floor = "not known" if d.noise_floor_percent is None else f"{d.noise_floor_percent:.4f}"
    return [
        ["", "rms, % of the mean signal", "chi2 / dof"],
        ["before", f"{d.error_before.rms_percent:.4f}", f"{d.error_before.chi2_reduced:.4g}"],
        ["after", f"{d.error_after.rms_percent:.4f}", f"{d.error_after.chi2_reduced:.4g}"],
        ["noise", floor, "1"],
    ]


def _effects(judged: Judged) -> list[list[str]]:
    """Rows of a table with its head; empty where no effect is named."""
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
            whole = (kind, place, sure, f"{e.evidence:.0f}", ", ".join(e.could_be))
            first = whole if name == next(iter(e.parameters)) else ("",) * len(whole)
            # Non-breaking spaces: a number stays on one line with its error and unit.
            value = f"{p.told} {p.unit if p.unit != '1' else ''}".strip().replace(" ", "\u00a0")
            rows.append([*first[:2], name, value, *first[2:]])
    head = ["effect", "of", "parameter", "value", "name", "chi2 explained", "or it is"]
    return [head, *rows] if rows else []


def _ranking(judged: Judged) -> list[list[str]]:
    rows = [[r.candidate, f"{r.evidence:.0f}", f"{r.rms_percent:.4f}"] for r in judged.diagnosis.ranking]
    return [["candidate, alone", "chi2 gain on held-out data", "rms left, %"], *rows] if rows else []


def _capture(judged: Judged, problem: InstrumentProblem, k: int) -> dict[str, Any]:
    """Title, figures and the change of the Mueller elements of one capture."""
    before, after = judged.before[k], judged.after[k]
    return {
        "name": problem.captures[k].name,
        "figures": [
            Picture(png(_maps(before, after)), "Residual over the image"),
            Picture(png(_states(before, after)), "Residual of each state, and its harmonics"),
        ],
        "change": _change(judged, problem, k),
    }


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
        image = axes[1, column].imshow(states[column], vmin=-wide, vmax=wide, cmap=SIGNED)
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


def _change(judged: Judged, problem: InstrumentProblem, k: int) -> dict[str, Any] | None:
    """What the correction changes in the Mueller elements and in xi0; None where the states allow no inversion."""
    found = judged.found
    first = _mueller(problem, k, found.base, found.before_fit)
    second = _mueller(problem, k, found.space, found.fit)
    if first is None or second is None:
        return None
    difference = np.sqrt(np.mean((second - first) ** 2, axis=0)).reshape(4, 4)
    before, after = (xi0_and_dominant(m.reshape(-1, 4, 4))[0] for m in (first, second))
    return {
        "elements": [[""] * 4, *([f"{v:.5f}" for v in line] for line in difference)],
        "xi0": f"Median xi0 {np.nanmedian(before):.5f} to {np.nanmedian(after):.5f}, rms change "
        f"{np.sqrt(np.nanmean((after - before) ** 2)):.5f}.",
    }


def _mueller(problem: InstrumentProblem, k: int, space: Space, fit: Fit) -> Array | None:
    problem, values = problem.near(space, fit.values)
    data = problem.captures[k]
    changes = problem.changes(k, space, values)
    w = problem.models[k].rows(data.conditions.angles_deg, changes).reshape(-1, 16) * data.row_exposure[:, None]
    if rank_of(w) < 16:
        return None
    rows, shape = w.shape[0], data.signal.shape[2:]
    y = data.signal.reshape(rows, *shape).astype(float)
    y = add_response(y, problem.coefficients(k, changes), problem.columns(k, changes)).reshape(rows, -1)
    m = (np.linalg.pinv(w) @ y[:, data.usable.reshape(-1)]).T
    with np.errstate(divide="ignore", invalid="ignore"):
        m = m / m[:, :1]
    return np.asarray(m[np.isfinite(m).all(axis=1)])
