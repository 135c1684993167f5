"""The options of `process import` in a YAML file, to import other data in the same way."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from processing.section import Section
from processing.yaml_file import dump_yaml, load_yaml

if TYPE_CHECKING:
    from processing.storage.formats.import_request import ImportRequest


class ImportRecipe(Section):
    """Options of `process import` that describe how a lab writes its data; names as on the command line."""

    wavelength_nm: float | None = None
    states: str | None = None
    columns: tuple[str, ...] | None = None
    angles: Literal["degrees", "radians"] | None = None
    stack: str | None = None
    darks: str | None = None
    instrument: str | None = None
    sample: str | None = None
    omega_deg: float | None = None
    black_level: float | None = None
    gain_e_per_count: float | None = None
    read_noise_e: float | None = None
    bits: int | None = None
    repeats: int | None = None


def read_recipe(context: typer.Context, path: Path | None) -> Path | None:
    """Make the options of a recipe the defaults of this command. Raises ConfigError where it cannot be used."""
    if path is not None:
        context.default_map = load_yaml(path, ImportRecipe).model_dump(exclude_none=True)
    return path


def recipe_text(context: typer.Context, request: ImportRequest) -> str:
    """The options of this run as a recipe, with the files of one request."""
    names = {**context.params, "states": request.states, "stack": request.stack, "darks": request.darks}
    names["columns"] = [f"{name}={column}" for name, column in request.columns.items()] or None
    options = {name: names[name] for name in ImportRecipe.model_fields if names[name] is not None}
    texts = {name: str(value) if isinstance(value, Path) else value for name, value in options.items()}
    return dump_yaml(ImportRecipe.model_validate(texts))
