"""Write the instrument model with the effects that were found: `diagnose --write`."""

from pathlib import Path

from processing.diagnosis.search.result import Diagnosis
from processing.errors import ProcessError
from processing.instrument.model import Dispersive, EffectParameter, InstrumentModel
from processing.reduction.flat import SAME_NM
from processing.whole_file import write_new_text
from processing.yaml_file import ConfigError, dump_yaml, parse_yaml


class WriteError(ProcessError):
    """The new instrument file cannot be written."""


def extend_model(model: InstrumentModel, diagnosis: Diagnosis) -> InstrumentModel:
    """The instrument model (as in its file, at all its wavelengths) with the diagnosis put in.

    Effects come behind those that it has; values that the file calls nominal are replaced by what was fitted. An
    effect of the same kind, place and wavelength is replaced: its new values are on top of the old ones. Where nothing
    is corrected, what is known of how wrong M may be is put in all the same, in place of what was known of it.
    """
    values: dict[str, dict[str, Dispersive]] = {}
    errors = dict(model.stderr)
    for name, entry in diagnosis.calibrated.items() if diagnosis.corrects else ():
        element, _, field = name.rpartition(".")
        old = model.value_of(name)
        values.setdefault(element, {})[field] = _merge(old or 0.0, entry, diagnosis.wavelengths_nm)
        error = entry.model_copy(update={"value": entry.stderr or 0.0})
        errors[name] = _merge(errors.get(name, 0.0), error, diagnosis.wavelengths_nm)
    systematic = diagnosis.systematic()
    wavelengths = [s.wavelength_nm for s in systematic]
    update = {
        "stderr": errors,
        "effects": (*model.effects, *diagnosis.applied()),
        "systematic": (*(s for s in model.systematic if s.wavelength_nm not in wavelengths), *systematic),
    }
    return model.with_values(values).model_copy(update=update)


def _merge(old: Dispersive, entry: EffectParameter, wavelengths_nm: tuple[float, ...]) -> Dispersive:
    """A value as the file holds it, with what was fitted in place of what it says at the same wavelengths."""
    if not isinstance(entry.value, tuple):
        if not isinstance(old, dict):
            return entry.value
        new = dict.fromkeys(wavelengths_nm, entry.value)
    else:
        new = dict(zip(entry.wavelengths_nm or (), entry.value, strict=True))
    stored = {} if not isinstance(old, dict) else old
    return {k: v for k, v in stored.items() if all(abs(k - w) >= SAME_NM for w in new)} | new


def file_head(first: str, note: str) -> str:
    """The comment at the head of a file: what wrote it, and why it is believed."""
    return "".join(f"# {line}\n" for line in (first, *note.splitlines()))


def write_instrument(path: Path, model: InstrumentModel, diagnosis: Diagnosis, note: str = "") -> None:
    """Write `extend_model` to a new file.

    Parameters
    ----------
    path : Path
    model : InstrumentModel
        All wavelengths, as it was diagnosed.
    diagnosis : Diagnosis
    note : str
        Why it is believed, for the head of the file.

    Raises
    ------
    WriteError
        There is nothing to write, or more than an instrument file may hold.
    ProcessError
        The file exists.

    Examples
    --------
    >>> model = InstrumentModel.load("instrument.yaml")
    >>> judged, _ = diagnose_captures(["air.h5"], model)
    >>> write_instrument(Path("corrected.yaml"), model, judged.diagnosis, note="air of today")
    >>> [e.kind for e in InstrumentModel.load("corrected.yaml").effects if e.probability > 0.5]
    ['psg_azimuth']
    """
    if not diagnosis.corrects and not diagnosis.systematic():
        if diagnosis.correction is not None and diagnosis.correction.refused is not None:
            raise WriteError(f"{path} was not written: {diagnosis.correction.refused}.")
        raise WriteError(f"nothing was found that could go into {path}; it was not written.")
    text = dump_yaml(extend_model(model, diagnosis))
    try:
        parse_yaml(text, InstrumentModel, source=str(path))
    except ConfigError as error:
        raise WriteError(
            f"{error}: {path} was not written. If the file is too long, diagnose fewer captures at once; "
            "else keep the result with `--json` and report it."
        ) from error
    holds = "see `effects`" if diagnosis.corrects else "nothing is corrected; `systematic` is how wrong M may be"
    if diagnosis.corrects and diagnosis.correction is not None and diagnosis.correction.refused is not None:
        holds = f"the fitted values of the train alone; effects are not applied: {diagnosis.correction.refused}"
    write_new_text(path, file_head(f"Written by `diagnose`: {diagnosis.verdict}, {holds}.", note) + text)
