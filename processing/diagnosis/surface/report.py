"""The report of `diagnose --reflectance`: one HTML file, before and after on the same scales."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.diagnosis.search.space import Space
from processing.diagnosis.surface.diagnose import SurfaceDiagnosis, SurfaceJudged
from processing.diagnosis.surface.problem import SurfaceProblem
from processing.diagnosis.surface.quantities import dominant_errors, quantities
from processing.reports.colours import SIGNED
from processing.reports.template import Figure, ReportSection, render
from processing.whole_file import write_new_text


def write_surface_report(path: Path, judged: SurfaceJudged, problem: SurfaceProblem) -> None:
    """Write the report to a new file. Raises ProcessError if it exists."""
    d = judged.diagnosis
    rows = [["effect", "where", "parameter", "value", "unit", "evidence", "cannot be told from"]]
    for e in d.effects:
        for name, p in e.parameters.items():
            also = ", ".join(e.indistinguishable_from)
            rows.append([e.kind, e.element or "", name, p.told, p.unit, f"{e.evidence:.0f}", also])
    ranking = [["candidate, alone", "evidence", "rms left, %"]]
    ranking += [[r.candidate, f"{r.evidence:.0f}", f"{r.rms_percent:.4f}"] for r in d.ranking]
    summary = [
        ("verdict", d.verdict.replace("_", " ")),
        ("material", f"{d.material}: " + ", ".join(f"{k} = {v:.4g}" for k, v in d.constants.items())),
        ("error before", f"{d.error_before.rms_percent:.4f} %, chi2/dof {d.error_before.chi2_reduced:.4g}"),
        ("error after", f"{d.error_after.rms_percent:.4f} %, chi2/dof {d.error_after.chi2_reduced:.4g}"),
        ("noise floor", f"{d.noise_floor_percent:.4f} %"),
        ("held out", d.error_before.held_out),
        ("cannot be seen", ", ".join(d.unobservable) or "everything in the list can"),
        ("recommendation", d.recommendation),
    ]
    sections = [
        ReportSection(
            "Diagnosis",
            summary,
            tables=[
                ("Effects", rows),
                ("What the correction does", _checks(d)),
                ("Candidates of the first round", ranking),
            ],
            warnings=[*_refusal(d), *(d.unexplained.description if d.unexplained else ())],
        )
    ]
    for k, capture in enumerate(d.captures):
        facts = [
            (f"{name}, before and after", f"{v:.1f}, {capture.tests_after[name]:.1f} standard deviations")
            for name, v in capture.tests_before.items()
        ]
        before, after = d.quantities_before[k], d.quantities_after[k]
        facts.append(("median xi0", f"{before.xi0:.4f}, {after.xi0:.4f}; rms change {d.xi0_change[k]:.4f}"))
        if before.psi_deg is not None and after.psi_deg is not None:
            psi, size = (
                f"{before.psi_deg:.2f}, {after.psi_deg:.2f}",
                (before.magnitude_percent, after.magnitude_percent),
            )
            facts.append(("psi of m0, model - measured", f"{psi} degrees rms; noise alone {after.psi_noise_deg:.2f}"))
            facts.append(("|D| of m0", f"{size[0]:.2f}, {size[1]:.2f} % rms; {after.magnitude_noise_percent:.2f}"))
        figures = [Figure(_png(residual_figure(judged, problem, k)), "Residual and xi0, before and after")]
        figures.append(Figure(_png(states_figure(judged, problem, k)), "Residual of each state (and channel)"))
        if before.psi_deg is not None:
            caption = "Dominant process, model less measured, before and after"
            figures.append(Figure(_png(dominant_figure(judged, problem, k)), caption))
        sections.append(ReportSection(capture.name, facts, figures))
    title = f"diagnose: {d.material} with {d.instrument}"
    write_new_text(path, render(title, d.simulated, f"{d.wavelengths_nm[0]:g} nm", sections))


def _checks(d: SurfaceDiagnosis) -> list[list[str]]:
    rows = [["figure", "before", "after", ""]]
    for check in d.correction.checks:
        word = "holds" if check.holds else "gets worse"
        rows.append([check.name, *check.shown, word])
    return rows


def _refusal(d: SurfaceDiagnosis) -> list[str]:
    refused = d.correction.refused
    return [] if refused is None else [f"The correction is refused: {refused}"]


def residual_figure(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> Any:
    """Residual of each tile along its leading component, rms of each pixel, and xi0; before and after."""
    from matplotlib.figure import Figure as Picture

    data, pairs = problem.captures[k], _models(judged)
    first = problem.pixels(k, *pairs[0]).residual
    _, vectors = np.linalg.eigh(first.T @ first)
    figure = Picture(figsize=(11, 6.4), layout="constrained")
    axes = figure.subplots(2, 3)
    scales: list[tuple[float, float]] = []
    for row, (space, values) in enumerate(pairs):
        r = problem.pixels(k, space, values).residual
        smooth = np.array([r[data.tile == t].mean(axis=0) @ vectors[:, -1] for t in data.tile])
        xi0 = quantities(problem, k, space, values)[1]
        maps = (np.sqrt(np.mean(r**2, axis=1)), smooth, xi0)
        if not scales:
            top = float(np.nanpercentile(maps[0], 99.5))
            wide = float(np.nanmax(np.abs(smooth))) or 1.0
            scales = [(0.0, top), (-wide, wide), (0.25, float(np.nanpercentile(xi0, 99.5)))]
        names = ("rms residual / noise", "leading residual, mean of tiles / noise", "xi0")
        for axis, values_of, (low, high), name, colours in zip(
            axes[row], maps, scales, names, ("magma", SIGNED, "viridis"), strict=True
        ):
            drawn = axis.imshow(_image(data.where, data.shape, values_of), vmin=low, vmax=high, cmap=colours)
            figure.colorbar(drawn, ax=axis)
            axis.set_title(f"{name}, {'after' if row else 'before'}", fontsize=9)
            axis.set_axis_off()
    return figure


def states_figure(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> Any:
    """Rms residual of each row of W over the pixels, before and after."""
    from matplotlib.figure import Figure as Picture

    figure = Picture(figsize=(11, 2.6), layout="constrained")
    axis = figure.subplots()
    for name, (space, values) in zip(("before", "after"), _models(judged), strict=True):
        here = problem.pixels(k, space, values)
        rms = np.sqrt(np.mean(here.residual**2, axis=0) / np.mean(here.free * problem.noise[k], axis=0))
        axis.plot(rms, "o-", ms=3, label=name)
    axis.axhline(1.0, color="0.6", lw=0.8)
    axis.set_ylim(bottom=0)
    axis.set_xlabel("state (and channel)")
    axis.set_ylabel("rms residual / noise")
    axis.legend()
    return figure


def dominant_figure(judged: SurfaceJudged, problem: SurfaceProblem, k: int) -> Any:
    """Modelled less measured psi and |D| of the dominant process, before and after, of a full Mueller capture."""
    from matplotlib.figure import Figure as Picture

    data = problem.captures[k]
    figure = Picture(figsize=(11, 2.9), layout="constrained")
    axes = figure.subplots(1, 4)
    names = (("psi / degree", 90.0), ("|D| / %", 50.0))
    for column, (space, values) in enumerate(_models(judged)):
        errors = dominant_errors(problem, k, space, values, y=data.y) or ()
        for row, ((name, wide), error) in enumerate(zip(names, errors, strict=False)):
            axis = axes[2 * row + column]
            drawn = axis.imshow(_image(data.where, data.shape, error), vmin=-wide, vmax=wide, cmap=SIGNED)
            figure.colorbar(drawn, ax=axis, shrink=0.8)
            axis.set_title(f"{name}, {'after' if column else 'before'}", fontsize=9)
            axis.set_axis_off()
    return figure


def _models(judged: SurfaceJudged) -> tuple[tuple[Space, Array], tuple[Space, Array]]:
    found = judged.found
    return (found.base, found.before_fit.values), (found.space, found.fit.values)


def _image(where: NDArray[np.int64], shape: tuple[int, int], values: Array) -> Array:
    low, high = where.min(axis=0), where.max(axis=0)
    step = max(int(np.min(np.diff(np.unique(where[:, 0])))), 1)
    size = (high - low) // step + 1
    out = np.full(tuple(size), np.nan)
    index = (where - low) // step
    out[index[:, 0], index[:, 1]] = values
    return out


def _png(figure: Any) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=90)
    return buffer.getvalue()
