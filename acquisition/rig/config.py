"""The rig file: devices and ports, forbidden poses, and devices that the simulator replaces."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Self

from pydantic import ModelWrapValidatorHandler, TypeAdapter, ValidationError, model_validator
from pydantic_core import InitErrorDetails, PydanticCustomError

from acquisition.rig.sections import AxisEntry, RigSections
from acquisition.rig.soundness import find_mistakes
from drivers.clock import REAL, Clock
from processing.yaml_file import ConfigError, load_yaml
from processing.yaml_words import mistakes_of, names_in, words_of
from simulators.clock import patient_clock
from simulators.rig.model import SCHEME


class RigConfig(RigSections):
    """A rig whose sections fit together. Relative paths are relative to the rig file.

    Examples
    --------
    >>> from acquisition import load_rig
    >>> rig = load_rig("rig.yaml")
    >>> rig.name, sorted(rig.modes), rig.simulator is not None
    ('simulated RGB950', ['drr', 'stokes'], True)
    """

    @model_validator(mode="wrap")
    @classmethod
    def _report_all_mistakes(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        # References between sections are checked even if a section cannot be read.
        mistakes: list[tuple[tuple[int | str, ...], str, str]] = []
        rig: RigConfig
        try:
            rig = valid = handler(data)
        except ValidationError as error:
            if not isinstance(data, dict):
                raise
            rig, valid = _readable(data), None
            mistakes = [(e["loc"], words_of(e, names_in(cls)), e["type"]) for e in mistakes_of(error)]
        mistakes += [(where, why, "rig") for where, why in find_mistakes(rig)]
        if valid is None or mistakes:
            raise ValidationError.from_exception_data(cls.__name__, [_details(*mistake) for mistake in mistakes])
        return valid

    def named_states(self) -> dict[str, Mapping[str, float]]:
        """For each axis that has names for its positions, these."""
        return {name: named for name, entry in self.axes.items() if (named := entry.named_states())}

    @property
    def seed(self) -> int | None:
        """Seed of the simulated noise; None for a real rig."""
        return self.simulator.seed if self.simulator else None

    def with_seed(self, seed: int | None) -> "RigConfig":
        """The rig with another seed of its simulated noise. Raises ConfigError for a real rig."""
        if seed is None:
            return self
        if not 0 <= seed < 1 << 63:
            raise ConfigError(f"--seed {seed}: a seed is a whole number from 0 to 2^63")
        if self.simulator is None:
            raise ConfigError(f"--seed {seed}: rig {self.name!r} has no simulator, its noise has no seed")
        return self.model_copy(update={"simulator": self.simulator.model_copy(update={"seed": seed})})

    @property
    def sample_names(self) -> list[str] | None:
        """Names of the samples that the rig can show; None where an operator places any sample."""
        return sorted(self.simulator.samples) if self.simulator else None

    def bench_files(self, samples: Iterable[str] | None) -> Iterator[tuple[str, Path, Callable[[Path], object]]]:
        """Title, path and reader of each file that an emulated bench needs for these samples, or for all (None)."""
        return self.simulator.files(samples) if self.simulator else iter(())

    @model_validator(mode="after")
    def _own_emulators_are_simulated(self) -> Self:
        # A rig with emulators of its own cannot be declared real.
        if self.simulator is not None and not self.simulated:
            object.__setattr__(self, "simulated", True)
        return self


def clock_of(config: RigConfig) -> Clock:
    """The clock of a rig: real devices keep real time, emulators may be kept from running."""
    return patient_clock() if config.simulated else REAL


def has_own_emulators(config: RigConfig) -> bool:
    """True for a rig whose axes exist only inside the command that opened it."""
    return any(entry.port.startswith(SCHEME) for entry in config.axes.values())


def _readable(data: dict[str, Any]) -> RigConfig:
    """The sections of a rig file that can be read for themselves; the others have their defaults."""
    sections: dict[str, Any] = {"modes": {}, "wavelengths_nm": ()}
    for name, field in RigConfig.model_fields.items():
        with contextlib.suppress(ValidationError):
            if name in data and name != "axes":
                sections[name] = TypeAdapter[Any](field.annotation).validate_python(data[name])  # type: ignore[arg-type]
    axes = data.get("axes")
    sections["axes"] = {}
    for name, entry in axes.items() if isinstance(axes, dict) else ():
        if not isinstance(name, str):
            continue
        try:
            sections["axes"][name] = TypeAdapter(AxisEntry).validate_python(entry)
        except ValidationError:
            # Its name is known nevertheless.
            sections["axes"][name] = None
    return RigConfig.model_construct(**sections)


def _details(where: tuple[int | str, ...], why: str, kind: str) -> InitErrorDetails:
    """A mistake in words that stay as they are; its kind says whether its place stands in the file."""
    words = PydanticCustomError(kind, "{words}", {"words": why})
    return InitErrorDetails(type=words, loc=where, input=None)


def load_rig(path: Path | str) -> RigConfig:
    """Read a rig file; its relative paths become absolute.

    Parameters
    ----------
    path : path or str

    Returns
    -------
    RigConfig

    Raises
    ------
    ConfigError
        The file cannot be read, or does not fit; the message has file, line and key.

    Examples
    --------
    >>> from acquisition import load_rig
    >>> load_rig("rig.yaml").axes["arm"].kind
    'smc100'
    """
    path = Path(path)
    rig = load_yaml(path, RigConfig)
    folder = path.resolve().parent
    modes = {name: mode.model_copy(update={"instrument": folder / mode.instrument}) for name, mode in rig.modes.items()}
    simulator = rig.simulator.below(folder) if rig.simulator else None
    wire_log = folder / rig.wire_log if rig.wire_log else None
    if wire_log is not None and wire_log.exists() and not wire_log.is_dir():
        raise ConfigError(f"{path}: wire_log: {wire_log} is a file; it must be a folder")
    return rig.model_copy(update={"modes": modes, "simulator": simulator, "wire_log": wire_log})
