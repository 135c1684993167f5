"""Write what `diagnose --reflectance` found: a material, a geometry, an instrument file, each only if it changed."""

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from processing.diagnosis.instrument_file import WriteError, file_head
from processing.diagnosis.surface.diagnose import SurfaceDiagnosis
from processing.doors import require_new
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.applied_effects import instrument_effects
from processing.instrument.model import InstrumentModel
from processing.reduction.flat import SAME_NM
from processing.reflectance import first_surface, polarized_diffuse
from processing.reflectance.effects.base import reflectance_effects
from processing.whole_file import write_new_text
from processing.yaml_file import dump_yaml


def corrected_material(
    material: first_surface.Model | polarized_diffuse.Model, diagnosis: SurfaceDiagnosis
) -> polarized_diffuse.Model:
    """The material with the constants found at the diagnosis' wavelength; those at others stay as they are."""
    constants: dict[float, polarized_diffuse.Constants] = {}
    for nm, c in material.constants.items():
        a, b = (c.a, c.b) if isinstance(c, polarized_diffuse.Constants) else (0.0, 2.0)
        constants[nm] = polarized_diffuse.Constants(n=c.n, k=c.k, a=a, b=b)
    key = next((nm for nm in constants if abs(nm - diagnosis.wavelengths_nm[0]) < SAME_NM), diagnosis.wavelengths_nm[0])
    constants[key] = polarized_diffuse.Constants(**diagnosis.constants)
    names = ", ".join(c.name for c in diagnosis.captures)
    source = f"diagnose, {diagnosis.wavelengths_nm[0]:g} nm, from {names}"
    return polarized_diffuse.Model(name=f"{material.name}, corrected", source=source, constants=constants)


def corrected_geometry(view: ViewingGeometry, diagnosis: SurfaceDiagnosis) -> ViewingGeometry:
    """The geometry with the sphere and the arm's zero where they were found."""
    for effect in diagnosis.applied():
        values = {name: float(p.value) for name, p in effect.parameters.items() if not isinstance(p.value, tuple)}
        if effect.kind in reflectance_effects():
            view = reflectance_effects()[effect.kind].corrected(view, values)
    return view


def targets(path: Path) -> tuple[Path, Path, Path]:
    """Files for the material, the geometry and the instrument."""
    return path, path.with_suffix(".geometry.yaml"), path.with_suffix(".instrument.yaml")


def write_surface(
    path: Path,
    diagnosis: SurfaceDiagnosis,
    material: Any,
    view: ViewingGeometry,
    *,
    instrument: InstrumentModel,
    note: str = "",
) -> list[Path]:
    """Write the files that the effects found change; returns them.

    Parameters
    ----------
    path : of the material; the others are named after it (`targets`).
    note : why it is believed, for the head of each file.

    Raises
    ------
    WriteError : nothing was found that a file could hold, or the correction is refused.
    ProcessError : one of the files exists.
    """
    if diagnosis.correction.refused is not None:
        raise WriteError(f"{path} was not written: {diagnosis.correction.refused}.")
    kinds = {e.kind for e in diagnosis.applied()}
    files = {effect.corrects for kind, effect in reflectance_effects().items() if kind in kinds}
    of_instrument = tuple(e for e in diagnosis.applied() if e.kind in instrument_effects())
    models: list[tuple[Path, BaseModel]] = []
    for_material, for_geometry, for_instrument = targets(path)
    if "material" in files:
        models.append((for_material, corrected_material(material, diagnosis)))
    if "geometry" in files:
        models.append((for_geometry, corrected_geometry(view, diagnosis)))
    if of_instrument:
        changed = instrument.model_copy(update={"effects": (*instrument.effects, *of_instrument)})
        models.append((for_instrument, changed))
    if not models:
        hint = f" {', '.join(sorted(kinds))} has no place in a file: mend it at the bench." if kinds else ""
        raise WriteError(f"nothing was found that could go into {path}; it was not written.{hint}")
    for target, _ in models:
        require_new(target)
    head = file_head(f"Written by `diagnose --reflectance`: {diagnosis.verdict}.", note)
    for target, model in models:
        write_new_text(target, head + dump_yaml(model))
    return [target for target, _ in models]
