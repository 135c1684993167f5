"""A fact of a product in words, the same on the console, in reports and in the browser."""

import re
from collections import Counter
from collections.abc import Mapping
from typing import Any

#: Most inputs that a line names.
MOST_NAMED = 4
#: What an instrument determines that measures the light alone: the first column of M is its Stokes vector.
_LIGHT = re.compile(r"m00(, m[123]0)+")


def fact_lines(facts: Mapping[str, Any]) -> dict[str, tuple[str, str]]:
    """Of each fact how it is called and its value, in words; those of a Stokes vector speak of S."""
    lines = {name: (name.replace("_", " "), fact_words(value)) for name, value in facts.items()}
    if _LIGHT.fullmatch(str(facts.get("determined"))):
        lines = {n: (label.replace("mij over m00", "si over s0"), text) for n, (label, text) in lines.items()}
        lines["determined"] = ("determined", re.sub(r"m(\d)0", r"s\1", str(facts["determined"])))
    return lines


def fact_words(value: Any) -> str:
    """A number with five digits, a truth as yes or no, what has no value as none; lists and mappings item by item."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {fact_words(item)}" for name, item in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(fact_words, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value != value:
        return "none"
    return f"{value:.5g}" if isinstance(value, float) else _inputs(str(value))


def _inputs(text: str) -> str:
    """A text; where it lists directions of several inputs each, as a;b, the inputs that most of them have."""
    directions = [direction.split(", ") for direction in text.split("; ")]
    count = Counter(name for direction in directions for name in direction)
    if len(directions) < 2 or max(len(count), len(directions)) <= MOST_NAMED:
        return text
    named = ", ".join(name for name, _ in count.most_common(MOST_NAMED))
    more = f" and {len(count) - MOST_NAMED} more" if len(count) > MOST_NAMED else ""
    return f"{named}{more}, in {len(directions)} directions"
