"""A campaign: captures of one object at many arm angles, by a Mueller polarimeter and a linear Stokes camera.

As in Sec. V of Jarecki and Kupinski: the Mueller captures give psi and |D| of the dominant process, compared with
the model at the same pixels; xi0 of both instruments goes into tables over scattering geometry, which are compared
on a virtual sphere as the Stokes camera sees it.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.campaign.captures import choose, find_captures, flats_of
from processing.campaign.executors import gather
from processing.campaign.tasks import CaptureMeasure, CaptureTask, locate, measure, task_view
from processing.computing.blas import one_blas_thread
from processing.errors import NotDetermined
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.uncertainty import align_inputs
from processing.reduction.mueller import Progress
from processing.reflectance.tables import ScatteringTable
from processing.storage.products.provenance import Step, file_identity

#: The default demosaicing reaches so far across the outline (`REACH` of its file).
BORDER_PX = 4


@dataclass(frozen=True)
class PaperAverages:
    """Jarecki and Kupinski's averages over fifteen arm angles (their conclusions; see docs/conventions.md)."""

    psi_deg: float
    magnitude_percent: float
    xi0_percent: float


PAPER = {451: PaperAverages(7.49, 4.96, 11.11), 662: PaperAverages(14.29, 11.73, 4.24)}


@dataclass(frozen=True)
class Row:
    """Deviations at one wavelength and arm angle; NaN where a capture is missing.

    `psi_noise_deg`, `magnitude_noise_percent` and `xi0_noise_percent` are what the noise alone, first order, makes of
    the deviation (xi0: of both instruments), `xi0_systematic_percent` what the stated uncertainties of both
    instruments make of it (0 where none is stated), `common` the fraction of the virtual sphere where both have a
    value, `eigenvalue_deviation` the 99th percentile of the largest deviation of xi1..xi3 from their mean, without what
    noise alone makes of it, which is `eigenvalue_noise`.
    """

    wavelength_nm: float
    omega_deg: float
    psi_deg: float = np.nan
    magnitude_percent: float = np.nan
    xi0_percent: float = np.nan
    psi_noise_deg: float = np.nan
    magnitude_noise_percent: float = np.nan
    xi0_noise_percent: float = np.nan
    xi0_systematic_percent: float = np.nan
    common: float = np.nan
    eigenvalue_deviation: float = np.nan
    eigenvalue_noise: float = np.nan


@dataclass(frozen=True)
class CampaignResult:
    """All rows, in order of wavelength and angle, what was left out, and the flat of each capture that has one."""

    rows: tuple[Row, ...]
    simulated: bool
    left_out: tuple[str, ...] = ()
    flats: dict[str, str] = field(default_factory=dict)
    tables: dict[tuple[str, float], Path] = field(default_factory=dict)
    #: Geometry of each kind of capture: the file's, or the one found in the images.
    views: dict[str, ViewingGeometry] = field(default_factory=dict)
    #: Captures that failed, each with its error.
    failed: tuple[tuple[Path, Exception], ...] = ()

    def average(self, wavelength_nm: float, quantity: str) -> float:
        """Mean over the arm angles of a quantity of `Row`; NaN without any."""
        values = [getattr(r, quantity) for r in self.rows if r.wavelength_nm == wavelength_nm]
        finite = [v for v in values if np.isfinite(v)]
        return float(np.mean(finite)) if finite else float("nan")


@dataclass(frozen=True)
class ProcessedCampaign:
    """`process campaign`: every capture of a folder reduced, and the two instruments and the model compared.

    Each capture is divided by the flat field of its camera and wavelength that was taken nearest in time, if the
    folder has one.

    Attributes
    ----------
    folder : of the captures.
    out : folder for products and tables; reduced captures that are there are found again by what they were made of.
    geometry, stokes_geometry : geometry files of the Mueller polarimeter and of the Stokes camera.
    material : file of the reflectance model.
    register : take centre and scale of the sphere from the images instead of from the geometry file.
    border_px : pixels nearer than this to the outline do not count.
    instrument : file of the Mueller polarimeter to use instead of the model in the captures.
    modes, samples : names of those whose captures take part; empty for all.
    """

    folder: Path
    out: Path
    geometry: Path
    material: Path
    stokes_geometry: Path | None = None
    register: bool = False
    border_px: int = BORDER_PX
    instrument: Path | None = None
    modes: tuple[str, ...] = ()
    samples: tuple[str, ...] = ()

    @one_blas_thread()
    def run(self, pool: Executor, progress: Progress | None = None) -> CampaignResult:
        """Work on the captures in `pool` and compare. Raises ProcessError: see `find_captures` and `choose`."""
        candidates, simulated, left_out, damaged = find_captures(self.folder, self.out)
        captures, omitted = choose(candidates, self.modes, self.samples)
        left_out = left_out + omitted
        self.out.mkdir(parents=True, exist_ok=True)
        flats = flats_of(self.folder, captures)
        tasks = [self._task(capture.path, capture.kind, flats.get(capture.path)) for capture in captures]
        if self.register:
            tasks = _register(tasks, pool)
        views = {task.kind: task_view(task) for task in tasks}
        results = gather(pool, measure, tasks, progress)
        measures = [result for result in results if isinstance(result, CaptureMeasure)]
        pairs = zip(captures, results, strict=True)
        failed = (*damaged, *((capture.path, result) for capture, result in pairs if isinstance(result, Exception)))
        tables = _merged_tables(measures, self.out)
        rows = tuple(_rows(measures, tables, views))
        names = {path.name: flat.name for path, flat in flats.items()}
        return CampaignResult(rows, simulated, tuple(left_out), names, tables, views, failed)

    def _task(self, capture: Path, kind: str, flat: Path | None) -> CaptureTask:
        geometry = self.geometry if kind == "mueller" else self.stokes_geometry or self.geometry
        return CaptureTask(
            str(capture),
            kind,
            str(self.out),
            str(geometry),
            str(self.material),
            self.border_px,
            flat=str(flat or ""),
            instrument=str(self.instrument or "") if kind == "mueller" else "",
        )


def _register(tasks: Sequence[CaptureTask], pool: Executor) -> list[CaptureTask]:
    # Camera and sphere stand still while the arm turns: each instrument takes its best image, mostly a side view.
    best: dict[str, tuple[float, str]] = {}
    for task, outline in zip(tasks, gather(pool, locate, tasks), strict=True):
        # A capture that fails here fails again where it is measured, and is reported there.
        if isinstance(outline, tuple) and (task.kind not in best or outline < best[task.kind]):
            best[task.kind] = outline
    lacking = sorted({t.kind for t in tasks} - set(best))
    if lacking:
        raise NotDetermined(f"no sphere could be found in any {' or '.join(lacking)} image; leave --register away.")
    return [replace(task, view_json=best[task.kind][1]) for task in tasks]


def _merged_tables(measures: Sequence[CaptureMeasure], out: Path) -> dict[tuple[str, float], Path]:
    tables: dict[tuple[str, float], Path] = {}
    for key in sorted({(m.kind, m.wavelength_nm) for m in measures}):
        merged: ScatteringTable | None = None
        for m in measures:
            if (m.kind, m.wavelength_nm) == key:
                table = ScatteringTable.load(m.table)
                if merged is None:
                    merged = table
                else:
                    merged.merge(table)
        if merged is not None:
            tables[key] = out / f"xi0_{key[0]}_{key[1]:g}nm.table.h5"
            parts = [file_identity(Path(m.table), "part") for m in measures if (m.kind, m.wavelength_nm) == key]
            merged.save(tables[key], (Step("campaign", {"kind": key[0]}, tuple(parts)),))
    return tables


def _rows(
    measures: Sequence[CaptureMeasure], tables: dict[tuple[str, float], Path], views: dict[str, ViewingGeometry]
) -> list[Row]:
    rows: list[Row] = []
    for nm in sorted({m.wavelength_nm for m in measures}):
        loaded = {k: ScatteringTable.load(tables[k, nm]) for k in ("mueller", "stokes") if (k, nm) in tables}
        for omega in sorted({round(m.omega_deg, 2) for m in measures if m.wavelength_nm == nm}):
            by_kind = {m.kind: m for m in measures if (m.wavelength_nm, round(m.omega_deg, 2)) == (nm, omega)}
            values: dict[str, Any] = {}
            if "mueller" in by_kind:
                m = by_kind["mueller"]
                values |= {"psi_deg": m.psi_deg, "magnitude_percent": m.magnitude_percent}
                values |= {"psi_noise_deg": m.psi_noise_deg, "magnitude_noise_percent": m.magnitude_noise_percent}
                values |= {"eigenvalue_deviation": m.eigenvalue_deviation, "eigenvalue_noise": m.eigenvalue_noise}
            if "stokes" in by_kind and len(loaded) == 2:
                values |= compare_on_sphere(
                    loaded["mueller"], loaded["stokes"], views["stokes"], omega, shape=by_kind["stokes"].shape
                )
            rows.append(Row(nm, omega, **values))
    return rows


def compare_on_sphere(
    reference: ScatteringTable,
    other: ScatteringTable,
    view: ViewingGeometry,
    omega_deg: float,
    *,
    shape: tuple[int, int],
) -> dict[str, float]:
    """Deviation of two xi0 tables on a virtual object (Jarecki and Kupinski, Sec. V-B): `xi0_percent`, what noise and
    the instruments' uncertainties make of it, `common`.

    The errors of one instrument are in the difference as far as they differ; those of two add as squares. Raises
    NotDetermined when the object is not in the frame.
    """
    image = view.at(omega_deg, *shape)
    if not image.mask.any():
        raise NotDetermined(f"no pixel of the virtual object is lit at omega {omega_deg:g} degrees")
    tables, angles = (reference, other), image.points.angles
    a, b = (table.lookup(angles)[0] for table in tables)
    common = np.isfinite(b - a)
    if not common.any():
        return {"common": 0.0}
    noise = [table.lookup(angles, of=table.uncertainties["u_noise"])[0, common] for table in tables]
    moved = [table.lookup(angles, of=table.directions)[:, 0, common] for table in tables]
    _, aligned = align_inputs([table.inputs for table in tables], moved)
    parts = {"": [(b - a)[common]], "noise_": noise, "systematic_": [aligned[1] - aligned[0]]}
    sizes = {f"xi0_{name}percent": 100 * _size(part) for name, part in parts.items()}
    return sizes | {"common": float(common.mean())}


def _size(parts: Sequence[NDArray[np.float64]]) -> float:
    """Root mean square over the pixels, the last axis, of the quadratic sum of all parts."""
    return float(np.sqrt(sum(np.sum(np.square(part)) / part.shape[-1] for part in parts)))
