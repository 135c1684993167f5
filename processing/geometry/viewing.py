"""Camera, source and object together: the scattering geometry of every pixel at an arm angle."""

from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field

from processing.arrays import Array
from processing.geometry.flat import Flat
from processing.geometry.frames import GeometryImage, ScatteringGeometry, dot, unit
from processing.geometry.mesh import Mesh
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.sphere import Sphere
from processing.section import Section
from processing.yaml_file import load_yaml

Shape = Annotated[Sphere | Flat | Mesh, Field(discriminator="kind")]


class ViewingGeometry(Section):
    """Where camera, source and object stand. The source's distance is from the centre of rotation.

    `arm_zero_deg` is what has to be added to the arm's reading (`diagnose --reflectance` finds it).

    Examples
    --------
    >>> geometry = ViewingGeometry.load("geometry.yaml")
    >>> geometry.shape.radius_mm, geometry.source_distance_mm
    (12.7, 672.7)
    """

    camera: PinholeCamera = Field(description="pinhole camera")
    source_distance_mm: float = Field(gt=0, description="source to centre of rotation, mm")
    shape: Shape = Field(description="shape of the object")
    arm_zero_deg: float = Field(default=0.0, description="what is added to the arm's reading, degrees")

    @classmethod
    def load(cls, path: Path | str) -> "ViewingGeometry":
        """Read a geometry file. Raises ConfigError with file, line and key."""
        return load_yaml(path, cls).relative_to(Path(path).parent)

    def relative_to(self, folder: Path) -> "ViewingGeometry":
        """The same geometry with the file of a mesh looked up from `folder`."""
        if not isinstance(self.shape, Mesh):
            return self
        return self.model_copy(update={"shape": self.shape.relative_to(folder)})

    def source_position_mm(self, omega_deg: float) -> Array:
        """(sin W, 0, cos W) times the source's distance, W being the arm's reading and its zero."""
        w = np.deg2rad(omega_deg + self.arm_zero_deg)
        return self.source_distance_mm * np.array([np.sin(w), 0.0, np.cos(w)])

    def at(
        self, omega_deg: float, rows: int | None = None, columns: int | None = None, block: slice = slice(None)
    ) -> GeometryImage:
        """Geometry of each pixel that sees a lit point.

        Parameters
        ----------
        omega_deg
            Angle between camera and source, degrees.
        rows, columns
            Image size; default, the camera's own.
        block
            Rows of the image to work out.
        """
        camera = self.camera
        if rows is not None and columns is not None:
            camera = camera.resized(rows, columns)
        eye = camera.position_mm
        hit, points, normal = self.shape.intersect(eye, camera.rays(block), omega_deg)
        to_source = unit(self.source_position_mm(omega_deg) - points)
        to_camera = unit(eye - points)
        lit = (dot(normal, to_source) > 0) & (dot(normal, to_camera) > 0)
        if lit.any():
            lit[lit] = ~self.shape.occluded(points[lit], to_source[lit])
        mask = hit.copy()
        mask[hit] = lit
        return GeometryImage(mask, ScatteringGeometry(normal[lit], to_source[lit], to_camera[lit]), hit)
