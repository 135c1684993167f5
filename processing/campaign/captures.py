"""The captures of a campaign's folder: which of them are of an object, and which of these are compared."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from processing.doors import read_json
from processing.errors import ProcessError
from processing.reduction.flat import FlatCapture, flat_captures, nearest_flat
from processing.storage.captures.capture import Capture, CaptureError, NotACapture, made_of_captures


class ObjectCapture(NamedTuple):
    """A complete capture; `kind` is "mueller" or "stokes", `mode` and `sample` are the user's names.

    `omega_deg` is NaN where it is not known; `is_reference` of air and mirrors.
    """

    path: Path
    kind: str
    wavelength_nm: float
    omega_deg: float
    mode: str
    sample: str
    is_reference: bool = False


class FoundCaptures(NamedTuple):
    """Captures under a folder, whether they are simulated, files left out, and damaged files with their errors."""

    captures: list[ObjectCapture]
    simulated: bool
    left_out: list[str]
    damaged: list[tuple[Path, Exception]]


def find_captures(folder: Path, out: Path | None = None, of_objects: bool = True) -> FoundCaptures:
    """Look for captures under a folder.

    Flat fields are in neither list, nor is anything in `out`, the campaign's own results. `of_objects`: leave out air,
    mirrors and captures without an arm angle. Raises ProcessError: no capture, or simulated and measured ones together.
    """
    captures, kinds, left_out = [], {}, []
    damaged: list[tuple[Path, Exception]] = []
    for path in sorted(folder.rglob("*.h5")):
        if (out is not None and path.is_relative_to(out)) or made_of_captures(path):
            continue
        try:
            with Capture(path) as capture:
                header, simulated, flat = capture.header, capture.simulated, FlatCapture.of(capture)
                kind: str = capture.reduces_to
                done, planned, status = len(capture.done), capture.planned_states, capture.status
        except NotACapture as error:
            left_out.append(f"{path}: {error}")
            continue
        except CaptureError as error:
            damaged.append((path, error))
            continue
        if done < planned or status != "complete":
            left_out.append(f"{path}: {done} of {planned} states, {status}; `acquire` goes on with it")
            continue
        if flat is not None:
            continue
        is_reference = header.sample.kind in ("air", "mirror")
        if of_objects and (header.omega_deg is None or is_reference):
            left_out.append(f"{path}: no arm angle" if header.omega_deg is None else f"{path}: {header.sample.kind}")
            continue
        kinds[path] = simulated
        nm, omega = float(header.wavelength_nm), float("nan" if header.omega_deg is None else header.omega_deg)
        sample = header.sample.name or header.sample.kind
        captures.append(ObjectCapture(path, kind, nm, omega, header.mode, sample, is_reference))
    left_out += _unfinished(folder, out)
    if not captures:
        raise ProcessError(
            f"{folder} holds no complete capture{' of an object with an arm angle' * of_objects}. "
            f"{' '.join([*(str(error) for _, error in damaged), *left_out][:3])}"
        )
    if len(set(kinds.values())) > 1:
        simulated_one = next(p for p, s in kinds.items() if s)
        measured_one = next(p for p, s in kinds.items() if not s)
        raise ProcessError(
            f"{folder} mixes simulated captures ({simulated_one.name}) and measured ones ({measured_one.name}); "
            "they are never compared as one campaign. Put them into two folders."
        )
    return FoundCaptures(captures, next(iter(kinds.values())), left_out, damaged)


def _unfinished(folder: Path, out: Path | None) -> list[str]:
    """Captures that are being taken or were interrupted, and those that the index of a campaign has as not complete."""
    partial = [path for path in sorted(folder.rglob("*.h5.partial")) if out is None or not path.is_relative_to(out)]
    lines = [f"{path}: a capture that is not finished; `acquire` goes on with it" for path in partial]
    named = {path.name.removesuffix(".partial") for path in partial}
    for index in sorted(folder.rglob("index.json")):
        try:
            entries = read_json(index)
        except ProcessError:
            # Somebody else's, or damaged: the captures tell for themselves.
            continue
        if not isinstance(entries, dict):
            continue
        lines += [
            f"{index.parent / name}: {entry.get('status', 'not taken')}"
            for name, entry in entries.items()
            if isinstance(entry, dict) and name not in named and not (index.parent / name).exists()
        ]
    return lines


def choose(
    captures: Sequence[ObjectCapture], modes: Sequence[str] = (), samples: Sequence[str] = (), twins: bool = False
) -> tuple[list[ObjectCapture], list[str]]:
    """The captures of these modes and samples (empty: of all), and the others.

    Without `twins`, at most one of a kind, wavelength and angle. Raises ProcessError: no capture is of a mode or
    sample, or two captures would be compared with the same others.
    """
    for word, names, present in (
        ("mode", modes, {capture.mode for capture in captures}),
        ("sample", samples, {capture.sample for capture in captures}),
    ):
        if unknown := [name for name in names if name not in present]:
            raise ProcessError(f"no capture is of the {word} {unknown[0]!r}; there are: {', '.join(sorted(present))}.")
    selection, left_out = [], []
    for capture in captures:
        if (modes and capture.mode not in modes) or (samples and capture.sample not in samples):
            left_out.append(f"{capture.path}: mode {capture.mode}, sample {capture.sample}; not asked for")
        else:
            selection.append(capture)
    if not selection:
        raise ProcessError("no capture is of that mode and that sample.")
    if not twins:
        _refuse_twins(selection)
    return selection, left_out


def flats_of(folder: Path, captures: Sequence[ObjectCapture]) -> dict[Path, Path]:
    """The flat field of each capture that has one: of its camera and wavelength, nearest in time."""
    flats = flat_captures(folder)
    by_capture = {}
    for path, *_ in captures if flats else ():
        with Capture(path) as capture:
            if (flat := nearest_flat(flats, capture)) is not None:
                by_capture[path] = flat
    return by_capture


def _refuse_twins(captures: Sequence[ObjectCapture]) -> None:
    first: dict[tuple[str, float, float], ObjectCapture] = {}
    for capture in captures:
        twin = first.setdefault((capture.kind, capture.wavelength_nm, round(capture.omega_deg, 2)), capture)
        if twin is capture:
            continue
        says = f"{twin.path.name} and {capture.path.name} are both {capture.kind} captures at"
        says += f" {capture.wavelength_nm:g} nm, {capture.omega_deg:g} degrees"
        for field in ("mode", "sample"):
            old, new = getattr(twin, field), getattr(capture, field)
            if old != new:
                raise ProcessError(
                    f"{says}, of the {field}s {old} and {new}. Choose with --{field}, several times for several; each "
                    f"choice needs a folder of its own for its results: --{field} {new} --out FOLDER."
                )
        raise ProcessError(f"{says}. Put one of them into another folder.")
