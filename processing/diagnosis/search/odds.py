"""Probabilities of log odds."""

from __future__ import annotations

import numpy as np

from processing.arrays import Array

#: [log odds] Beyond which a probability is zero or one for any number of sixteen digits.
MOST_ODDS = 50.0


def probability_at(log_odds: Array | float) -> Array:
    """Probability of each of some log odds."""
    return np.asarray(1 / (1 + np.exp(-np.clip(log_odds, -MOST_ODDS, MOST_ODDS))))
