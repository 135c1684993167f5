"""Notes and tags of the files of a folder, which the page of each file changes and the lists show."""

import threading

from pydantic import BaseModel, ConfigDict
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse

from processing.doors import is_line
from processing.errors import ProcessError
from processing.section import Section
from viewer.library import Library
from viewer.pages import fields_of, pages_of
from viewer.side_files import read_side_file, write_side_file

#: Name of the file, in the folder of the application's own files.
FILE = "notes.json"
#: Most characters of a note, and of all tags of a file.
LONGEST, LONGEST_TAGS = 2000, 200

_lock = threading.Lock()


class Note(Section):
    """Note and tags of a file."""

    text: str = ""
    tags: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """The text that a search looks through, in small letters."""
        return " ".join((self.text, *self.tags)).lower()


class _NotesFile(BaseModel):
    model_config = ConfigDict(extra="forbid")

    files: dict[str, Note] = {}


def notes_of(library: Library) -> dict[str, Note]:
    """Notes by the name of their file. Raises ProcessError for a damaged file."""
    return read_side_file(library, FILE, _NotesFile).files


async def write_note(request: Request) -> JSONResponse:
    """Keep the note and the tags of a file; without both it has none."""
    fields = await fields_of(request)
    return await run_in_threadpool(_write_note, pages_of(request).library, fields)


def _write_note(library: Library, fields: dict[str, str]) -> JSONResponse:
    name = library.name(library.path(fields.get("file", "")))
    text = fields.get("text", "").strip()
    tags = tuple(dict.fromkeys(tag for part in fields.get("tags", "").split(",") if (tag := part.strip())))
    if len(text) > LONGEST or sum(map(len, tags)) > LONGEST_TAGS or not all(map(is_line, tags)):
        raise ProcessError(f"a note has at most {LONGEST} characters, and the tags have at most {LONGEST_TAGS}")
    note = Note(text=text, tags=tags)
    with _lock:
        files = notes_of(library) | {name: note}
        if note == Note():
            del files[name]
        write_side_file(library, FILE, _NotesFile(files=files))
    return JSONResponse({"text": note.text, "tags": list(note.tags)})
