"""Diagnoses started from the page: where their files are, what they say, and what was decided about them."""

from __future__ import annotations

import contextlib
import json
import re
import secrets
import time
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from processing.diagnosis.instrument.residual_file import StoredResidual, read_residuals
from processing.diagnosis.instrument_file import write_instrument
from processing.diagnosis.search.result import Diagnosis
from processing.doors import read_json, read_text
from processing.errors import ProcessError
from processing.instrument.model import InstrumentModel
from processing.storage.capture import Capture
from viewer.library import OWN, Library, NotHere

VERDICTS = {
    "consistent": "The captures agree with the instrument model: what is left over is noise.",
    "explained": "The captures disagree with the instrument model, and what was found explains all of it.",
    "partly_explained": "Something was found, but more is left over than noise.",
    "unexplained": "The captures disagree with the instrument model, and nothing that is known explains it.",
    "undetermined": "Nothing can be said: a fault of typical size would not have been seen in these captures.",
}


@dataclass(frozen=True)
class Story:
    """One diagnosis with everything that a page tells of it."""

    name: str
    diagnosis: Diagnosis
    captures: tuple[str, ...]
    decision: dict[str, Any] | None
    begun: str


class Diagnoses:
    """The diagnoses of a folder."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._folder = library.root / OWN / "diagnoses"

    def begin(self, captures: Sequence[Path], instrument: Path | None) -> tuple[str, Path]:
        """A new folder with the instrument file to compare with: a copy, or the model stored in the first capture.

        Raises
        ------
        ProcessError : there is no capture, or no model in it.
        """
        if not captures:
            raise ProcessError("a diagnosis needs a capture")
        if instrument is not None:
            text = read_text(instrument)
        else:
            with Capture(captures[0]) as capture:
                text = capture.header.instrument_yaml
            if not text:
                raise ProcessError(f"{captures[0].name} holds no instrument model; choose a file")
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        folder = self._folder / name
        folder.mkdir(parents=True)
        (folder / "instrument.yaml").write_text(text, encoding="utf-8")
        about = {
            "captures": [self._library.name(path) for path in captures],
            "instrument": "the model in the capture" if instrument is None else str(instrument),
            "begun": datetime.now().astimezone().isoformat(timespec="seconds"),
        }
        (folder / "about.json").write_text(json.dumps(about), encoding="utf-8")
        return name, folder

    def folder(self, name: str) -> Path:
        """Folder of a diagnosis. Raises NotHere."""
        if not re.fullmatch(r"[0-9a-f-]+", name) or not (self._folder / name / "about.json").is_file():
            raise NotHere(f"{name}: there is no such diagnosis")
        return self._folder / name

    def story(self, name: str) -> Story:
        """A diagnosis that is done. Raises NotHere, ProcessError."""
        folder = self.folder(name)
        about = read_json(folder / "about.json")
        decided = folder / "decision.json"
        try:
            diagnosis = Diagnosis.model_validate_json(read_text(folder / "diagnosis.json"))
        except ValidationError as error:
            raise ProcessError(f"diagnosis {name}: this version cannot read it; diagnose anew") from error
        return Story(
            name=name,
            diagnosis=diagnosis,
            captures=tuple(about["captures"]),
            decision=read_json(decided) if decided.exists() else None,
            begun=about["begun"],
        )

    def of_capture(self, capture: str) -> list[Story]:
        """Diagnoses that a capture took part in, the newest first; without those that cannot be read."""
        found = []
        for path in sorted(self._folder.glob("*/diagnosis.json"), reverse=True):
            with contextlib.suppress(ProcessError):
                found.append(self.story(path.parent.name))
        return [story for story in found if capture in story.captures]

    def residuals(self, name: str) -> list[StoredResidual]:
        """Residuals of its captures, before and after."""
        path = self.folder(name) / "residuals.npz"
        return _read(path, path.stat().st_mtime_ns) if path.exists() else []

    def accept(self, name: str, file: str, note: str) -> Path:
        """Write the corrected instrument model into the folder under a new name; nothing is ever replaced.

        Raises
        ------
        ProcessError : the name is none or taken, there is nothing to write, or it is decided already.
        """
        if not re.fullmatch(r"[\w. -]+\.yaml", file) or file.startswith("."):
            raise ProcessError(f"{file!r}: give a plain file name that ends in .yaml")
        story = self._undecided(name)
        model = InstrumentModel.load(self.folder(name) / "instrument.yaml")
        path = self._library.root / file
        write_instrument(path, model, story.diagnosis, note)
        self._decide(name, {"accepted": True, "file": file, "note": note})
        return path

    def reject(self, name: str, note: str) -> None:
        """Note that the model is not believed, and why. Raises ProcessError where it is decided already."""
        self._undecided(name)
        self._decide(name, {"accepted": False, "note": note})

    def _undecided(self, name: str) -> Story:
        story = self.story(name)
        if story.decision is not None:
            raise ProcessError("this diagnosis was decided already; load the page anew")
        return story

    def _decide(self, name: str, decision: dict[str, Any]) -> None:
        when = {"time": datetime.now().astimezone().isoformat(timespec="seconds")}
        path = self.folder(name) / "decision.json"
        path.write_text(json.dumps(decision | when), encoding="utf-8")


@lru_cache(maxsize=2)
def _read(path: Path, changed: int) -> list[StoredResidual]:
    return read_residuals(path)
