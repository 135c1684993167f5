"""Diagnoses started from the page: their files, results and decisions."""

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
from processing.diagnosis.surface.diagnose import SurfaceDiagnosis
from processing.diagnosis.surface.write import write_surface
from processing.doors import read_json, read_text
from processing.errors import ProcessError
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.reflectance.base import load_reflectance
from processing.storage.captures.capture import Capture
from processing.whole_file import write_whole_text
from processing.yaml_file import dump_yaml
from viewer.library import OWN, Library, NotHere

#: What is said of a verdict; `{model}` is what the captures were compared with.
VERDICTS = {
    "consistent": "The captures agree with {model}: the residual is noise.",
    "explained": "The captures disagree with {model}; the effects found explain all of it.",
    "partly_explained": "Effects were found, but the residual exceeds the noise.",
    "unexplained": "The captures disagree with {model}, and no known effect explains it.",
    "undetermined": "No verdict: a fault of typical size would not be visible in these captures.",
}


@dataclass(frozen=True)
class Story:
    """One diagnosis with everything that a page shows of it."""

    name: str
    diagnosis: Diagnosis
    captures: tuple[str, ...]
    decision: dict[str, Any] | None
    begun: str

    @property
    def of_surface(self) -> bool:
        """Whether a material was asked, not the instrument alone."""
        return isinstance(self.diagnosis, SurfaceDiagnosis)

    @property
    def model(self) -> str:
        """Name of the material, or of the instrument."""
        diagnosis = self.diagnosis
        return diagnosis.material if isinstance(diagnosis, SurfaceDiagnosis) else diagnosis.instrument

    @property
    def verdict(self) -> str:
        """The verdict as a sentence."""
        model = "the material on its geometry" if self.of_surface else "the instrument model"
        return VERDICTS[self.diagnosis.verdict].format(model=model)

    @property
    def writes(self) -> bool:
        """Whether a file could hold a part of the correction."""
        return self.diagnosis.corrects


class Diagnoses:
    """The diagnoses of a folder."""

    def __init__(self, library: Library) -> None:
        self._library = library
        self._folder = library.root / OWN / "diagnoses"

    def begin(
        self, captures: Sequence[Path], instrument: Path | None, surface: tuple[Path, Path] | None = None
    ) -> tuple[str, Path]:
        """A new folder with what to compare with, as it is now.

        Parameters
        ----------
        instrument : its file; without one the model stored in the first capture is taken.
        surface : files of the material and the geometry, for the diagnosis of a surface.

        Raises
        ------
        ProcessError : there is no capture, or no model in it; a file that cannot be read.
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
        texts = {"instrument.yaml": text}
        if surface is not None:
            material, geometry = surface
            texts["material.yaml"] = read_text(material)
            # A mesh is named from where the geometry's own file lies.
            texts["geometry.yaml"] = dump_yaml(ViewingGeometry.load(geometry))
        name = f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(2)}"
        folder = self._folder / name
        folder.mkdir(parents=True)
        for file, content in texts.items():
            (folder / file).write_text(content, encoding="utf-8")
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
        kind = SurfaceDiagnosis if (folder / "material.yaml").exists() else Diagnosis
        try:
            diagnosis = kind.model_validate_json(read_text(folder / "diagnosis.json"))
        except ValidationError as error:
            raise ProcessError(f"diagnosis {name}: this version cannot read it; run the diagnosis again") from error
        return Story(
            name=name,
            diagnosis=diagnosis,
            captures=tuple(about["captures"]),
            decision=read_json(decided) if decided.exists() else None,
            begun=about["begun"],
        )

    def of_capture(self, capture: str) -> list[Story]:
        """Diagnoses that a capture took part in, the newest first; without those that cannot be read."""
        stories = []
        for path in sorted(self._folder.glob("*/diagnosis.json"), reverse=True):
            with contextlib.suppress(ProcessError):
                stories.append(self.story(path.parent.name))
        return [story for story in stories if capture in story.captures]

    def residuals(self, name: str) -> list[StoredResidual]:
        """Residuals of its captures, before and after."""
        path = self.folder(name) / "residuals.npz"
        return _read(path, path.stat().st_mtime_ns) if path.exists() else []

    def accept(self, name: str, file: str, note: str) -> list[Path]:
        """Write the corrected model into the folder under a new name; nothing is ever replaced.

        Returns
        -------
        The files written: the instrument; of a surface, material, geometry and instrument as far as they changed.

        Raises
        ------
        ProcessError : the name is none or taken, there is nothing to write, or it is decided already.
        """
        if not re.fullmatch(r"[\w. -]+\.yaml", file) or file.startswith("."):
            raise ProcessError(f"{file!r}: give a plain file name that ends in .yaml")
        story, folder = self._require_undecided(name), self.folder(name)
        model, path = InstrumentModel.load(folder / "instrument.yaml"), self._library.root / file
        if isinstance(story.diagnosis, SurfaceDiagnosis):
            material = load_reflectance(folder / "material.yaml")
            view = ViewingGeometry.load(folder / "geometry.yaml")
            files = write_surface(path, story.diagnosis, material, view, instrument=model, note=note)
        else:
            write_instrument(path, model, story.diagnosis, note)
            files = [path]
        first, *companions = (path.name for path in files)
        self._decide(name, {"accepted": True, "file": first, "beside": companions, "note": note})
        return files

    def reject(self, name: str, note: str) -> None:
        """Note that the model is not believed, and why. Raises ProcessError where it is decided already."""
        self._require_undecided(name)
        self._decide(name, {"accepted": False, "note": note})

    def _require_undecided(self, name: str) -> Story:
        story = self.story(name)
        if story.decision is not None:
            raise ProcessError("this diagnosis was decided already; reload the page")
        return story

    def _decide(self, name: str, decision: dict[str, Any]) -> None:
        when = {"time": datetime.now().astimezone().isoformat(timespec="seconds")}
        path = self.folder(name) / "decision.json"
        # The folder may belong to another user: a link of that name is replaced, not written through.
        write_whole_text(path, json.dumps(decision | when), follow=False)


@lru_cache(maxsize=2)
def _read(path: Path, changed: int) -> list[StoredResidual]:
    return read_residuals(path)
