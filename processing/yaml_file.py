"""Load a YAML file into a pydantic model, with errors that name the file, the line and the key."""

import functools
import json
import math
import os
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from pydantic import BaseModel, ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.composer import Composer
from ruamel.yaml.error import MarkedYAMLError, YAMLError
from ruamel.yaml.events import AliasEvent

from processing.doors import MOST_DEPTH, is_line, one_line, read_text
from processing.errors import ProcessError
from processing.yaml_words import mistakes_of, names_in, words_of

Model = TypeVar("Model", bound=BaseModel)
#: Keys that lead to a value or to a key, and it.
_Scalar: TypeAlias = tuple[tuple[Any, ...], Any]

#: Most bytes and most values of a file, aliases counted as often as they are used. The parser takes up to 0.2 ms a
#: value, so that this is about two seconds; a table of 5000 states of two axes fits.
MOST_BYTES = 256 << 10
MOST_NODES = 10_500
#: Largest number: the largest quantity here is an electron count.
MOST = 1e18
#: Lines of a message about a file with very many mistakes.
MOST_LINES = 30


class ConfigError(ProcessError):
    """A configuration file cannot be used; the message names file, line and key."""


def load_yaml(path: Path | str, model: type[Model]) -> Model:
    """Read `path` and validate it as `model`.

    Raises ConfigError: the file is missing, is not YAML, repeats a key, or does not fit the model.
    """
    path = Path(path)
    return parse_yaml(read_text(path, ConfigError, MOST_BYTES), model, source=str(path))


class _BoundedComposer(Composer):
    """Builds the tree of a document, but none that is too deep, too large, or contains itself."""

    def __init__(self, loader: Any = None) -> None:
        super().__init__(loader=loader)
        self._nodes = self._depth = 0
        self._size_of: dict[str, int] = {}
        self._open: set[str] = set()

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.parser.peek_event()
        if isinstance(event, AliasEvent):
            if event.anchor in self._open:
                raise MarkedYAMLError(problem=f"*{event.anchor} contains itself", problem_mark=event.start_mark)
            self._count(self._size_of.get(event.anchor, 0), event)
            return super().compose_node(parent, index)
        before, anchor = self._nodes, getattr(event, "anchor", None)
        self._count(1, event)
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise MarkedYAMLError(problem=f"nested deeper than {MOST_DEPTH} levels", problem_mark=event.start_mark)
        if anchor is not None:
            self._open.add(anchor)
        node = super().compose_node(parent, index)
        self._depth -= 1
        if anchor is not None:
            self._open.discard(anchor)
            self._size_of[anchor] = self._nodes - before
        return node

    def _count(self, nodes: int, event: Any) -> None:
        self._nodes += nodes
        if self._nodes > MOST_NODES:
            raise MarkedYAMLError(problem=f"more than {MOST_NODES} values", problem_mark=event.start_mark)


def parse_yaml(text: str, model: type[Model], source: str = "text") -> Model:
    """Validate YAML text as `model`; `source` names it in errors. Raises ConfigError."""
    tree = _tree(text, source)
    written = _written(text)
    if lines := _not_meant(source, tree, written):
        raise _refusal(source, lines)
    try:
        value = model.model_validate(_plain(tree))
    except ValidationError as error:
        lines = _describe(source, tree, model, mistakes_of(error))
        places = {line.split(" ", 1)[0] for line in lines}
        more = [line for line in _not_finite(source, tree, written) if line.split(" ", 1)[0] not in places]
        raise _refusal(source, lines + more) from error
    # As the model understood them: the text "nan" and the word true become numbers where one is asked for.
    understood = list(_scalars(value.model_dump(exclude_unset=True)))
    lines = _not_finite(source, tree, understood) + _truths_as_numbers(source, tree, written, understood)
    lines += _beyond(source, tree, understood)
    if lines:
        raise _refusal(source, lines)
    return value


def _not_finite(source: str, tree: CommentedMap, values: Iterable[_Scalar]) -> list[str]:
    return [
        f"{_place(source, tree, where)}: must be a finite number"
        for where, value in values
        if isinstance(value, float) and not math.isfinite(value)
    ]


def _truths_as_numbers(
    source: str, tree: CommentedMap, written: Sequence[_Scalar], understood: Iterable[_Scalar]
) -> list[str]:
    became = dict(understood)
    return [
        f"{_place(source, tree, where)}: must be a number, not {str(value).lower()}"
        for where, value in written
        if isinstance(value, bool) and type(became.get(where)) in (int, float)
    ] + [
        f"{_place(source, tree, where)}: write numbers without _"
        for where, value in written
        if isinstance(value, str) and "_" in value and value != where[-1] and type(became.get(where)) in (int, float)
    ]


def _not_meant(source: str, tree: CommentedMap, written: Sequence[_Scalar]) -> list[str]:
    """Texts with control characters, which would reach a terminal, and numbers with underscores."""
    lines = []
    for where, value in written:
        if isinstance(value, str) and not is_line(value.replace("\n", "").replace("\t", "")):
            lines.append(f"{source}:{_line(tree, where)}: control characters in a text")
        elif getattr(value, "_underscore", None):
            lines.append(f"{_place(source, tree, where)}: write numbers without _")
    return lines


def _beyond(source: str, tree: CommentedMap, understood: Iterable[_Scalar]) -> list[str]:
    return [
        f"{_place(source, tree, where)}: {one_line(value, 40)} is beyond anything that can be meant"
        for where, value in understood
        if isinstance(value, int | float) and math.isfinite(value) and abs(value) > MOST
    ]


def _place(source: str, tree: CommentedMap, where: tuple[Any, ...]) -> str:
    return f"{source}:{_line(tree, where)}: {'.'.join(map(str, where))}"


def _refusal(source: str, lines: list[str]) -> ConfigError:
    summary = [f"{source}: and {len(lines) - MOST_LINES} more"] if len(lines) > MOST_LINES else []
    return ConfigError("\n".join(lines[:MOST_LINES] + summary))


def _tree(text: str, source: str) -> CommentedMap:
    if len(text) > MOST_BYTES:
        raise ConfigError(f"{source}: {len(text):,} characters; at most {MOST_BYTES:,} are read")
    try:
        tree = _parse(text)
    except MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        problem = "a tab; YAML is indented with spaces" if "'\\t'" in str(error.problem) else one_line(error.problem)
        raise ConfigError(f"{source}:{line}: {problem}") from error
    except (YAMLError, ValueError, TypeError, AttributeError, KeyError, IndexError, AssertionError) as error:
        # The parser's own errors on tags and dates that are none come as Python's.
        raise ConfigError(f"{source}: is not YAML that can be read ({one_line(error)})") from error
    if not isinstance(tree, CommentedMap):
        raise ConfigError(f"{source}: expected keys and values at the top level, found {type(tree).__name__}")
    return tree


@functools.lru_cache(maxsize=64)
def _parse(text: str) -> Any:
    """The tree of a text, which nobody changes: a campaign reads its few files at every capture."""
    yaml = YAML(typ="rt")
    yaml.Composer = _BoundedComposer
    return yaml.load(text)


@functools.lru_cache(maxsize=64)
def _written(text: str) -> tuple[_Scalar, ...]:
    return tuple(_scalars(_parse(text)))


def named_files(path: Path) -> Iterator[tuple[str, Path]]:
    """The files that a YAML file names by values that are paths from its folder, and those that they name in turn.

    Parameters
    ----------
    path : a YAML file; any other names nothing.

    Yields
    ------
    name : str
        Keys on the way, with dots.
    file : Path
        Each file once.

    Raises
    ------
    ConfigError
    """
    return _named_files(path, (), {Path(os.path.realpath(path))})


def _named_files(path: Path, before: tuple[Any, ...], visited: set[Path]) -> Iterator[tuple[str, Path]]:
    if path.suffix not in (".yaml", ".yml") or not os.path.isfile(path):
        return
    for where, value in _scalars(_tree(path.read_text(encoding="utf-8"), str(path))):
        if not isinstance(value, str) or not os.path.isfile(file := path.parent / value):
            continue
        if (real := Path(os.path.realpath(file))) not in visited:
            visited.add(real)
            yield ".".join(str(part) for part in (*before, *where)), file
            yield from _named_files(file, (*before, *where), visited)


def dump_yaml(value: BaseModel) -> str:
    """YAML text of a model; `parse_yaml` of it gives an equal model. Lists of numbers are written in a row."""
    return _text(json.dumps(value.model_dump(mode="json", exclude_none=True)))


@functools.lru_cache(maxsize=64)
def _text(document: str) -> str:
    """YAML text of a JSON document: a campaign writes the same few into every capture."""
    from io import StringIO

    yaml = YAML()
    yaml.indent(mapping=2, sequence=4, offset=2)
    # A key that is folded over two lines, as one with a capture's name would be, cannot be read back.
    yaml.width = sys.maxsize
    buffer = StringIO()
    yaml.dump(_numbers_in_rows(json.loads(document)), buffer)
    return buffer.getvalue()


def _numbers_in_rows(node: Any) -> Any:
    if isinstance(node, dict):
        return {key: _numbers_in_rows(part) for key, part in node.items()}
    if not isinstance(node, list):
        return node
    if all(isinstance(part, int | float) for part in node):
        row = CommentedSeq(node)
        row.fa.set_flow_style()
        return row
    return [_numbers_in_rows(part) for part in node]


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


def _describe(source: str, tree: CommentedMap, model: type[BaseModel], entries: Sequence[Any]) -> list[str]:
    """A line for each place with a mistake; for a file of another kind only that."""
    kind = [entry for entry in entries if entry["loc"] == ("kind",)]
    names = names_in(model) if any(entry["type"] == "extra_forbidden" for entry in entries) else ()
    texts_of: dict[str, list[str]] = {}
    for keys, entry in _of_the_type_meant([(_keys(tree, entry), entry) for entry in kind or entries]):
        place = ": ".join(filter(None, (f"{source}:{_line(tree, entry['loc'])}", one_line(".".join(keys)))))
        texts_of.setdefault(place, []).append(one_line(words_of(entry, names)))
    after = "; is it the right file?" if kind else ""
    return [f"{place}: {', or '.join(dict.fromkeys(texts))}{after}" for place, texts in texts_of.items()]


def _of_the_type_meant(entries: Sequence[tuple[tuple[str, ...], Any]]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Drop type errors of a mapping or list if an entry below it has an error of its own."""
    mistakes = [keys for keys, entry in entries if not _wrong_type(entry)]
    for keys, entry in entries:
        if not _wrong_type(entry) or not any(mistake[: len(keys)] == keys for mistake in mistakes):
            yield keys, entry


def _wrong_type(entry: Any) -> bool:
    return entry["type"].endswith("_type") and isinstance(entry["input"], dict | list)


def _keys(tree: Any, entry: Any) -> tuple[str, ...]:
    """The keys of a place as they stand in the file, and one that is missing.

    The library also names the type, where a value could be of several.
    """
    node, keys, location = tree, [], entry["loc"]
    for part in location:
        if not isinstance(node, (CommentedMap, CommentedSeq)):
            break
        if _has(node, part):
            node = node[part]
            keys.append(str(part))
    return (*keys, str(location[-1])) if entry["type"] == "missing" else tuple(keys)


def _line(tree: Any, location: Sequence[int | str]) -> int:
    node, line = tree, tree.lc.line + 1
    for part in location:
        if isinstance(node, (CommentedMap, CommentedSeq)) and _has(node, part):
            # What came in by a merge has no line of its own: the one above it stays.
            place = (node.lc.data or {}).get(part)
            line, node = line if place is None else place[0] + 1, node[part]
        # Any other part is a tag that pydantic adds for unions: the line stays.
    return int(line)


def _has(node: CommentedMap | CommentedSeq, part: int | str) -> bool:
    return part in node if isinstance(node, CommentedMap) else isinstance(part, int) and part < len(node)


def _scalars(node: Any, where: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    if isinstance(node, (dict, list, tuple)):
        for part, item in node.items() if isinstance(node, dict) else enumerate(node):
            yield (*where, part), part
            yield from _scalars(item, (*where, part))
    else:
        yield where, node
