"""A fact reads the same on the console, in a report and in the browser."""

import pytest

from processing.reports.fact_words import fact_words


@pytest.mark.parametrize(
    ("value", "words"),
    [
        (1.23456789, "1.2346"),
        (float("nan"), "none"),
        (None, "none"),
        (True, "yes"),
        (40, "40"),
        ("darks", "darks"),
        ([], "none"),
        ([1.0, float("nan")], "1, none"),
        ("a x, b; a x, c; a x, b, d, e, f", "a x, b, c, d and 2 more, in 3 directions"),
        ("a x; b y", "a x; b y"),
        ("; ".join(["W"] * 8), "W, in 8 directions"),
        ({"rank_lost": 2, "where": None}, "rank lost 2, where none"),
    ],
)
def test_a_fact_in_words(value, words):
    assert fact_words(value) == words
