"""Fit parameters of an instrument's trains to a capture of a known sample.

The sample is known up to one throughput for each pixel, so the throughput is eliminated: for every trial of the
parameters it has its least-squares value (variable projection), and only the train's parameters are searched. Captures
at several wavelengths are fitted at once: what a mount does is the same in all of them, what a plate does is not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import StringIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ruamel.yaml import YAML
from scipy.optimize import least_squares

from processing.errors import NotDetermined, ProcessError
from processing.instrument.applied_effects import changes_at
from processing.instrument.model import Element, InstrumentModel
from processing.polarization import mueller
from processing.reduction.counts_to_signal import Correction
from processing.reduction.flat import FEW
from processing.reduction.mueller import relative_exposure
from processing.reduction.sample_states import sample_states
from processing.storage.capture import Capture
from processing.storage.capture_schema import Sample

#: Fields of an element that can be fitted, with the size of a sensible step and the bounds.
FITTABLE = {
    "azimuth_deg": (1.0, -np.inf, np.inf),
    "retardance_deg": (1.0, -np.inf, np.inf),
    "extinction": (0.01, 0.0, 1.0),
    "diattenuation": (0.01, -1.0, 1.0),
    "t_max": (0.01, 0.0, np.inf),
    "t_min": (0.01, 0.0, np.inf),
    "ratio": (0.001, -np.inf, np.inf),
}
#: Fields that belong to a mount, unless the instrument's `belongs_to` says otherwise: by how much they differ from the
#: file is the same at every wavelength.
MECHANICAL = ("azimuth_deg", "ratio")
#: A residual above this part of the mean signal is no fit.
POOR_FIT = 0.05
#: Other starts turn at most this many azimuths by 45 degrees.
MOST_TURNED = 5
#: Parameter directions with a singular value below this, relative to the largest, are not determined.
UNSEEN = 1e-7


class CalibrationError(ProcessError):
    """A calibration was asked for that cannot be made."""


@dataclass(frozen=True)
class Calibration:
    """Result of a fit.

    Attributes
    ----------
    names : of the free parameters, "element.field".
    values, stderr : (K,), in the unit of each field (degrees for angles).
    covariance : (K, K); scaled with the residual, because noise alone rarely explains it.
    residual_over_mean : rms of the residual over the mean signal.
    residual : (N, channels) relative to the mean signal.
    model : the instrument model with the fitted values.
    """

    names: tuple[str, ...]
    values: NDArray[np.float64]
    stderr: NDArray[np.float64]
    covariance: NDArray[np.float64]
    residual_over_mean: float
    residual: NDArray[np.float64]
    model: InstrumentModel


def known_mueller(sample: Sample) -> NDArray[np.float64]:
    """Mueller matrix (4, 4) of a known sample, up to its throughput; CalibrationError for an unknown one."""
    if sample.kind == "air":
        return np.eye(4)
    if sample.kind == "mirror":
        return mueller.IDEAL_MIRROR
    if sample.kind == "mueller" and sample.mueller is not None:
        return np.asarray(sample.mueller, dtype=float).reshape(4, 4)
    raise CalibrationError(
        "the sample of this capture is not known, and retardances cannot be told from an unknown sample "
        "(docs/conventions.md). Capture air or a mirror, or import with --sample."
    )


def region_means(capture: Capture, rows: slice, columns: slice) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Mean signal (N, channels) of a region, black subtracted, and the states of the sample that it belongs to.

    States in which the region saturates are left out.
    """
    correction = Correction.of(capture)
    black = correction.black
    means_of_dark = black.means if black.means.shape[2] == 1 else black.means[:, :, rows, columns]
    means, used = [], []
    for k in sample_states(capture):
        frame = capture.frames(int(k), rows)[:, :, columns]
        if correction.saturation is None or np.mean(frame >= correction.saturation) <= FEW:
            means.append(frame.mean(axis=(1, 2)))
            used.append(int(k))
    if not means:
        raise CalibrationError(f"{capture.path}: the region is saturated in every state; take less exposure.")
    if means[0].size == 0 or not np.all(np.isfinite(means)):
        raise CalibrationError(f"{capture.path}: the region holds no pixels, or no numbers; choose another one.")
    share = black.weights(capture.column("exposure_s")[used].astype(float))
    return np.asarray(means) - np.asarray(share @ means_of_dark.mean(axis=(2, 3))), np.array(used)


@dataclass(frozen=True)
class Part:
    """One capture of a joint fit.

    Attributes
    ----------
    model : resolved at the wavelength of the capture.
    angles_deg : axis name to (N,), as read back.
    signal : (N, channels) counts above black, or (N, channels, pixels): one throughput for each pixel.
    sample : (4, 4) up to a factor.
    exposure : (N,) relative, default 1.
    wavelength_nm : parts of one wavelength share all parameters.
    """

    model: InstrumentModel
    angles_deg: dict[str, NDArray[np.float64]]
    signal: NDArray[np.float64]
    sample: NDArray[np.float64]
    exposure: NDArray[np.float64] | None = None
    wavelength_nm: float = 0.0

    @property
    def data(self) -> NDArray[np.float64]:
        """(N * channels, pixels)."""
        return self.signal.reshape(self.signal.shape[0] * self.signal.shape[1], -1)

    def residual(self, model: InstrumentModel) -> NDArray[np.float64]:
        """(N * channels * pixels,), over the mean signal, with the best throughput of each pixel."""
        weight = np.ones(self.signal.shape[0]) if self.exposure is None else self.exposure
        w = model.rows(self.angles_deg, changes_at(model, self.angles_deg)) * weight[:, None, None]
        shape = w.reshape(-1, 16) @ self.sample.reshape(16)
        throughput = shape @ self.data / (shape @ shape)
        return np.asarray((self.data - shape[:, None] * throughput).reshape(-1) / np.mean(self.data))


def fit_trains(parts: Sequence[Part], free: Sequence[str]) -> list[Calibration]:
    """Fit the free parameters to signals of known samples; the search starts from the values of the models.

    Parameters
    ----------
    free : "element.field", fields as in FITTABLE. Those of a mount (MECHANICAL, or `belongs_to` of the instrument)
        change by the same amount in all parts, the others take a value of their own at each wavelength.

    Returns
    -------
    One for each part, in their order.

    Raises
    ------
    CalibrationError : an unknown parameter, or fewer data than parameters.
    NotDetermined : the data leave a combination of parameters open; the message names them.
    """
    names = _checked(parts[0].model, free)
    mounted = np.array([_is_mounted(parts[0].model, name) for name in names])
    # What is searched: a name with its wavelength, or for all of them.
    wanted = [
        [(name, None if shared else part.wavelength_nm) for name, shared in zip(names, mounted, strict=True)]
        for part in parts
    ]
    unknown = list(dict.fromkeys(key for keys in wanted for key in keys))
    where = [np.array([unknown.index(key) for key in keys]) for keys in wanted]
    throughputs = sum(part.data.shape[1] for part in parts)
    size = sum(part.data.size for part in parts)
    if size <= len(unknown) + throughputs:
        raise CalibrationError(f"{size} intensities cannot fix {len(unknown)} parameters and the throughput")
    nominal = [np.array([_value(part.model, name) for name in names]) for part in parts]
    # Of a mount the change is searched, from 0; of a plate the value.
    base = [np.where(mounted, values, 0.0) for values in nominal]
    start = np.zeros(len(unknown))
    for index, values, own in zip(where, nominal, base, strict=True):
        start[index] = values - own
    step = np.array([FITTABLE[name.rpartition(".")[2]][0] for name, _ in unknown])
    lower, upper = np.array([FITTABLE[name.rpartition(".")[2]][1:] for name, _ in unknown]).T

    def residual(x: NDArray[np.float64]) -> NDArray[np.float64]:
        tried = (_with_values(p.model, names, b + x[i]) for p, b, i in zip(parts, base, where, strict=True))
        return np.concatenate([part.residual(model) for part, model in zip(parts, tried, strict=True)])

    def search(x0: NDArray[np.float64]) -> Any:
        inside = np.clip(x0, lower + 1e-9 * step, upper - 1e-9 * step)
        return least_squares(residual, inside, x_scale=step, bounds=(lower, upper), xtol=1e-12, ftol=1e-12)

    found = search(start)
    if np.sqrt(np.mean(found.fun**2)) > POOR_FIT:
        # Azimuths have several valleys; a residual like this is the bottom of a wrong one.
        others = _other_starts([name for name, _ in unknown], start)
        found = min([found, *(search(x0) for x0 in others)], key=lambda f: float(f.cost))
    if not found.success:
        raise NotDetermined(
            f"the fit did not converge ({found.message}); start from an instrument file closer to the truth"
        )
    jacobian = found.jac * step
    _, singular, vt = np.linalg.svd(jacobian, full_matrices=False)
    if singular[-1] <= UNSEEN * singular[0]:
        open_ones = dict.fromkeys(unknown[k][0] for k in np.flatnonzero(np.abs(vt[-1]) > 0.1))
        raise NotDetermined(f"the data do not tell apart: {', '.join(open_ones)}. Hold one of them fixed.")
    freedom = size - throughputs - len(unknown)
    variance = float(np.sum(found.fun**2)) / max(freedom, 1)
    covariance = np.linalg.inv(jacobian.T @ jacobian) * variance * np.outer(step, step)
    left = np.split(found.fun, np.cumsum([part.data.size for part in parts])[:-1])
    return [
        Calibration(
            names=names,
            values=own + found.x[index],
            stderr=np.sqrt(np.diag(covariance))[index],
            covariance=covariance[np.ix_(index, index)],
            residual_over_mean=float(np.sqrt(np.mean(rest**2))),
            residual=rest.reshape(*part.signal.shape[:2], -1).mean(axis=2),
            model=_with_values(part.model, names, own + found.x[index]),
        )
        for part, own, index, rest in zip(parts, base, where, left, strict=True)
    ]


def part_of(capture: Capture, model: InstrumentModel, rows: slice, columns: slice) -> Part:
    """The region means of a capture of a known sample, for `fit_trains`; `model` is at its wavelength."""
    sample = known_mueller(capture.header.sample)
    signal, states = region_means(capture, rows, columns)
    angles = {name: values[states] for name, values in capture.angles_deg.items()}
    return Part(model, angles, signal, sample, relative_exposure(capture, states), capture.header.wavelength_nm)


def _is_mounted(model: InstrumentModel, name: str) -> bool:
    rule = "mechanics" if name.rpartition(".")[2] in MECHANICAL else "wavelength"
    return model.belongs_to.get(name, rule) == "mechanics"


def write_fitted(source: Path, target: Path, fitted: Mapping[float, Calibration], note: str) -> None:
    """Copy an instrument file with the values fitted at some wavelengths put in; comments stay. Never overwrites.

    Raises
    ------
    CalibrationError : `target` exists.
    """
    if target.exists():
        raise CalibrationError(f"{target} exists; a calibration never replaces a file. Give another --write.")
    yaml = YAML()
    yaml.indent(mapping=2, sequence=4, offset=2)
    yaml.width = 120
    tree = yaml.load(source.read_text(encoding="utf-8"))
    for wavelength_nm, calibration in fitted.items():
        for name, value, stderr in zip(calibration.names, calibration.values, calibration.stderr, strict=True):
            element, _, field = name.rpartition(".")
            node = _node(tree, element)
            digits = 1 - int(np.floor(np.log10(stderr))) if stderr > 0 else 6
            number = round(float(value), max(digits, 0))
            if len(fitted) > 1 and not _is_mounted(calibration.model, name) and not isinstance(node.get(field), dict):
                node[field] = {}
            if isinstance(node.get(field), dict):
                key = next((k for k in node[field] if abs(float(k) - wavelength_nm) < 0.5), wavelength_nm)
                node[field][key] = number
            else:
                node[field] = number
    tree["source"] = note
    text = StringIO()
    yaml.dump(tree, text)
    with target.open("x", encoding="utf-8") as file:
        file.write(text.getvalue())


def _checked(model: InstrumentModel, free: Sequence[str]) -> tuple[str, ...]:
    names = tuple(dict.fromkeys(name.strip() for name in free if name.strip()))
    offered = [f"{e.name}.{field}" for e in model.elements() for field in FITTABLE if _fits(e, field)]
    unknown = [name for name in names if name not in offered]
    if unknown or not names:
        asked = ", ".join(unknown) or "none given"
        raise CalibrationError(f"free parameter: {asked}. This instrument has: {', '.join(offered)}.")
    return names


def _other_starts(names: Sequence[str], start: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    azimuths = [k for k, name in enumerate(names) if name.endswith(".azimuth_deg")][:MOST_TURNED]
    starts = []
    for turned in product((0.0, 45.0), repeat=len(azimuths)):
        if any(turned):
            x0 = start.copy()
            x0[azimuths] += turned
            starts.append(x0)
    return starts


def _fits(element: Element, field: str) -> bool:
    return hasattr(element, field) and (field != "ratio" or element.axis is not None)


def _value(model: InstrumentModel, name: str) -> float:
    element, _, field = name.rpartition(".")
    return float(next(getattr(e, field) for e in model.elements() if e.name == element))


def _with_values(model: InstrumentModel, names: Sequence[str], values: NDArray[np.float64]) -> InstrumentModel:
    new = {name.rpartition(".")[0]: {} for name in names}  # type: dict[str, dict[str, float]]
    for name, value in zip(names, values, strict=True):
        element, _, field = name.rpartition(".")
        new[element][field] = float(value)

    def swap(elements: Sequence[Any]) -> tuple[Any, ...]:
        return tuple(e.model_copy(update=new[e.name]) if e.name in new else e for e in elements)

    channels = tuple(c.model_copy(update={"elements": swap(c.elements)}) for c in model.channels)
    update = {"generator": swap(model.generator), "analyzer": swap(model.analyzer), "channels": channels}
    return model.model_copy(update=update)


def _node(tree: Any, element: str) -> Any:
    trains = [tree.get("generator") or [], tree.get("analyzer") or []]
    trains += [c.get("elements") or [] for c in tree.get("channels") or []]
    return next(node for train in trains for node in train if node.get("name") == element)
