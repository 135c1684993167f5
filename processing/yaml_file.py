"""Load a YAML file into a pydantic model, with errors that name the file, the line and the key."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import MarkedYAMLError, YAMLError

from processing.errors import ProcessError

Model = TypeVar("Model", bound=BaseModel)


class ConfigError(ProcessError):
    """A configuration file cannot be used; the message names file, line and key."""


def load_yaml(path: Path | str, model: type[Model]) -> Model:
    """Read `path` and validate it as `model`.

    Raises
    ------
    ConfigError
        The file is missing, is not YAML, repeats a key, or does not fit the model.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: is not UTF-8 text") from error
    return parse_yaml(text, model, source=str(path))


def parse_yaml(text: str, model: type[Model], source: str = "text") -> Model:
    """Validate YAML text as `model`; `source` names it in errors. Raises ConfigError."""
    try:
        tree = YAML(typ="rt").load(text)
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        raise ConfigError(f"{source}:{line}: {error.problem}") from error
    except YAMLError as error:
        raise ConfigError(f"{source}: {error}") from error
    if not isinstance(tree, CommentedMap):
        raise ConfigError(f"{source}: expected keys and values at the top level, found {type(tree).__name__}")
    try:
        return model.model_validate(_plain(tree))
    except ValidationError as error:
        lines = [_describe(source, tree, entry) for entry in error.errors()]
        raise ConfigError("\n".join(lines)) from error


def dump_yaml(value: BaseModel) -> str:
    """YAML text of a model; `parse_yaml` of it gives an equal model."""
    from io import StringIO

    yaml = YAML()
    yaml.indent(mapping=2, sequence=4, offset=2)
    out = StringIO()
    yaml.dump(value.model_dump(mode="json", exclude_none=True), out)
    return out.getvalue()


def _plain(node: Any) -> Any:
    # Round-trip scalars are subclasses of int, float and str; pydantic's strict unions want the plain ones.
    if isinstance(node, dict):
        return {_plain(k): _plain(v) for k, v in node.items()}
    if isinstance(node, list):
        return [_plain(v) for v in node]
    if isinstance(node, bool) or node is None:
        return node
    for kind in (int, float, str):
        if isinstance(node, kind):
            return kind(node)
    return node


def _describe(source: str, tree: CommentedMap, entry: Any) -> str:
    location: Sequence[int | str] = entry["loc"]
    where = ".".join(str(part) for part in location)
    return ": ".join(filter(None, (f"{source}:{_line(tree, location)}", where, message_of(entry))))


def message_of(entry: Any) -> str:
    """What one entry of a ValidationError says, without the library's own words before it."""
    if entry["type"] == "extra_forbidden":
        return "unknown key"
    return str(entry["msg"]).removeprefix("Value error, ")


def _line(tree: Any, location: Sequence[int | str]) -> int:
    node, line = tree, tree.lc.line + 1
    for part in location:
        if isinstance(node, CommentedMap) and part in node:
            line, node = node.lc.key(part)[0] + 1, node[part]
        elif isinstance(node, CommentedSeq) and isinstance(part, int) and part < len(node):
            line, node = node.lc.item(part)[0] + 1, node[part]
        # Any other part is a tag that pydantic adds for unions: the line stays.
    return int(line)
