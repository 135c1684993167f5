"""A copy of an instrument file with fitted values put in; comments stay."""

from __future__ import annotations

from collections.abc import Mapping
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from processing.calibration.train import FittedValues
from processing.calibration.train_values import belongs_to
from processing.whole_file import write_new_text


def write_fitted(source: Path, target: Path, fitted: Mapping[float, FittedValues], note: str) -> None:
    """Copy an instrument file with the values fitted at some wavelengths put in; comments stay. Never overwrites.

    Raises
    ------
    ProcessError : `target` exists.
    """
    yaml = YAML()
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.width = 120
    tree = yaml.load(source.read_text(encoding="utf-8"))
    for wavelength_nm, calibration in sorted(fitted.items()):
        for name, value, stderr in zip(calibration.names, calibration.values, calibration.stderr, strict=True):
            element, _, field = name.rpartition(".")
            node = _node(tree, element)
            digits = 1 - int(np.floor(np.log10(stderr))) if stderr > 0 else 6
            number = round(float(value), max(digits, 0))
            mounted = belongs_to(calibration.model, name) == "mechanics"
            if len(fitted) > 1 and not mounted and not isinstance(node.get(field), dict):
                node[field] = {}
            if isinstance(node.get(field), dict):
                node[field][_key(node[field], wavelength_nm)] = number
            else:
                node[field] = number
        listed = tree.get("wavelengths_nm")
        if listed is not None and _key(listed, wavelength_nm) not in listed:
            listed.append(wavelength_nm)
    tree["source"] = note
    text = StringIO()
    yaml.dump(tree, text)
    write_new_text(target, text.getvalue())


def _key(known: Any, wavelength_nm: float) -> float:
    """The entry that means this wavelength, else the wavelength itself."""
    return next((k for k in known if abs(float(k) - wavelength_nm) < 0.5), wavelength_nm)


def _node(tree: Any, element: str) -> Any:
    trains = [tree.get("generator") or [], tree.get("analyzer") or []]
    trains += [c.get("elements") or [] for c in tree.get("channels") or []]
    return next(node for train in trains for node in train if node.get("name") == element)
