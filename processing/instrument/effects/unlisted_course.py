"""A fault of one capture that has no name, as a sentence: a quantity of an element that follows the time.

Cause: not known; the sentence gives its site and its course.
Mend: look at the element that the sentence names; take the capture again.
"""

from processing.instrument.effects._sentence import SentenceEffect
from processing.instrument.effects.base import OfOneCapture


class UnlistedCourse(SentenceEffect, OfOneCapture):
    """Values in the unit of the quantity."""
