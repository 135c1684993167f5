"""The report of a diagnosis: one HTML file with its figures inside, before and after on the same scales."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from processing.diagnosis.search.result import Diagnosis
from processing.reports.design import style, templates
from processing.reports.template import Figure
from processing.whole_file import write_new_text


@dataclass(frozen=True)
class CaptureSection:
    """Content of the report about one capture.

    `facts` are names and values; `elements` is a table of what the correction changes in M, and `note` a sentence.
    """

    name: str
    figures: Sequence[Figure]
    facts: Sequence[tuple[str, str]] = ()
    elements: Sequence[Sequence[str]] = ()
    note: str = ""


def write_diagnosis_report(path: Path, d: Diagnosis, captures: Sequence[CaptureSection], material: str = "") -> None:
    """Write a report to a new file; `material` is what a surface was compared with, in words.

    Raises ProcessError if the file exists.
    """
    text = (
        templates()
        .get_template("diagnosis_report.html")
        .render(
            title=f"diagnose: {d.instrument}",
            style=style(),
            simulated=d.simulated,
            d=d,
            material=material,
            errors=_errors(d),
            effects=_effects(d),
            ranking=_ranking(d),
            captures=captures,
        )
    )
    write_new_text(path, text)


def _errors(d: Diagnosis) -> list[list[str]]:
    kind = "residual" if d.noise_floor_percent is None else "residual beyond noise"
    floor = "not known" if d.noise_floor_percent is None else f"{d.noise_floor_percent:.4f} %"
    return [
        ["", kind, "rms of single intensities", "chi2 / dof"],
        *(
            [when, error.text, f"{error.rms_percent:.4f} %", f"{error.chi2_reduced:.4f}"]
            for when, error in (("before", d.error_before), ("after", d.error_after))
        ),
        ["noise", "", floor, "1"],
    ]


def _effects(d: Diagnosis) -> list[list[str]]:
    """Rows of a table with its head; empty where no effect is named."""
    rows = []
    several = len(d.captures) > 1
    for e in d.effects:
        for name, p in e.parameters.items():
            # What is told of the effect as a whole stands in its first row.
            kind = e.kind if e.confident else f"{e.kind} (the name may be wrong)"
            place = ", ".join(filter(None, (e.element, e.capture if several else None)))
            sure = e.answer or ""
            if e.probability is not None:
                sure += f", {e.probability:.3f}" if e.probability < 0.999 else ", over 0.999"
            cells = (kind, place, sure, f"{e.evidence:.0f}", ", ".join(e.could_be))
            first = cells if name == next(iter(e.parameters)) else ("",) * len(cells)
            # Non-breaking spaces: a number stays on one line with its error and unit.
            value = f"{p.text} {p.unit if p.unit != '1' else ''}".strip().replace(" ", "\u00a0")
            rows.append([*first[:2], name, value, *first[2:]])
    head = ["effect", "of", "parameter", "value", "name", "chi2 explained", "or it is"]
    return [head, *rows] if rows else []


def _ranking(d: Diagnosis) -> list[list[str]]:
    rows = [[r.candidate, f"{r.evidence:.0f}", str(r.values or ""), f"{r.rms_percent:.4f}"] for r in d.ranking]
    return [["effect", "chi2 explained", "explained by chance", "rms of single intensities, %"], *rows] if rows else []
