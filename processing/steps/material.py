"""Products to a material file."""

from dataclasses import dataclass
from pathlib import Path

from processing.doors import require_place
from processing.maps.material_fit import fit_products
from processing.reflectance.fitted_constants import MaterialFit
from processing.steps.file_step import OfFiles
from processing.steps.maps import geometry_identities
from processing.storage.products.provenance import Step, file_identity, input_text
from processing.whole_file import write_whole_text
from processing.yaml_file import dump_yaml


@dataclass(frozen=True)
class FittedMaterial:
    """Constants at one wavelength, and the step that they come from."""

    fit: MaterialFit
    wavelength_nm: float
    simulated: bool
    name: str
    record: Step

    def save(self, out: Path, overwrite: bool = False) -> None:
        """Write a material file (YAML); errors, correlations and provenance are comments at its top."""
        require_place(out, overwrite)
        sources = [Path(i["path"]).name for i in self.record.inputs if i["role"] == "source"]
        notes = [*self.fit.notes(sources), *map(input_text, self.record.inputs), f"made of {self.record.made_of}"]
        header = "".join(f"# {note}\n" for note in notes)
        write_whole_text(out, header + dump_yaml(self.fit.model(self.name, self.wavelength_nm)))


@dataclass(frozen=True)
class MaterialFitting(OfFiles):
    """`process fit-material`: constants of the polarized diffuse model, or of a rough plastic.

    Attributes
    ----------
    sources
        Mueller or Stokes products, all of one kind and one wavelength.
    geometry
        File of camera, source and shape.
    name
        Of the material, for its file.
    correlation
        See `processing.reflectance.material_fit.fit_values`.
    kind
        Of the model: polarized_diffuse or rough_plastic.

    Examples
    --------
    >>> fitted = MaterialFitting((Reduction("sphere.h5").make(),), "geometry.yaml").fitted()
    >>> n, k = fitted.fit.constants[:2]
    >>> u_n = fitted.fit.covariance[0, 0] ** 0.5
    >>> bool(abs(n - 1.30) < 4 * u_n)
    True
    """

    sources: tuple[Path, ...]
    geometry: Path
    name: str = "fitted material"
    correlation: bool = False
    kind: str = "polarized_diffuse"

    def record(self) -> Step:
        """Name, sources and geometry."""
        inputs = [file_identity(source, "source") for source in self.sources]
        options = {"name": self.name} | ({"correlation": True} if self.correlation else {})
        if self.kind != "polarized_diffuse":
            options["kind"] = self.kind
        return Step("fit-material", options, (*inputs, *geometry_identities(self.geometry)))

    def fitted(self) -> FittedMaterial:
        """Fit, see `processing.maps.material_fit.fit_products`."""
        fit = fit_products(self.sources, self.geometry, correlation=self.correlation, kind=self.kind)
        return FittedMaterial(*fit, self.name, self.record())
