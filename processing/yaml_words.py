"""What is wrong with a value of a YAML file, in words that need no knowledge of the program."""

from collections.abc import Iterator, Sequence
from difflib import get_close_matches
from typing import Any

from pydantic import BaseModel, PydanticUserError, ValidationError

#: By the library's name of the mistake; `{...}` are what it tells beside the name.
WORDS = {
    "missing": "is missing",
    "extra_forbidden": "unknown key",
    "finite_number": "must be a finite number",
    "greater_than": "must be more than {gt}",
    "greater_than_equal": "must be {ge} or more",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be {le} or less",
    "literal_error": "must be {expected}",
    "enum": "must be {expected}",
    "int_from_float": "must be a whole number",
    "too_short": "needs {min_length} or more entries, has {actual_length}",
    "too_long": "may have {max_length} entries, has {actual_length}",
    "string_too_short": "needs {min_length} or more characters",
    "string_too_long": "may have {max_length} characters",
    "string_pattern_mismatch": "must match {pattern}",
    "union_tag_invalid": "{tag} is none of {expected_tags}",
    "union_tag_not_found": "needs the key {discriminator}",
    "recursion_loop": "contains itself",
    "invalid_key": "unknown key; decimals take a point, not a comma",
}
#: By the type that the value should have, the first word of such a name.
TYPES = {
    "float": "a number",
    "decimal": "a number",
    "int": "a whole number",
    "string": "text",
    "bool": "true or false",
    "path": "a file name",
    "tuple": "a list",
    "list": "a list",
    "dict": "keys and values",
    "model": "keys and values",
    "mapping": "keys and values",
    "none": "nothing",
    "url": "an address such as https://...",
}
#: Mistakes that are told without the value.
NEEDS_NO_VALUE = ("missing", "extra_forbidden", "invalid_key", "union_tag_invalid")
#: Of names that become parts of file names.
NAME_PATTERN = r"^[A-Za-z0-9_-]+$"
#: Longest value that is shown.
SHOWN = 40


def names_in(model: type[BaseModel]) -> tuple[str, ...]:
    """Every key that a file of the model may have, at any depth; none where the model has no schema."""
    try:
        return tuple(dict.fromkeys(_properties(model.model_json_schema())))
    except PydanticUserError:
        return ()


def _properties(schema: Any) -> Iterator[str]:
    if isinstance(schema, list):
        for part in schema:
            yield from _properties(part)
    elif isinstance(schema, dict):
        yield from schema.get("properties", ())
        for word, part in schema.items():
            # A model may have a key of the name of one of the schema's own words.
            yield from _properties(list(part.values()) if word in ("properties", "$defs") else part)


def mistakes_of(error: ValidationError) -> list[Any]:
    """The entries of an error, without that a list is too short where it has entries that could not be read.

    pydantic counts only those that it could read.
    """
    entries = error.errors()
    # Places above each mistake.
    above = {entry["loc"][:depth] for entry in entries for depth in range(len(entry["loc"]))}
    return [
        entry
        for entry in entries
        if entry["type"] != "too_short"
        or entry["loc"] not in above
        or len(entry["input"]) < int(entry["ctx"]["min_length"])
    ]


def words_of(entry: Any, names: Sequence[str] = ()) -> str:
    """Text of one entry of a ValidationError.

    Parameters
    ----------
    entry : of `ValidationError.errors()`.
    names : keys that a file may have; the nearest one is named beside one that it may not have.
    """
    kind = str(entry["type"])
    if "words" in entry.get("ctx", {}):
        return str(entry["msg"])
    if kind == "extra_forbidden":
        key = str(entry["loc"][-1])
        meant = get_close_matches(key, [name for name in names if name != key], 1, cutoff=0.75)
        meant += [name for name in names if name.startswith(f"{key}_")]
        elsewhere = "; another section may have it" if key in names else ""
        return WORDS[kind] + (f"; is {meant[0]!r} meant?" if meant else elsewhere)
    if kind == "string_pattern_mismatch" and entry["ctx"]["pattern"] == NAME_PATTERN:
        return "may have letters, digits, - and _ only" + _value_text(kind, entry)
    if kind in WORDS:
        return WORDS[kind].format_map(entry.get("ctx", {})) + _value_text(kind, entry)
    stem, _, suffix = kind.partition("_")
    if stem in TYPES and suffix in ("type", "parsing", "parsing_size", "attributes_type"):
        return f"must be {TYPES[stem]}" + _value_text(kind, entry)
    return str(entry["msg"]).removeprefix("Value error, ")


def _value_text(kind: str, entry: Any) -> str:
    """The value itself, if it is short and the text does not contain it yet."""
    value = entry.get("input")
    if kind in NEEDS_NO_VALUE or isinstance(value, dict | list | tuple):
        return ""
    if value is None:
        return ", but nothing stands there"
    text = repr(value)
    return f", not {text}" if len(text) <= SHOWN else ""
