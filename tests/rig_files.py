"""Rig files for tests: the simulated rig, small and fast, and files with something changed."""

import copy
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml
from ruamel.yaml import YAML

#: Rig files that were written, by what was asked for: hundreds of tests ask for the same.
_RIGS: dict[str, str] = {}


@functools.cache
def _tree(text: str) -> Any:
    return YAML(typ="safe", pure=True).load(text)


def change_yaml(path: Path, change: Callable[[Any], object], to: Path | None = None) -> Path:
    """Change the tree of a YAML file in place, or into another file, without comments; return that file."""
    tree = copy.deepcopy(_tree(path.read_text()))
    change(tree)
    # Written by the C library: in a twentieth of the time.
    with (to or path).open("w") as file:
        yaml.dump(tree, file, Dumper=yaml.CSafeDumper, sort_keys=False, width=1000)
    return to or path


def with_values(path: Path, values: dict[str, object], to: Path) -> Path:
    """Write another file with values at dotted keys (`axes.arm.port`, `solids.parts.0.size_mm`) replaced."""

    def change(tree: Any) -> None:
        for key, value in values.items():
            *way, last = [int(part) if part.isdigit() else part for part in key.split(".")]
            node = tree
            for part in way:
                node = node[part]
            node[last] = value

    return change_yaml(path, change, to)


def write_rig(configs: Path, path: Path, top: dict | None = None, **simulator: object) -> Path:
    """Write the simulated rig: small frames, a fast clock, no settling; keywords change its `simulator` section."""
    rigs, asked = configs / "rigs", repr((configs, top, simulator))

    def change(rig: Any) -> None:
        rig["simulator"].update({"rows": 64, "columns": 80, "clock_speed": 50, "camera_wait_s": 60} | simulator)
        rig.update({"settle_s": 0.0} | (top or {}))
        for mode in rig["modes"].values():
            mode["instrument"] = str((rigs / mode["instrument"]).resolve())
        samples = rig["simulator"]["samples"]
        samples.update({name: str((rigs / scene).resolve()) for name, scene in samples.items()})

    if asked in _RIGS:
        path.write_text(_RIGS[asked])
    else:
        _RIGS[asked] = change_yaml(rigs / "simulated.yaml", change, to=path).read_text()
    return path
