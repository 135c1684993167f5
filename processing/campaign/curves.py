"""A campaign of any samples without a geometry: every capture reduced, and the means of a region of each."""

from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from processing.campaign.captures import ObjectCapture, choose, find_captures, flats_of
from processing.campaign.executors import gather
from processing.computing.blas import one_blas_thread
from processing.maps.means import MeanValue, mean_of
from processing.maps.region import parse_region
from processing.steps.file_step import Progress
from processing.steps.reduction import Reduction
from processing.storage.products.product import Product


class CurveTask(NamedTuple):
    """One capture and what belongs to it; it travels to other processes."""

    capture: ObjectCapture
    out: Path
    region: str | None
    flat: Path | None
    instrument: Path | None


class CurvePoint(NamedTuple):
    """The product of one capture, whether it existed, and the means of the region."""

    capture: ObjectCapture
    product: Path
    is_unchanged: bool
    means: tuple[MeanValue, ...]

    @property
    def rows(self) -> list[dict[str, Any]]:
        """Rows of the table, one for each quantity."""
        path, kind, nm, omega, mode, sample, _ = self.capture
        place = {"sample": sample, "mode": mode, "kind": kind, "wavelength_nm": nm, "omega_deg": omega}
        place |= {"capture": path.name}
        columns = ("value", "u", "u_noise", "u_systematic", "low", "high", "unit")
        return [place | {"quantity": m.name} | {name: getattr(m, name) for name in columns} for m in self.means]


@dataclass(frozen=True)
class Curves:
    """`process campaign` without a geometry.

    Attributes
    ----------
    folder : of the captures.
    out : folder of the products; those that exist are found again by what they were made of.
    region : pixels of the means, r0:r1,c0:c1; None: the middle half of the frame.
    instruments : instrument file by the text of the model in a capture, instead of that model.
    instrument : the same for all Mueller captures.
    modes, samples : names of those whose captures take part; empty for all.
    """

    folder: Path
    out: Path
    region: str | None = None
    instrument: Path | None = None
    instruments: Mapping[Path, Path] | None = None
    modes: tuple[str, ...] = ()
    samples: tuple[str, ...] = ()

    def run(
        self, pool: Executor, progress: Progress | None = None
    ) -> tuple[list[tuple[Path, CurvePoint | Exception]], bool, list[str]]:
        """Work on the captures in `pool`: a result or an error of each; whether simulated; files left out.

        Raises ProcessError: see `find_captures` and `choose`.
        """
        candidates, simulated, left_out, damaged = find_captures(self.folder, self.out, of_objects=False)
        captures, omitted = choose(candidates, self.modes, self.samples, twins=True)
        self.out.mkdir(parents=True, exist_ok=True)
        flats, corrected = flats_of(self.folder, captures), self.instruments or {}
        tasks = [
            CurveTask(
                capture,
                self.out,
                self.region,
                flats.get(capture.path),
                corrected.get(capture.path, self.instrument if capture.kind == "mueller" else None),
            )
            for capture in captures
        ]
        results = gather(pool, curve_point, tasks, progress)
        paths = [capture.path for capture in captures]
        return [*zip(paths, results, strict=True), *damaged], simulated, left_out + omitted


@one_blas_thread()
def curve_point(task: CurveTask) -> CurvePoint:
    """Reduce a capture, unless its product exists, and average the region."""
    path = task.capture.path
    reduction = Reduction(path, task.instrument, flat=(task.flat,) if task.flat else ())
    output = reduction.found_or_made(task.out / f"{path.stem}.{task.capture.kind}.h5")
    with Product(output.path) as product:
        region = parse_region(task.region, product.shape)
    return CurvePoint(task.capture, output.path, output.existed, tuple(mean_of([output.path], region)))
