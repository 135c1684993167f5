"""A fault of the instrument that has no name, as a sentence: a quantity of an element that follows an angle.

Cause: not known; the sentence gives its site and its course.
Mend: look at the element that the sentence names.
"""

from processing.instrument.effects._sentence import SentenceEffect


class Unlisted(SentenceEffect):
    """Values in the unit of the quantity."""

    belongs_to = "dispersion"
