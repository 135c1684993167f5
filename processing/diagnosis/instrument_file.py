"""Write the instrument model with the effects that were found: `diagnose --write`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from processing.diagnosis.search.result import Diagnosis
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.yaml_file import dump_yaml


class WriteError(ProcessError):
    """The new instrument file cannot be written."""


def extended(model: InstrumentModel, diagnosis: Diagnosis) -> InstrumentModel:
    """The instrument model (as in its file, at all its wavelengths) with the diagnosis put in.

    Effects come behind those that it has; values that the file calls nominal are replaced by what was fitted. An
    effect of the same kind, place and wavelength is replaced: its new values are on top of the old ones.
    """
    values: dict[str, dict[str, Any]] = {}
    for name, entry in diagnosis.calibrated.items():
        element, _, field = name.rpartition(".")
        old = next(getattr(e, field) for e in model.elements() if e.name == element)
        new: Any = entry.value
        if isinstance(old, dict):
            key = next((k for k in old if abs(k - diagnosis.wavelength_nm) < 0.5), diagnosis.wavelength_nm)
            new = {**old, key: entry.value}
        values.setdefault(element, {})[field] = new

    def swap(elements: tuple[Any, ...]) -> tuple[Any, ...]:
        return tuple(e.model_copy(update=values.get(e.name, {})) for e in elements)

    channels = tuple(c.model_copy(update={"elements": swap(c.elements)}) for c in model.channels)
    update = {
        "generator": swap(model.generator),
        "analyzer": swap(model.analyzer),
        "channels": channels,
        "effects": (*model.effects, *diagnosis.applied()),
        "systematic": (*model.systematic, *diagnosis.systematic()),
    }
    return model.model_copy(update=update)


def write_instrument(path: Path, model: InstrumentModel, diagnosis: Diagnosis) -> None:
    """Write `extended` to a new file.

    Raises
    ------
    WriteError : the file exists, or there is nothing to write.
    """
    if diagnosis.correction is not None and diagnosis.correction.refused is not None:
        raise WriteError(f"{path} was not written: {diagnosis.correction.refused}.")
    if not diagnosis.applied() and not diagnosis.calibrated:
        raise WriteError(f"nothing was found that could go into {path}; it was not written.")
    text = dump_yaml(extended(model, diagnosis))
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(f"# Written by `diagnose`: {diagnosis.verdict}, see `effects`.\n{text}")
    except FileExistsError as error:
        raise WriteError(f"{path} exists; diagnose never replaces a file. Give another --write.") from error
