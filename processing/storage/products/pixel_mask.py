"""What is wrong with a pixel of a product, as bits."""

from enum import IntFlag


class Mask(IntFlag):
    """Bits of `pixel_flags` in every product; 0 is a good pixel."""

    SATURATED = 1  # some state was at the top of the range and was left out
    NOT_FINITE = 2  # some state has no number there
    BAD = 4  # listed as a bad pixel
    NOT_DETERMINED = 8  # too few states are left
    STRUCK = 16  # some state was struck there (cosmic ray) and was left out
    PARTLY = SATURATED | STRUCK  # solved from the states that are left

    @classmethod
    def meaning(cls) -> str:
        """The bits in words, for the file."""
        return ", ".join(f"{flag.value} = {flag.name.lower().replace('_', ' ')}" for flag in cls if flag.name)

    @classmethod
    def words(cls, bits: int) -> str:
        """What is wrong by these bits."""
        names = [flag.name.lower().replace("_", " ") for flag in cls if bits & flag and flag.name]
        return ", ".join(names) or "no reason given"
