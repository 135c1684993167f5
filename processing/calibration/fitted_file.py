"""A copy of an instrument file with fitted values and their standard uncertainties put in; comments stay."""

from collections.abc import Mapping, Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap

from processing.calibration.train import FittedValues
from processing.calibration.train_values import belongs_to
from processing.whole_file import write_new_text


def write_fitted(source: Path, target: Path, fitted: Mapping[float, FittedValues], note: str) -> None:
    """Copy an instrument file with the values fitted at some wavelengths put in; comments stay. Never overwrites.

    Raises ProcessError: `target` exists.
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
            digits = max(digits, 0)
            number = CommentedMap({"value": round(float(value), digits), "u": round(float(stderr), digits)})
            number.fa.set_flow_style()
            mounted = belongs_to(calibration.model, name) == "mechanics"
            by_wavelength = isinstance(node.get(field), dict) and "value" not in node[field]
            if len(fitted) > 1 and not mounted and not by_wavelength:
                node[field], by_wavelength = {}, True
            if by_wavelength:
                node[field][_key(node[field], wavelength_nm)] = number
            else:
                node[field] = number
        _forget(tree, calibration.names, wavelength_nm)
        if len(calibration.names) > 1:
            _correlate(tree, calibration, wavelength_nm)
        listed = tree.get("wavelengths_nm")
        if listed is not None and _key(listed, wavelength_nm) not in listed:
            listed.append(wavelength_nm)
    tree["source"] = note
    text = StringIO()
    yaml.dump(tree, text)
    write_new_text(target, text.getvalue())


def _forget(tree: Any, names: Sequence[str], wavelength_nm: float) -> None:
    """Take out what the file held of the uncertainty of values that are fitted now."""
    for name in names:
        old = (tree.get("stderr") or {}).get(name)
        if isinstance(old, dict):
            old.pop(_key(old, wavelength_nm), None)
        elif old is not None:
            del tree["stderr"][name]
    correlations = [
        c
        for c in tree.get("correlations") or []
        if not set(names) & set(c["between"]) or abs(float(c.get("wavelength_nm") or 0) - wavelength_nm) >= 0.5
    ]
    if correlations or "correlations" in tree:
        tree["correlations"] = correlations


def _correlate(tree: Any, fitted: FittedValues, wavelength_nm: float) -> None:
    sigma = np.where(fitted.stderr > 0, fitted.stderr, 1.0)
    below = (fitted.covariance / np.outer(sigma, sigma))[np.tril_indices(len(sigma), -1)]
    entry = CommentedMap(
        between=list(fitted.names), coefficients=[round(float(r), 5) for r in below], wavelength_nm=wavelength_nm
    )
    entry.fa.set_flow_style()
    tree["correlations"] = [*(tree.get("correlations") or []), entry]


def _key(entries: Any, wavelength_nm: float) -> float:
    """The entry that means this wavelength, else the wavelength itself."""
    return next((k for k in entries if abs(float(k) - wavelength_nm) < 0.5), wavelength_nm)


def _node(tree: Any, element: str) -> Any:
    trains = [tree.get("generator") or [], tree.get("analyzer") or []]
    trains += [c.get("elements") or [] for c in tree.get("channels") or []]
    return next(node for train in trains for node in train if node.get("name") == element)
