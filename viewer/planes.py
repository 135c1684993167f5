"""Reduced reads: any part of a frame or of a map, with no more pixels than a screen shows."""

import json
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from starlette.responses import Response

from processing.errors import ProcessError

#: Most pixels along a side of one picture.
MOST = 1024


@dataclass(frozen=True)
class Window:
    """Part of an image: rows and columns from the first to the one after the last, and the step between those shown.

    Attributes
    ----------
    step : 1 where every pixel is shown.
    """

    rows: slice
    columns: slice
    step: int

    @classmethod
    def parse(cls, query: Any, shape: tuple[int, int], most: int = MOST) -> "Window":
        """The part that a request asks for with x0, x1, y0, y1 and most; default: all of it.

        Raises ProcessError: they are no numbers.
        """
        try:
            y0, y1 = (float(query.get(name, default)) for name, default in (("y0", 0), ("y1", shape[0])))
            x0, x1 = (float(query.get(name, default)) for name, default in (("x0", 0), ("x1", shape[1])))
            most = min(max(int(query.get("most", most)), 16), MOST)
            rows, columns = _inside(y0, y1, shape[0]), _inside(x0, x1, shape[1])
        except (ValueError, OverflowError) as error:
            raise ProcessError(f"x0, x1, y0, y1 and most must be numbers ({error})") from error
        step = max(1, -(-max(rows.stop - rows.start, columns.stop - columns.start) // most))
        return cls(rows, columns, step)

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the picture that is sent."""
        return (
            -(-(self.rows.stop - self.rows.start) // self.step),
            -(-(self.columns.stop - self.columns.start) // self.step),
        )

    def every(self, image: NDArray[Any]) -> NDArray[Any]:
        """Every step-th pixel of an image (..., rows of the window, all columns)."""
        return image[..., :: self.step, self.columns][..., :: self.step]

    def mean(self, image: NDArray[Any]) -> NDArray[np.float32]:
        """Means of blocks of step x step pixels of an image (rows of the window, all columns)."""
        part = np.ascontiguousarray(image[:, self.columns], dtype=np.float32)
        if self.step == 1:
            return part
        pixels = (np.diff([*range(0, size, self.step), size]).astype(np.float32) for size in part.shape)
        return np.asarray(self._blocks(np.add, part) / np.outer(*pixels))

    def largest(self, image: NDArray[Any]) -> NDArray[Any]:
        """The largest of each block of step x step pixels: a single saturated pixel shows however far one is away."""
        part = np.ascontiguousarray(image[:, self.columns])
        if self.step == 1:
            return part
        return self._blocks(np.maximum, part)

    def _blocks(self, whole: np.ufunc, part: NDArray[Any]) -> NDArray[Any]:
        for axis in (0, 1):
            part = whole.reduceat(part, range(0, part.shape[axis], self.step), axis=axis)
        return part


def _inside(first: float, last: float, length: int) -> slice:
    start = min(max(math.floor(first), 0), length - 1)
    return slice(start, min(max(math.ceil(last), start + 1), length))


def plane_response(window: Window, image: NDArray[Any], **facts: Any) -> Response:
    """A picture as numbers: 4-byte floats row by row, the rest as JSON in a header."""
    header = {
        "x0": window.columns.start,
        "y0": window.rows.start,
        "step": window.step,
        "rows": image.shape[-2],
        "columns": image.shape[-1],
        **facts,
    }
    body = np.ascontiguousarray(image, dtype="<f4").tobytes()
    return Response(body, media_type="application/octet-stream", headers={"X-Plane": json.dumps(header)})
