"""Files of the application next to the data, in a hidden folder: read and written as a whole."""

from typing import TypeVar

from pydantic import BaseModel, ValidationError

from processing.doors import read_json
from processing.errors import ProcessError
from processing.whole_file import write_whole_text
from viewer.library import OWN, Library

Kept = TypeVar("Kept", bound=BaseModel)


def read_side_file(library: Library, file: str, kind: type[Kept]) -> Kept:
    """Content of a file; empty where there is none. Raises ProcessError for a damaged file."""
    path = library.root / OWN / file
    if not path.exists():
        return kind()
    try:
        return kind.model_validate(read_json(path))
    except ValidationError as error:
        raise ProcessError(f"{path} is damaged. Correct it, or move it away.") from error


def write_side_file(library: Library, file: str, content: BaseModel) -> None:
    """Replace a file. Raises ProcessError."""
    path = library.root / OWN / file
    try:
        path.parent.mkdir(exist_ok=True)
        write_whole_text(path, content.model_dump_json(indent=1) + "\n")
    except OSError as error:
        raise ProcessError(f"{path} cannot be written ({error.strerror})") from error
