"""Provenance of a product: the steps that led to it, with options, content of the inputs, program and date."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from processing.doors import require_file
from processing.storage.integrity.content import without_frames_sha256
from processing.storage.integrity.h5_door import mark_of

#: Attribute of a product's root: `Step.made_of` of its last step.
MADE_OF = "made_of"
#: By what a file is known, in this order, and how people are told.
CONTENTS = {
    "sha256": "SHA-256",
    "sha256_without_frames": "SHA-256 of all but the frames, with their checksums",
    MADE_OF: "made of",
}


@cache
def program() -> str:
    """Name and version of this program, and the first digits of the SHA-256 of its code.

    A checkout changes while its version stays, and what its numbers are made with changes with it.
    """
    code = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].rglob("*.py")):
        code.update(path.read_bytes())
    return f"umov {version('umov')}, code {code.hexdigest()[:12]}"


@dataclass(frozen=True)
class Step:
    """One step: what runs, with which options, on which files (`file_identity`), by which program, when (ISO 8601)."""

    name: str
    arguments: dict[str, Any]
    inputs: tuple[dict[str, Any], ...] = ()
    program: str = field(default_factory=lambda: program())
    date: str = field(default_factory=lambda: datetime.now(UTC).isoformat(timespec="seconds"))

    @property
    def made_of(self) -> str:
        """SHA-256 (hex) of everything that decides the product: name, arguments, content of the inputs, program.

        Date, and place and time stamp of the files, are not in it.
        """
        contents = [(i.get("role"), content_of(i)) for i in self.inputs]
        text = json.dumps([self.name, self.arguments, contents, self.program], default=jsonable, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()


def file_identity(path: Path, role: str = "") -> dict[str, Any]:
    """What an input file is, as the provenance keeps it: role, path, size, and its content.

    A product is known by what it was made of, a capture by the SHA-256 of its bytes with the checksums of its frames
    in place of them, any other file by the SHA-256 of its bytes. Raises ProcessError for what is no file.
    """
    size = require_file(path)
    identity = {"role": role, "path": str(path.resolve()), "bytes": size}
    mark = made_of(path)
    if mark is not None:
        return identity | {MADE_OF: mark}
    summed = without_frames_sha256(path)
    if summed is not None:
        return identity | {"sha256_without_frames": summed}
    with path.open("rb") as file:
        return identity | {"sha256": hashlib.file_digest(file, "sha256").hexdigest()}


def content_of(identity: Mapping[str, Any]) -> str | None:
    """The field of an identity that represents the content; None without one."""
    return next((str(identity[kind]) for kind in CONTENTS if identity.get(kind)), None)


def made_of(path: Path) -> str | None:
    """`Step.made_of` of a product; None for a file that does not exist or has no such mark."""
    mark = mark_of(path, MADE_OF)
    return None if mark is None else str(mark)


def sign(h5: h5py.File, steps: Sequence[Step]) -> None:
    """Store the inputs of a product; nothing for a step without recorded inputs."""
    if steps and steps[-1].inputs:
        h5.attrs[MADE_OF] = steps[-1].made_of


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
            name=_text(g, "step"),
            arguments=json.loads(_text(g, "arguments_json")),
            inputs=tuple(json.loads(_text(g, "inputs_json"))),
            program=_text(g, "program"),
            date=_text(g, "date"),
        )
        for g in groups
    )


def _text(group: h5py.Group, name: str) -> str:
    """One text of a group; ValueError where it is several, or none."""
    text = group[name].asstr()[()]
    if not isinstance(text, str):
        raise ValueError(f"{group.name}/{name} is not one text")
    return text


def steps_text(steps: Sequence[Step]) -> str:
    """Lines for people: each step with the arguments that were given, and its inputs."""
    lines = []
    for step in steps:
        arguments = ", ".join(f"{k}={v}" for k, v in step.arguments.items() if v is not None)
        lines += [f"{step.date} {step.program}: {step.name}({arguments})"]
        lines += [f"    from {input_text(identity)}" for identity in step.inputs]
    return "\n".join(lines)


def input_text(identity: dict[str, Any]) -> str:
    """One line for people about an input file: role, path, size and content."""
    role = f"{identity['role']} " if identity.get("role") else ""
    for kind, words in CONTENTS.items():
        if kind in identity:
            return f"{role}{identity['path']} ({identity['bytes']} bytes, {words} {identity[kind]})"
    return f"{role}{identity['path']} ({identity['bytes']} bytes)"


def jsonable(value: Any) -> Any:
    """numpy numbers and arrays as plain ones, anything else as text; for json.dumps."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value)
