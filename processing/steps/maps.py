"""Maps of a reduced image: derived quantities, xi0, and the Mueller image that a model extrapolates."""

from dataclasses import dataclass, field
from pathlib import Path

from processing.errors import ProcessError
from processing.geometry.viewing import ViewingGeometry
from processing.polarization.quantities import PAPER_PAIRS, NamedStokes
from processing.steps.file_step import FileStep, Progress, path_beside
from processing.storage.products.product import Product
from processing.storage.products.provenance import Step, file_identity


@dataclass(frozen=True)
class Quantities(FileStep):
    """`process quantities`: every derived map (rows, columns) of a Mueller image, with standard errors.

    What each is, its unit and where it does not exist: docs/quantities.md.

    Attributes
    ----------
    source
        Product of `Reduction` or `Extrapolation`.
    also
        Decompositions besides: "symmetric", "differential".
    pairs
        Name of a map to the states of two polarizers: light that passes both, over m00.

    Examples
    --------
    >>> print(Quantities(Reduction("sphere.h5").make()).make())
    sphere.quantities.h5
    """

    source: Path
    also: tuple[str, ...] = ()
    pairs: dict[str, tuple[NamedStokes, NamedStokes]] = field(default_factory=lambda: dict(PAPER_PAIRS))

    @property
    def usual_path(self) -> Path:
        """Beside the source."""
        return path_beside(self.source, "quantities")

    def record(self) -> Step:
        """Decompositions, pairs and the source."""
        options = {"also": sorted(self.also), "pairs": self.pairs}
        return Step("quantities", options, (file_identity(self.source, "source"),))

    def _write(self, out: Path, record: Step, overwrite: bool, progress: Progress | None) -> None:
        from processing.maps.quantities import quantities_of_mueller

        quantities_of_mueller(
            self.source, out, record, self.also, pairs=self.pairs, overwrite=overwrite, progress=progress
        )


@dataclass(frozen=True)
class Xi0(FileStep):
    """`process xi0`: depolarization xi0 (rows, columns) with its standard error and intervals.

    Attributes
    ----------
    source
        Mueller or Stokes product.
    geometry, material
        Files of camera, source and shape, and of the dominant process: for a source with less than whole matrices.

    Examples
    --------
    >>> print(Xi0(Reduction("sphere.h5").make()).make())
    sphere.xi0.h5
    """

    source: Path
    geometry: Path | None = None
    material: Path | None = None

    @property
    def usual_path(self) -> Path:
        """Beside the source."""
        return path_beside(self.source, "xi0")

    def record(self) -> Step:
        """The source; of a Stokes product geometry and material too, which a Mueller product does not need."""
        if self._by_model():
            return Step("xi0", {}, _modelled(self.source, *self._model()))
        return Step("xi0", {}, (file_identity(self.source, "source"),))

    def _of_stokes(self) -> bool:
        with Product(self.source) as product:
            product.require("mueller", "stokes")
            return product.kind == "stokes"

    def _by_model(self) -> bool:
        """Whether the source holds less than whole matrices: the user must then give the dominant process."""
        with Product(self.source) as product:
            return self._of_stokes() or int(product.facts.get("rank", 16)) < 16

    def _model(self) -> tuple[Path, Path]:
        if self.geometry is None or self.material is None:
            raise ProcessError(
                f"{self.source} holds less than whole Mueller matrices, and gives xi0 only with a model of the "
                "dominant process: give --geometry FILE and --material FILE."
            )
        return self.geometry, self.material

    def _write(self, out: Path, record: Step, overwrite: bool, progress: Progress | None) -> None:
        from processing.maps.xi0 import xi0_of_mueller, xi0_of_partial, xi0_of_stokes

        if self._of_stokes():
            xi0_of_stokes(self.source, *self._model(), out, step=record, overwrite=overwrite)
        elif self._by_model():
            xi0_of_partial(self.source, *self._model(), out, step=record, overwrite=overwrite)
        else:
            xi0_of_mueller(self.source, out, record, overwrite, progress=progress)


@dataclass(frozen=True)
class Extrapolation(FileStep):
    """`process extrapolate`: a Mueller image (4, 4, rows, columns) in counts from a Stokes image and a model.

    Attributes
    ----------
    source
        Stokes product.
    geometry, material
        Files of camera, source and shape, and of the dominant process.

    Examples
    --------
    >>> stokes = Reduction("mosaic.h5").make()
    >>> print(Extrapolation(stokes, "geometry.yaml", "material.yaml").make())
    mosaic.extrapolated.h5
    """

    source: Path
    geometry: Path
    material: Path

    @property
    def usual_path(self) -> Path:
        """Beside the source."""
        return path_beside(self.source, "extrapolated")

    def record(self) -> Step:
        """Source, geometry and material."""
        return Step("extrapolate", {}, _modelled(self.source, self.geometry, self.material))

    def _write(self, out: Path, record: Step, overwrite: bool, progress: Progress | None) -> None:
        from processing.maps.extrapolation import extrapolate_mueller

        extrapolate_mueller(self.source, self.geometry, self.material, out, step=record, overwrite=overwrite)


def geometry_identities(geometry: Path) -> list[dict[str, object]]:
    """Identities of a geometry file and of the mesh that it names."""
    identities = [file_identity(geometry, "geometry")]
    mesh = getattr(ViewingGeometry.load(geometry).shape, "file", None)
    return identities if mesh is None else [*identities, file_identity(Path(mesh), "mesh")]


def _modelled(source: Path, geometry: Path, material: Path) -> tuple[dict[str, object], ...]:
    return file_identity(source, "source"), *geometry_identities(geometry), file_identity(material, "material")
