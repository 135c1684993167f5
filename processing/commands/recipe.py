"""The options of `process import` in a YAML file, to import other data in the same way."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import typer

from processing.section import Section
from processing.whole_file import write_whole_text
from processing.yaml_file import dump_yaml, load_yaml


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
    each: bool | None = None


def read_recipe(context: typer.Context, path: Path | None) -> Path | None:
    """Make the options of a recipe the defaults of this command. Raises ConfigError where it cannot be used."""
    if path is not None:
        context.default_map = load_yaml(path, ImportRecipe).model_dump(exclude_none=True)
    return path


def keep_recipe(context: typer.Context, out: Path) -> Path:
    """Write the options of this run beside its capture; returns NAME.import.yaml."""
    given = {name: context.params[name] for name in ImportRecipe.model_fields if context.params[name] is not None}
    texts = {name: str(value) if isinstance(value, Path) else value for name, value in given.items()}
    path = out.with_suffix(".import.yaml")
    write_whole_text(path, dump_yaml(ImportRecipe.model_validate(texts)))
    return path
