"""A fact of a product in words, the same on the console, in reports and in the browser."""

from __future__ import annotations

from typing import Any


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
    return f"{value:.5g}" if isinstance(value, float) else str(value)
