"""Provenance of a product: the steps that led to it, with arguments, inputs, program and date."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np


@dataclass(frozen=True)
class Step:
    """One step of the provenance: what ran, with which arguments, on which files, when (ISO 8601)."""

    name: str
    arguments: dict[str, Any]
    inputs: tuple[dict[str, Any], ...] = ()
    program: str = field(default_factory=lambda: f"umov {version('umov')}")
    date: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))


def file_identity(path: Path) -> dict[str, Any]:
    """Name, size and modification time of an input file, as the provenance keeps them."""
    stat = path.stat()
    changed = datetime.fromtimestamp(stat.st_mtime, UTC).isoformat(timespec="microseconds")
    return {"path": str(path.resolve()), "bytes": stat.st_size, "modified": changed}


def write_steps(entry: h5py.Group, steps: Sequence[Step]) -> None:
    """Append steps to an entry as NXprocess groups, numbered after those that are there."""
    first = 1 + sum(1 for name in entry if name.startswith("process_"))
    for number, step in enumerate(steps, first):
        group = entry.create_group(f"process_{number}")
        group.attrs["NX_class"] = "NXprocess"
        group["program"], group["date"], group["sequence_index"] = step.program, step.date, number
        group["step"] = step.name
        group["arguments_json"] = json.dumps(step.arguments, default=jsonable)
        group["inputs_json"] = json.dumps(step.inputs, default=jsonable)


def read_steps(entry: h5py.Group) -> tuple[Step, ...]:
    """Steps of an entry, oldest first."""
    groups = sorted(
        (g for n, g in entry.items() if n.startswith("process_")), key=lambda g: int(g["sequence_index"][()])
    )
    return tuple(
        Step(
            name=g["step"].asstr()[()],
            arguments=json.loads(g["arguments_json"].asstr()[()]),
            inputs=tuple(json.loads(g["inputs_json"].asstr()[()])),
            program=g["program"].asstr()[()],
            date=g["date"].asstr()[()],
        )
        for g in groups
    )


def step_text(step: Step) -> str:
    """One line for people: step and the arguments that were given."""
    given = ", ".join(f"{k}={v}" for k, v in step.arguments.items() if v is not None)
    return f"{step.date} {step.program}: {step.name}({given})"


def jsonable(value: Any) -> Any:
    """numpy numbers and arrays as plain ones, anything else as text; for json.dumps."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value)
