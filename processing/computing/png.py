"""A picture for a page or a file, as PNG."""

from io import BytesIO
from typing import Any

from numpy.typing import NDArray


def png(image: NDArray[Any]) -> bytes:
    """Grey (rows, columns) or red, green and blue (rows, columns, 3) of 8 bits."""
    from PIL import Image

    out = BytesIO()
    # A page waits for it: the quickest level.
    Image.fromarray(image).save(out, "PNG", compress_level=1)
    return out.getvalue()
