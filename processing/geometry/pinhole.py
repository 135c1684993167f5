"""The camera as a pinhole: focal length, pixel pitch, distance, distortion."""

import numpy as np
from pydantic import Field

from processing.arrays import Array
from processing.section import Section


class PinholeCamera(Section):
    """A camera on the +z axis that looks at the centre of rotation; columns grow with +x, rows with -y.

    `centre_px` is (row, column) of the optical axis; None is the middle of the frame. `distortion` holds
    OpenCV's (k1, k2, p1, p2, k3).
    """

    rows: int = Field(gt=0, description="pixels from top to bottom")
    columns: int = Field(gt=0, description="pixels from left to right")
    pixel_mm: float = Field(gt=0, description="side of a pixel, mm")
    focal_length_mm: float = Field(gt=0, description="focal length, mm")
    distance_mm: float = Field(gt=0, description="camera to centre of rotation, mm")
    centre_px: tuple[float, float] | None = Field(default=None, description="pixel on the optical axis, (column, row)")
    distortion: tuple[float, ...] = Field(default=(), max_length=5, description="radial and tangential coefficients")
    #: Standard errors of a calibration, by key; empty when stated and not measured.
    stderr: dict[str, float] = Field(default={}, description="standard errors of what was fitted")

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self.focal_length_mm / self.pixel_mm

    @property
    def axis_px(self) -> tuple[float, float]:
        """(row, column) of the optical axis."""
        return self.centre_px if self.centre_px is not None else ((self.rows - 1) / 2, (self.columns - 1) / 2)

    @property
    def position_mm(self) -> Array:
        """(3,), centre of projection in the world, mm."""
        return np.array([0.0, 0.0, self.distance_mm])

    def resized(self, rows: int, columns: int) -> "PinholeCamera":
        """The same lens and field of view in height, with another number of pixels."""
        zoom = rows / self.rows
        row, column = self.axis_px
        # Pixel centres are at half-integers of the pixel grid, so offsets from the middle scale.
        centre = (
            (row - (self.rows - 1) / 2) * zoom + (rows - 1) / 2,
            (column - (self.columns - 1) / 2) * zoom + (columns - 1) / 2,
        )
        return self.model_copy(
            update={"rows": rows, "columns": columns, "pixel_mm": self.pixel_mm / zoom, "centre_px": centre}
        )

    def rays(self, rows: slice = slice(None)) -> Array:
        """Unit directions (rows, columns, 3) from the camera through each pixel of the rows asked for."""
        r = np.arange(self.rows)[rows].astype(float)
        c = np.arange(self.columns, dtype=float)
        row0, column0 = self.axis_px
        x = np.broadcast_to((c - column0) / self.focal_px, (r.size, c.size))
        y = np.broadcast_to(((row0 - r) / self.focal_px)[:, None], (r.size, c.size))
        if any(self.distortion):
            x, y = self._undistort(x, y)
        d = np.empty((r.size, c.size, 3))
        scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
        d[..., 0], d[..., 1], d[..., 2] = x * scale, y * scale, -scale
        return d

    def project(self, points_mm: Array) -> Array:
        """(row, column) of world points (..., 3) in mm."""
        p = np.asarray(points_mm, dtype=float)
        depth = self.distance_mm - p[..., 2]
        x, y = p[..., 0] / depth, p[..., 1] / depth
        if any(self.distortion):
            x, y = self._distort(x, y)
        row0, column0 = self.axis_px
        return np.stack([row0 - y * self.focal_px, column0 + x * self.focal_px], axis=-1)

    def _distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        # Brown-Conrady as in OpenCV's calib3d; OpenCV's y runs down, hence the sign of the tangential terms.
        k1, k2, p1, p2, k3 = (*self.distortion, *(0.0,) * (5 - len(self.distortion)))
        yd = -y
        r2 = x * x + yd * yd
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xx = x * radial + 2 * p1 * x * yd + p2 * (r2 + 2 * x * x)
        yy = yd * radial + p1 * (r2 + 2 * yd * yd) + 2 * p2 * x * yd
        return xx, -yy

    def _undistort(self, x: Array, y: Array) -> tuple[Array, Array]:
        # Fixed point of the forward map; converges for every distortion a real lens has.
        u, v = x, y
        for _ in range(20):
            dx, dy = self._distort(u, v)
            u, v = u + (x - dx), v + (y - dy)
        return u, v
