"""The part of a frame that an option names."""

from processing.errors import ProcessError


def parse_region(text: str | None, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of r0:r1,c0:c1; without a text the middle half of the frame.

    Raises ProcessError: the text is no region, or not of this frame.
    """
    height, width = shape
    if text is None:
        return slice(height // 4, max(height - height // 4, 1)), slice(width // 4, max(width - width // 4, 1))
    try:
        (r0, r1), (c0, c1) = ((int(v) for v in part.split(":")) for part in text.split(","))
    except ValueError:
        raise ProcessError(f"--region {text}: write it as r0:r1,c0:c1, whole numbers") from None
    if not (0 <= r0 < r1 <= height and 0 <= c0 < c1 <= width):
        raise ProcessError(f"--region {text}: no part of a frame of {height} rows and {width} columns")
    return slice(r0, r1), slice(c0, c1)
