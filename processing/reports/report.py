"""Collect captures, products, curves and pictures of a measurement into one report."""

import csv
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.doors import read_text, require_file, require_place
from processing.errors import ProcessError
from processing.maps.means import BUDGET_COLUMNS, mean_of
from processing.maps.region import parse_region
from processing.reflectance.tables import ScatteringTable, is_table
from processing.reports.capture_facts import facts_of, papers_of
from processing.reports.fact_words import fact_lines, fact_words
from processing.reports.figure_style import map_figure, png, thin
from processing.reports.figures import product_figure
from processing.reports.mueller_maps import mueller_maps
from processing.reports.tables import table_section
from processing.reports.template import Figure, ReportSection, render
from processing.storage.captures.capture import Capture, CaptureError
from processing.storage.integrity.h5_door import DAMAGE, open_h5
from processing.storage.products.product import Product, is_product
from processing.storage.products.provenance import read_steps, steps_text
from processing.whole_file import write_whole_text

#: File types that a report takes in, and the media types of pictures.
PICTURES = {".png": "image/png", ".svg": "image/svg+xml"}
SUFFIXES = (".h5", ".csv", *PICTURES)
#: Largest picture that a report takes in, bytes.
MOST_PICTURE_BYTES = 64 << 20
#: Rows of a CSV that are shown.
ROWS = 200


def collect(sources: Sequence[Path]) -> list[Path]:
    """Files for a report: those given, and those in the folders given; curves and pictures first, then the oldest.

    A picture beside an HDF5 file of its name shows what that file's own section shows, and is left out. Raises
    ProcessError: a source does not exist, or nothing is there.
    """
    files: list[Path] = []
    for source in sources:
        if source.is_dir():
            inside = [p for p in source.rglob("*") if p.suffix in SUFFIXES and p.is_file()]
            twins = [p for p in inside if p.suffix in PICTURES and p.with_suffix(".h5").is_file()]
            remaining = set(inside) - set(twins)
            files += sorted(remaining, key=lambda p: (p.suffix == ".h5", _date(p), p.name))
        elif source.is_file():
            if source.suffix not in SUFFIXES:
                raise ProcessError(f"{source}: a report takes {', '.join(SUFFIXES)} files.")
            files.append(source)
        else:
            raise ProcessError(f"{source}: no such file or folder.")
    if not files:
        places = ", ".join(str(s) for s in sources)
        raise ProcessError(f"nothing to report in {places}: no {', '.join(SUFFIXES)} files.")
    return list(dict.fromkeys(files))


def _date(path: Path) -> str:
    # As the file itself says (ISO 8601), so that copies keep their order.
    try:
        with open_h5(path, ProcessError) as h5:
            steps = read_steps(h5.get("entry", h5))
            started = h5.get("entry/start_time")
            return steps[-1].date if steps else "" if started is None else str(started.asstr()[()])
    except (ProcessError, *DAMAGE):
        # Its section says what is wrong with it.
        return ""


def write_report(
    sources: Sequence[Path],
    out: Path,
    title: str,
    overwrite: bool = False,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write one self-contained HTML file about captures, products, CSV tables and pictures.

    A report of the same sources under the same title is made again without `overwrite`. Raises ProcessError: nothing to
    report, `out` exists, or simulated and measured data are mixed.
    """
    key = sha256("\0".join([title, *map(os.path.realpath, sources)]).encode()).hexdigest()
    mark = f"<!-- umov report {key} -->\n"
    require_place(out, overwrite or _begins_with(out, mark))
    files = [f for f in collect(sources) if os.path.realpath(f) != os.path.realpath(out)]
    simulated = _kind_of_data(files)
    sections: list[ReportSection] = []
    for count, file in enumerate(files, 1):
        if file.suffix == ".h5":
            section = _section(file)
        elif file.suffix == ".csv":
            section = _curve(file)
        else:
            require_file(file, most_bytes=MOST_PICTURE_BYTES)
            section = ReportSection(file.name, [], [Figure(file.read_bytes(), file.name, PICTURES[file.suffix])])
        sections.append(section)
        if progress:
            progress(count, len(files))
    note = f"Made by umov {version('umov')} on {datetime.now(UTC).isoformat(timespec='seconds')}. Files: {len(files)}."
    write_whole_text(out, mark + render(title, simulated, note, sections))
    return out


def _begins_with(path: Path, text: str) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(len(text)) == text.encode()


def _section(path: Path) -> ReportSection:
    if is_product(path):
        return _product(path)
    if is_table(path):
        return table_section(path)
    try:
        return _capture(path)
    except CaptureError as error:
        return ReportSection(path.name, [("kind", "not shown")], warnings=[str(error)])


def _kind_of_data(files: Sequence[Path]) -> bool:
    """Whether the captures, products and tables are simulated; ProcessError if some are and some are not."""
    first: dict[bool, Path] = {}
    for file in files:
        if file.suffix != ".h5":
            continue
        # A file of another program says nothing; its section says what it is.
        with suppress(CaptureError):
            first.setdefault(_is_simulated(file), file)
    if len(first) == 2:
        raise ProcessError(
            f"{first[True]} is simulated and {first[False]} is measured; they are never mixed. Make one report of each."
        )
    return True in first


def _is_simulated(path: Path) -> bool:
    if is_table(path):
        return ScatteringTable.load(path).simulated
    with Product(path) if is_product(path) else Capture(path) as opened:
        return opened.simulated


def _range(states: NDArray[np.int64]) -> str:
    return f"{states.min()} to {states.max()}" if states.size else "none"


def _capture(path: Path) -> ReportSection:
    with Capture(path) as capture:
        header, closing = capture.header, capture.closing
        warnings = [str(m) for m in closing.get("messages", [])]
        if cut := closing.get("left_out"):
            cuts = ", ".join(f"{number} of {name}" for name, number in cut.items())
            warnings.append(f"the closing record was too long for its place; left out: {cuts}")
        if len(capture.segments) > 1:
            runs = "; ".join(
                f"{run.begun}, {run.status}, states {_range(capture.done[run.states])}" for run in capture.segments
            )
            warnings.append(f"taken in {len(capture.segments)} runs, between which the light may have jumped: {runs}")
        if capture.status != "complete":
            warnings.append(f"the capture is {capture.status}: {len(capture.role)} of {capture.planned_states} states")
        saturated = capture.column("saturated_fraction")
        if saturated.size and np.nanmax(np.nan_to_num(saturated)) > 0.001:
            warnings.append(f"up to {100 * np.nanmax(saturated):.2f} % of the pixels of a state are saturated")
        summary = [
            ("title", header.title),
            ("kind", f"capture, {'simulated' if capture.simulated else 'measured'}"),
            *facts_of(capture),
        ]
        records = (("time ledger", "ledger"), ("stream statistics", "stream"))
        named = [(heading, _pairs(closing[name])) for heading, name in records if closing.get(name)]
        versions = "\n".join(f"{name} {version}" for name, version in header.versions.items())
        read_back = ("camera settings as read back", header.camera_settings_json)
        notes = papers_of(header)
        notes += [(name, text) for name, text in (read_back, ("versions", versions)) if text.strip() not in ("", "{}")]
        figures = []
        if len(capture.role):
            state = int(capture.states_with("sample")[0]) if capture.states_with("sample").size else 0
            frame = thin(capture.frames(state)[0])
            if frame.size > 1:
                drawn = map_figure(
                    [(f"state {state}, counts", frame, {"cmap": "gray"})], header.title, capture.simulated
                )
                figures.append(Figure(png(drawn), "first frame of the sample"))
        return ReportSection(path.name, summary, figures, named, warnings, notes)


def _product(path: Path) -> ReportSection:
    with Product(path) as product:
        facts = {k: v for k, v in product.facts.items() if k not in ("warnings", "masked")}
        summary = [("kind", f"{product.kind} image, {'simulated' if product.simulated else 'measured'}")]
        summary += fact_lines(facts).values()
        figures = []
        # A kind without a figure is reported by its numbers.
        with suppress(ProcessError):
            figures.append(Figure(png(product_figure(product)), f"{product.kind} image"))
        if product.kind == "mueller" and "residual_rms" in product.names:
            residual = thin(product.get("residual_rms"))
            title = product.header.title
            drawn = map_figure([("residual rms / counts", residual, {"cmap": "magma"})], title, product.simulated)
            if (maps := mueller_maps(product, title)) is not None:
                is_complete = int(product.facts.get("rank", 16)) == 16
                caption = "coherency eigenvalues, xi0 and its error, DoLP, AoLP" if is_complete else "DoLP, AoLP"
                figures.append(Figure(png(maps), caption))
            figures.append(Figure(png(drawn), "residual of the fit"))
        datasets = [("dataset", "unit", "what it is")]
        datasets += [(name, product.units(name), product.long_name(name)) for name in product.names]
        tables: list[tuple[str, Sequence[Sequence[str]]]] = [("datasets", datasets), *_budgets(product)]
        warnings = list(product.facts.get("warnings", []))
        notes = [("provenance, oldest first", steps_text(product.steps))]
        return ReportSection(path.name, summary, figures, tables, warnings, notes)


#: Numbers whose uncertainty budget a report has, where a product determines them.
BUDGETED = (
    "coherency_eigenvalues_0",
    "depolarization_index",
    "diattenuation_linear",
    "polarizance_linear",
    "retardance_deg",
    "dolp",
    "aolp_deg",
)


def _budgets(product: Product) -> list[tuple[str, list[tuple[str, ...]]]]:
    """Uncertainty budgets (GUM) of the mean over the middle half of the frame, which `process mean` prints too."""
    if product.kind not in ("mueller", "stokes"):
        return []
    try:
        means = mean_of([product.path], parse_region(None, product.shape))
    except ProcessError:
        # No pixel of the middle can be used.
        return []
    title = "uncertainty budget of {} = {:.6g} {}, mean of the middle half; {}"
    return [
        (title.format(mean.name, mean.value, mean.unit, mean.interval_text), [BUDGET_COLUMNS, *mean.budget_lines])
        for mean in means
        if mean.name in BUDGETED
    ]


def _curve(path: Path) -> ReportSection:
    try:
        rows = [row for row in csv.reader(read_text(path).splitlines(keepends=True)) if row]
    except csv.Error as error:
        raise ProcessError(f"{path}: cannot be read as CSV ({error})") from error
    shown = [rows[0], *([_round(cell) for cell in row] for row in rows[1 : ROWS + 1])] if rows else []
    name = path.name if len(rows) <= ROWS + 1 else f"{path.name}: first {ROWS} of {len(rows) - 1} rows"
    return ReportSection(path.name, [], (), [(name, shown)] if shown else ())


def _round(cell: str) -> str:
    try:
        number = float(cell)
    except ValueError:
        return cell
    return f"{number:.5g}" if number == number else "-"


def _pairs(values: dict[str, Any]) -> list[tuple[str, str]]:
    return [("", ""), *((_label(name), fact_words(value)) for name, value in values.items())]


def _label(name: str) -> str:
    words = name.removesuffix("_s").replace("_", " ")
    return f"{words} / s" if name.endswith("_s") else words
