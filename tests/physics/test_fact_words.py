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
        ({"rank_lost": 2, "where": None}, "rank lost 2, where none"),
    ],
)
def test_a_fact_in_words(value, words):
    assert fact_words(value) == words
