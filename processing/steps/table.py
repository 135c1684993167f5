"""Products to a table over scattering geometry."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from processing.doors import require_distinct
from processing.errors import ProcessError
from processing.maps.tables import tabulate
from processing.maps.white_reference import WhiteReference
from processing.reflectance.table_axes import Layout
from processing.reflectance.tables import ScatteringTable, table_steps
from processing.steps.file_step import FileStep, Progress
from processing.steps.maps import geometry_identities
from processing.storage.products.provenance import Step, content_of, file_identity


@dataclass(frozen=True)
class Tabulation(FileStep):
    """`process table`: all samples of Mueller or xi0 products of one wavelength.

    Attributes
    ----------
    sources
        Products.
    geometry
        File of camera, source and shape.
    out
        The table; it has no other usual name.
    layout
        Of the bins.
    white
        Mueller product of a white plaque, its geometry file and its certificate; None: values in counts.

    Examples
    --------
    >>> image = Reduction("sphere.h5").make()
    >>> print(Tabulation((image,), "geometry.yaml", "table.h5").make())
    table.h5
    """

    sources: tuple[Path, ...]
    geometry: Path
    out: Path
    layout: Layout = "degree"
    white: tuple[Path, Path, Path] | None = None

    @property
    def usual_path(self) -> Path:
        """As given."""
        return self.out

    def record(self) -> Step:
        """Layout, sources and geometry."""
        require_distinct(self.sources)
        inputs = [file_identity(source, "source") for source in self.sources]
        if self.white is not None:
            plaque, geometry, certificate = self.white
            inputs += [file_identity(plaque, "white"), *geometry_identities(geometry)]
            inputs.append(file_identity(certificate, "certificate"))
        return Step("table", {"layout": self.layout}, (*inputs, *geometry_identities(self.geometry)))

    @property
    def _scale(self) -> WhiteReference | None:
        return None if self.white is None else WhiteReference.of(*self.white)

    def _write(self, out: Path, record: Step, overwrite: bool, progress: Progress | None) -> None:
        table = tabulate(self.sources, self.geometry, self.layout, progress=progress, white=self._scale)
        table.save(out, (record,))

    def append(self, progress: Progress | None = None) -> Path:
        """Add the sources to the table that is there; without one, make it.

        Raises
        ------
        ProcessError
            A source is in the table already, and its samples would count twice.
        """
        if not self.out.exists():
            return self.make(progress=progress)
        record, before = self.record(), table_steps(self.out)
        _refuse_twice(record, before)
        grown = Step("table", record.arguments, (*record.inputs, file_identity(self.out, "table")))
        table = ScatteringTable.load(self.out)
        tabulate(self.sources, self.geometry, self.layout, table, progress=progress, white=self._scale)
        table.save(self.out, (*before, grown))
        return self.out


def _refuse_twice(record: Step, before: Sequence[Step]) -> None:
    sources = {content_of(i) for step in before for i in step.inputs if i["role"] == "source"}
    for source in record.inputs:
        if source["role"] == "source" and content_of(source) in sources:
            raise ProcessError(f"{source['path']} is in the table already; its samples would count twice.")
