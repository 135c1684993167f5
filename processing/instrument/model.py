"""Instrument models: two optical trains, a detector, and one row of W for each state and channel.

Any rotating-element polarimeter is a YAML file: a generator train and an analyzer train of elements, each
fixed or turned by a named axis, and one or more detector channels (docs/conventions.md, "Instrument").
"""

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, field_validator, model_validator

from processing.arrays import Array
from processing.instrument.changes import OF_MATRICES, OF_TRAINS, Changes
from processing.instrument.elements import AnyElement, Stated, number
from processing.instrument.elements import Dispersive as Dispersive
from processing.instrument.elements import Element as Element
from processing.instrument.elements import Polarizer as Polarizer
from processing.instrument.elements import Retarder as Retarder
from processing.instrument.elements import WavelengthError as WavelengthError
from processing.instrument.fitted import AppliedEffect as AppliedEffect
from processing.instrument.fitted import EffectParameter as EffectParameter
from processing.instrument.fitted import SystematicError as SystematicError
from processing.instrument.measured_matrix import MeasuredMatrix
from processing.instrument.stated_uncertainty import TRAINS, Correlation, split_uncertainties
from processing.section import Section
from processing.yaml_file import load_yaml

#: What fitted values belong to: mounts and mechanics, the same in all captures; the detector, the same as long as its
#: full scale is; optics that follow a smooth curve over the wavelengths; optics with a value at each wavelength that
#: has nothing to do with the next one; one capture alone.
Belongs = Literal["mechanics", "detector", "dispersion", "wavelength", "capture"]


class Channel(Section):
    """One detector channel: the elements that only its light passes, after the common analyzer train."""

    name: str = Field(description="name that messages and other files use")
    elements: tuple[AnyElement, ...] = Field(
        default=(), description="elements that only this channel's light passes, after the analyzer"
    )
    gain: Stated = Field(default=1.0, description="response relative to the other channels")

    @field_validator("gain")
    @classmethod
    def _is_positive(cls, gain: Dispersive) -> Dispersive:
        if min(gain.values() if isinstance(gain, dict) else [gain]) <= 0:
            raise ValueError("the gain of a channel must be above 0")
        return gain


class InstrumentModel(Section):
    """Generator train, analyzer train and detector channels, in the order in which the light passes them.

    `mosaic`, for a division-of-focal-plane sensor, lays out the channel names over the super-pixel, row by
    row from the top left, e.g. (("90", "45"), ("135", "0")).
    `measured` holds W itself, for instruments that no train of elements describes; then there are no elements.
    `beams` names the channels whose images lie side by side on one detector, in equal parts of its columns.
    `calibrate` names values ("element.field", "channel.gain") that are only nominal: `diagnose` fits them to captures
    of known samples.
    An effect of scope "capture" holds for the captures that it names and for no other.
    `belongs_to` says of such values, and of kinds of effects, what they belong to where that is not the rule: a
    spectrograph sees one run of the axes at all wavelengths (`rotation_slip: mechanics`), the axis of an achromatic
    plate turns with the wavelength (`plate.azimuth_deg: dispersion`).
    `stderr` holds standard uncertainties of values, by the names that `calibrate` has; a file may state them with the
    values, as {value: ..., u: ...}. `correlations` are between them.
    `systematic` is what `diagnose` leaves uncertain. `process reduce` carries both into its error bars.
    Where two channels or more see one source, its level in each state is projected out; `free_source: false` says
    that it has the same level in all states.

    Examples
    --------
    >>> model = InstrumentModel.load("instrument.yaml").at(662)
    >>> model.axes, model.rows({"psg": [0, 9], "psa": [0, 45]}).shape
    (('psa', 'psg'), (2, 1, 16))
    """

    kind: Literal["instrument"] = "instrument"
    name: str = Field(description="name that messages and other files use")
    source: str | None = Field(
        default=None, description="Stokes vector of the source, S0 first; unpolarized without it"
    )
    wavelengths_nm: tuple[float, ...] | None = Field(
        default=None, description="wavelengths that the numbers are given for, nm"
    )
    generator: tuple[AnyElement, ...] = Field(
        description="elements between source and sample, in the order of the light"
    )
    analyzer: tuple[AnyElement, ...] = Field(
        description="elements between sample and detector, in the order of the light"
    )
    channels: tuple[Channel, ...] = Field(
        default=(Channel(name="camera"),),
        description="detector channels, each with the elements that its light alone passes",
    )
    measured: MeasuredMatrix | None = Field(
        default=None, description="W that was measured as a whole, instead of generator and analyzer"
    )
    mosaic: tuple[tuple[str, ...], ...] | None = Field(
        default=None, description="names of the channels over the super-pixel of a polarization camera"
    )
    beams: tuple[str, ...] | None = Field(
        default=None, description="where the channels lie on a sensor that sees several beams"
    )
    calibrate: tuple[str, ...] = Field(
        default=(), description="values that are only nominal: `diagnose` fits them to captures of known samples"
    )
    belongs_to: dict[str, Belongs] = Field(
        default={}, description="which captures share a value of `calibrate` or the values of a kind of effect"
    )
    free_source: bool | None = Field(default=None, description="false: the source has one level in all states")
    stderr: dict[str, Dispersive] = Field(
        default={}, description="standard uncertainties of values; or write a value as {value: ..., u: ...}"
    )
    effects: tuple[AppliedEffect, ...] = Field(
        default=(), description="faults that were found and are corrected for, as `diagnose --write` adds them"
    )
    systematic: tuple[SystematicError, ...] = Field(default=(), description="what stays uncertain after the correction")
    correlations: tuple[Correlation, ...] = Field(
        default=(), description="between standard uncertainties, as `process calibrate --write` adds them"
    )

    @model_validator(mode="before")
    @classmethod
    def _take_uncertainties(cls, data: Any) -> Any:
        if not isinstance(data, Mapping):
            return data
        if data.get("measured") is not None:
            data = {"generator": (), "analyzer": ()} | dict(data)
        errors: dict[str, Any] = {}
        plain = {key: split_uncertainties(node, errors) if key in TRAINS else node for key, node in data.items()}
        stated = plain.get("stderr") or {}
        if not errors or not isinstance(stated, Mapping):
            return plain
        return plain | {"stderr": {**stated, **errors}}

    @field_validator("stderr")
    @classmethod
    def _are_sizes(cls, stderr: dict[str, Dispersive]) -> dict[str, Dispersive]:
        for name, u in stderr.items():
            if not min(u.values() if isinstance(u, dict) else [u], default=0.0) >= 0:
                raise ValueError(f"the standard uncertainty of {name!r} must be 0 or more")
        return stderr

    @model_validator(mode="after")
    def _names_are_unique(self) -> Self:
        names = [e.name for e in self.elements()]
        twice = sorted({n for n in names if names.count(n) > 1})
        if twice:
            raise ValueError(f"element names must be unique; used twice: {', '.join(twice)}")
        channels = [c.name for c in self.channels]
        if len(set(channels)) != len(channels):
            raise ValueError("channel names must be unique")
        if self.measured is not None and (names or len(self.measured.rows) != self.measured.states * len(channels)):
            raise ValueError("a measured W has no elements, and one row for each state and channel")
        if self.free_source and len(channels) < 2:
            raise ValueError("free_source needs two channels or more: with one, nothing is left over")
        if self.mosaic is not None and sorted(n for row in self.mosaic for n in row) != sorted(channels):
            raise ValueError("the mosaic must name each channel exactly once")
        if self.beams is not None and (self.mosaic is not None or self.beams != tuple(channels)):
            raise ValueError("beams must name the channels in their order, and there is no mosaic beside them")
        return self

    @classmethod
    def load(cls, path: Path | str) -> "InstrumentModel":
        """Read an instrument file. Raises ConfigError with file, line and key."""
        return load_yaml(path, cls)

    @property
    def identity(self) -> str:
        """Name and a checksum of everything stated: two instruments whose values have equal names are two."""
        stated = self.model_dump_json(exclude={"wavelengths_nm"}, exclude_defaults=True)
        return f"{self.name.replace(';', ',')} {hashlib.sha256(stated.encode()).hexdigest()[:6]}"

    @property
    def projects_source(self) -> bool:
        """Whether the level of the source in each state is projected out: two channels or more see one source.

        Where nothing turns all states are alike, and a level is a part of the throughput.
        """
        return len(self.channels) > 1 and bool(self.axes) if self.free_source is None else self.free_source

    @property
    def pitch(self) -> int:
        """Pixels of the sensor from one pixel to the next behind the same polarizer; 1 without a mosaic."""
        return len(self.mosaic) if self.mosaic else 1

    def elements(self) -> tuple[AnyElement, ...]:
        """All elements: generator, analyzer, then those of the channels."""
        return (*self.generator, *self.analyzer, *(e for c in self.channels for e in c.elements))

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes that turn elements, or that tell the states of a measured W apart, sorted."""
        if self.measured is not None:
            return tuple(sorted(self.measured.angles_deg))
        return tuple(sorted({e.axis for e in self.elements() if e.axis is not None}))

    def at(self, wavelength_nm: float) -> "InstrumentModel":
        """The model with every dispersive value resolved at one wavelength.

        Raises
        ------
        WavelengthError
            A value, or the whole model, is not given at this wavelength. Nothing is interpolated.
        """
        if self.wavelengths_nm is not None and not _listed(wavelength_nm, self.wavelengths_nm):
            raise WavelengthError(
                f"instrument {self.name!r} is given at {_listing(self.wavelengths_nm)} nm; "
                f"asked for {wavelength_nm:g} nm. Use an instrument file that has it."
            )
        fields = self.model_dump()
        fields["stderr"] = {
            name: error
            for name, error in fields["stderr"].items()
            if not isinstance(error, dict) or _listed(wavelength_nm, tuple(error))
        }
        resolved = _resolve(fields, wavelength_nm, self.name)

        def holds(effect: dict[str, Any]) -> bool:
            # What was found at one wavelength is not carried over to another, unless it belongs to none.
            return effect["wavelength_nm"] is None or _listed(wavelength_nm, [effect["wavelength_nm"]])

        resolved["effects"] = [e for e in resolved["effects"] if holds(e)]
        resolved["systematic"] = [
            s | {"directions": [[e for e in d if holds(e)] for d in s["directions"]]}
            for s in resolved["systematic"]
            if holds(s)
        ]
        resolved["correlations"] = [c for c in resolved["correlations"] if holds(c)]
        return InstrumentModel.model_validate(resolved | {"wavelengths_nm": (wavelength_nm,)})

    def nominal_at(self, wavelength_nm: float) -> "InstrumentModel":
        """`at`, where values that are nominal anyway (`calibrate`) come from the nearest wavelengths that have them.

        For whoever fits them: between two wavelengths a straight line, beyond the last one its value.
        """
        values: dict[str, dict[str, Dispersive]] = {}
        for name in self.calibrate:
            element, _, field = name.rpartition(".")
            value = self.value_of(name)
            if isinstance(value, dict) and not _listed(wavelength_nm, tuple(value)):
                nodes = sorted(value)
                near = float(np.interp(wavelength_nm, nodes, [value[k] for k in nodes]))
                values.setdefault(element, {})[field] = {**value, wavelength_nm: near}
        return self.with_values(values).at(wavelength_nm)

    def value_of(self, name: str) -> Dispersive | None:
        """The value "element.field", or "channel.gain"; None where this instrument has none of that name."""
        place, _, field = name.rpartition(".")
        parts = self.channels if field == "gain" else self.elements()
        return next((getattr(p, field, None) for p in parts if p.name == place), None)

    def with_values(self, values: Mapping[str, Mapping[str, Any]]) -> "InstrumentModel":
        """The model with other values of its elements and channels: name to field to value."""

        def new(name: str, *, gain: bool) -> dict[str, Any]:
            return {field: value for field, value in values.get(name, {}).items() if (field == "gain") == gain}

        def swap(elements: tuple[AnyElement, ...]) -> tuple[AnyElement, ...]:
            return tuple(e.model_copy(update=new(e.name, gain=False)) for e in elements)

        channels = tuple(
            c.model_copy(update={"elements": swap(c.elements)} | new(c.name, gain=True)) for c in self.channels
        )
        update = {"generator": swap(self.generator), "analyzer": swap(self.analyzer), "channels": channels}
        return self.model_copy(update=update)

    def generator_states(self, angles_deg: Mapping[str, ArrayLike], changes: Changes | None = None) -> Array:
        """Stokes vectors g (states, 4): first column of the generator train's Mueller matrix."""
        n = _state_count(angles_deg, changes)

        def states() -> Array:
            stokes = np.zeros((n, 4))
            stokes[:, 0] = 1.0
            for element in self.generator:
                stokes = np.einsum("nij,nj->ni", _matrices(element, angles_deg, n, changes), stokes)
            return stokes

        names = [e.name for e in self.generator]
        return states() if changes is None else changes.once("generator", names, OF_TRAINS, states)

    def analyzer_states(self, angles_deg: Mapping[str, ArrayLike], changes: Changes | None = None) -> Array:
        """Analyzer vectors a (states, channels, 4): first row of each channel's train."""
        n = _state_count(angles_deg, changes)

        def states() -> Array:
            common = [_matrices(e, angles_deg, n, changes) for e in self.analyzer]
            vectors = np.empty((n, len(self.channels), 4))
            for k, channel in enumerate(self.channels):
                matrices = [_matrices(e, angles_deg, n, changes) for e in channel.elements]
                row = np.zeros((n, 4))
                row[:, 0] = number(channel.gain)
                for matrix in reversed(common + matrices):
                    row = np.einsum("ni,nij->nj", row, matrix)
                vectors[:, k] = row
            return vectors

        names = [e.name for train in (self.analyzer, *(c.elements for c in self.channels)) for e in train]
        return states() if changes is None else changes.once("analyzer", names, OF_TRAINS, states)

    def rows(self, angles_deg: Mapping[str, ArrayLike], changes: Changes | None = None) -> Array:
        """Measurement matrix W (states, channels, 16): row = kron(a, g), so that P = W . vec(M), row-major.

        The model must be resolved at a wavelength (`at`). Angles are those read back, in degrees. `changes` is
        what effects do (`processing.instrument.applied_effects`); only a model without effects needs none.

        Raises
        ------
        ValueError
            The model has effects, and nobody said what they change.
        """
        if changes is None and self.effects:
            raise ValueError(f"instrument {self.name!r} has effects: rows() needs the changes that they make")
        if self.measured is not None:
            w = self.measured.at(angles_deg)
            return w if changes is None else _detected(w, changes)
        g = self.generator_states(angles_deg, changes)
        a = self.analyzer_states(angles_deg, changes)
        w = np.asarray((a[..., :, None] * g[:, None, None, :]).reshape(*a.shape[:2], 16))
        return w if changes is None else _detected(w, changes)


def rank(w: ArrayLike) -> int:
    """Numerical rank of W (any leading shape, 16), relative tolerance 1e-8."""
    return int(np.linalg.matrix_rank(np.asarray(w, dtype=float).reshape(-1, 16), rtol=1e-8))


def _matrices(element: Element, angles_deg: Mapping[str, ArrayLike], states: int, changes: Changes | None) -> Array:
    def matrices() -> Array:
        azimuth = element.azimuth_rad(angles_deg, states)
        if changes is not None and element.name in changes.azimuth_rad:
            azimuth = azimuth + changes.azimuth_rad[element.name]
        return element.mueller(azimuth, changes)

    if changes is None:
        return matrices()
    matrix = changes.once(element.name, [element.name], OF_MATRICES, matrices)
    if element.name in changes.before:
        matrix = matrix @ changes.before[element.name]
    return changes.after[element.name] @ matrix if element.name in changes.after else matrix


def _detected(w: Array, changes: Changes) -> Array:
    if changes.stray if isinstance(changes.stray, float) else np.any(changes.stray):
        # Light that no element modulates: the same for every state, as strong as the fraction of the mean signal.
        w = w.copy()
        w[..., 0] += np.reshape(changes.stray, (-1, 1)) * float(np.mean(w[..., 0]))
    if changes.mixing is not None:
        w = np.einsum("ck,nkj->ncj", changes.mixing, w)
    w = w * changes.gain[..., None]
    if changes.lag:
        # What was before the first state is not known: as if it had been the same.
        w = w + changes.lag * (np.concatenate([w[:1], w[:-1]]) - w)
    return np.asarray(w)


def _state_count(angles_deg: Mapping[str, ArrayLike], changes: Changes | None) -> int:
    # Where nothing turns, only what changes from state to state tells how many there are.
    counts = {np.size(v) for v in angles_deg.values()} or {1 if changes is None else changes.conditions.states}
    if len(counts) != 1:
        raise ValueError(f"every axis needs one angle a state; got {sorted(counts)}")
    return counts.pop()


def _listed(wavelength_nm: float, wavelengths: Sequence[float]) -> bool:
    return any(abs(wavelength_nm - k) < 0.5 for k in wavelengths)


def _listing(values: Sequence[float]) -> str:
    return ", ".join(f"{v:g}" for v in values)


def _resolve(node: Any, wavelength_nm: float, name: str) -> Any:
    # A mapping with numeric keys can only be a dispersive value.
    if isinstance(node, dict):
        if node and all(isinstance(k, float | int) for k in node):
            for key, value in node.items():
                if abs(key - wavelength_nm) < 0.5:
                    return value
            raise WavelengthError(
                f"instrument {name!r} has a value given at {_listing(list(node))} nm but not at {wavelength_nm:g} nm"
            )
        return {k: _resolve(v, wavelength_nm, name) for k, v in node.items()}
    if isinstance(node, list | tuple):
        return [_resolve(v, wavelength_nm, name) for v in node]
    return node


InstrumentModel.model_rebuild()
