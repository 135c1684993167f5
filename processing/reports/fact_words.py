"""A fact of a product in words, the same on the console, in reports and in the browser."""

from __future__ import annotations

from collections import Counter
from typing import Any

#: Most inputs that a line names.
MOST_NAMED = 4


def fact_words(value: Any) -> str:
    """A number with five digits, a truth as yes or no, what has no value as none; lists and mappings item by item."""
    if isinstance(value, dict):
        return ", ".join(f"{name.replace('_', ' ')} {fact_words(one)}" for name, one in value.items()) or "none"
    if isinstance(value, list | tuple):
        return ", ".join(map(fact_words, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if value is None or value != value:
        return "none"
    return f"{value:.5g}" if isinstance(value, float) else _inputs(str(value))


def _inputs(text: str) -> str:
    """A text; where it lists directions of several inputs each, as a;b, the inputs that most of them have."""
    directions = [one.split(", ") for one in text.split("; ")]
    count = Counter(name for one in directions for name in one)
    if len(directions) < 2 or len(count) <= MOST_NAMED:
        return text
    named = ", ".join(name for name, _ in count.most_common(MOST_NAMED))
    return f"{named} and {len(count) - MOST_NAMED} more, in {len(directions)} directions"
