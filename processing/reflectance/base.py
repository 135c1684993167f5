"""What every reflectance model offers, and how a file names one: its `kind` is a module of this folder."""

import importlib
import pkgutil
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from processing.arrays import Array, ComplexArray
from processing.geometry.frames import ScatteringGeometry
from processing.section import Section
from processing.yaml_file import ConfigError, load_yaml

ENTRY_POINT_GROUP = "umov.reflectance"


class ReflectanceModel(Protocol):
    """A model of the dominant Mueller-Jones matrix. Both results are in the axes that the geometry states."""

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Wavelengths at which the material is given."""
        ...

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2), not normalized."""
        ...

    def mueller_jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Mueller-Jones matrices (..., 4, 4) with element 00 equal to 1."""
        ...


class Material(Section):
    """What every material file of this folder states; each kind adds `kind` and the type of its constants."""

    name: str = Field(description="name that messages and other files use")
    source: str | None = Field(default=None, description="where the constants come from")
    constants: dict[float, Any] = Field(description="optical constants for each wavelength in nm")

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """Wavelengths at which the material is given."""
        return tuple(self.constants)

    def jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> ComplexArray:
        """Jones matrices (..., 2, 2)."""
        raise NotImplementedError

    def mueller_jones(self, geometry: ScatteringGeometry, wavelength_nm: float) -> Array:
        """Mueller-Jones matrices (..., 4, 4), element 00 equal to 1."""
        return normalized_mueller(self.jones(geometry, wavelength_nm))


class _Header(BaseModel):
    model_config = ConfigDict(extra="allow")
    kind: str


def normalized_mueller(jones: ComplexArray) -> Array:
    """Mueller-Jones matrices (..., 4, 4) of Jones matrices (..., 2, 2), divided by their element 00.

    M_ab = 1/2 tr(s_a J s_b J^H), written out (the general product costs three times as much).
    """
    j00, j01, j10, j11 = (jones[..., i, k] for i in (0, 1) for k in (0, 1))
    a, b, c, d = (z.real**2 + z.imag**2 for z in (j00, j01, j10, j11))
    scale = 2.0 / (a + b + c + d)
    mueller = np.empty((*j00.shape, 4, 4))
    mueller[..., 0, 0] = 1.0
    mueller[..., 0, 1] = 0.5 * scale * (a - b + c - d)
    mueller[..., 1, 0] = 0.5 * scale * (a + b - c - d)
    mueller[..., 1, 1] = 0.5 * scale * (a - b - c + d)
    top, bottom = j00 * j01.conj(), j10 * j11.conj()
    mueller[..., 0, 2], mueller[..., 0, 3] = scale * (top + bottom).real, -scale * (top + bottom).imag
    mueller[..., 1, 2], mueller[..., 1, 3] = scale * (top - bottom).real, -scale * (top - bottom).imag
    first, second = j00 * j10.conj(), j01 * j11.conj()
    mueller[..., 2, 0], mueller[..., 3, 0] = scale * (first + second).real, scale * (first + second).imag
    mueller[..., 2, 1], mueller[..., 3, 1] = scale * (first - second).real, scale * (first - second).imag
    diagonal, anti = j00 * j11.conj(), j01 * j10.conj()
    mueller[..., 2, 2], mueller[..., 3, 3] = scale * (diagonal + anti).real, scale * (diagonal - anti).real
    mueller[..., 3, 2], mueller[..., 2, 3] = scale * (diagonal + anti).imag, scale * (anti - diagonal).imag
    return mueller


@cache
def kinds() -> dict[str, type[BaseModel]]:
    """Model classes by kind: each module of this folder that has a class `Model`, then plug-ins.

    Raises ConfigError for a plug-in that offers a kind that exists already.
    """
    import processing.reflectance as folder

    models: dict[str, type[BaseModel]] = {}
    for info in pkgutil.iter_modules(folder.__path__):
        module = importlib.import_module(f"processing.reflectance.{info.name}")
        if hasattr(module, "Model"):
            models[info.name] = module.Model
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name in models:
            raise ConfigError(f"plug-in {entry.value} offers the model {entry.name!r}, which exists already")
        models[entry.name] = entry.load()
    return models


def load_reflectance(path: Path | str) -> Any:
    """The model that a material file describes.

    Parameters
    ----------
    path : path or str

    Returns
    -------
    ReflectanceModel
        Of the kind that the file names.

    Raises
    ------
    ConfigError
        The file cannot be read, or does not fit; the message has file, line and key.

    Examples
    --------
    >>> load_reflectance("material.yaml").name
    'red 3D print'
    """
    header = load_yaml(path, _Header)
    model = _model_here(header.kind) or kinds().get(header.kind)
    if model is None:
        raise ConfigError(
            f"{path}: kind: no reflectance model {header.kind!r}; there are: {', '.join(sorted(kinds()))}"
        )
    return load_yaml(path, model)


@cache
def _model_here(kind: str) -> type[BaseModel] | None:
    """The model of one module of this folder; its neighbours, some slow to import, stay where they are.

    None where there is none, and for a name that a plug-in offers as well, of which `kinds` complains.
    """
    import processing.reflectance as folder

    names = {info.name for info in pkgutil.iter_modules(folder.__path__)}
    if kind not in names or kind in entry_points(group=ENTRY_POINT_GROUP).names:
        return None
    return getattr(importlib.import_module(f"processing.reflectance.{kind}"), "Model", None)


def constants_at(constants: dict[float, Any], wavelength_nm: float, name: str) -> Any:
    """The entry within 0.5 nm of a wavelength; nothing is interpolated. Raises ConfigError."""
    for key, value in constants.items():
        if abs(key - wavelength_nm) < 0.5:
            return value
    wavelengths = ", ".join(f"{k:g}" for k in constants)
    raise ConfigError(
        f"material {name!r} is given at {wavelengths} nm, not at {wavelength_nm:g} nm. Use a material file that has it."
    )
