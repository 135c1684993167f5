"""Requirements of every reflectance model: physical, reciprocal matrices, equal by both routes, read from a file."""

from pathlib import Path
from typing import ClassVar

import numpy as np

from processing.geometry.frames import ScatteringGeometry, unit
from processing.polarization import mueller
from processing.reflectance.base import ReflectanceModel, load_reflectance


class ReflectanceConformance:
    """Tests of a reflectance model.

    Attributes
    ----------
    material : text of a material file of the model.
    wavelength_nm : one at which that material is given.
    """

    material: ClassVar[str] = ""
    wavelength_nm: ClassVar[float] = 662.0

    def model(self, folder: Path) -> ReflectanceModel:
        """The model as a material file gives it."""
        path = folder / "material.yaml"
        path.write_text(self.material, encoding="utf-8")
        loaded: ReflectanceModel = load_reflectance(path)
        return loaded

    def test_it_gives_physical_mueller_jones_matrices(self, tmp_path: Path) -> None:
        m = self.model(tmp_path).mueller_jones(random_geometry(300), self.wavelength_nm)
        values = np.linalg.eigvalsh(mueller.coherency(m)) / 2
        np.testing.assert_allclose(m[:, 0, 0], 1)
        np.testing.assert_allclose(values[:, 3], 1, atol=1e-12)
        np.testing.assert_allclose(values[:, :3], 0, atol=1e-12)

    def test_it_is_reciprocal(self, tmp_path: Path) -> None:
        # Each beam runs backwards: its x turns round, y stays.
        flip = np.diag([1.0, 1.0, -1.0, 1.0])
        model, geometry = self.model(tmp_path), random_geometry(300)
        forward = model.mueller_jones(geometry, self.wavelength_nm)
        backward = model.mueller_jones(geometry.reversed(), self.wavelength_nm)
        np.testing.assert_allclose(backward, flip @ np.swapaxes(forward, -1, -2) @ flip, atol=1e-11)

    def test_jones_and_mueller_agree(self, tmp_path: Path) -> None:
        model, geometry = self.model(tmp_path), random_geometry(50)
        m = mueller.from_jones(model.jones(geometry, self.wavelength_nm))
        np.testing.assert_allclose(model.mueller_jones(geometry, self.wavelength_nm), m / m[:, :1, :1], atol=1e-12)


def random_geometry(count: int) -> ScatteringGeometry:
    """Random normals with source and camera on their side; the same each time."""
    random = np.random.default_rng(0)
    normal = unit(random.normal(size=(count, 3)))
    sides = []
    for _ in range(2):
        side = unit(random.normal(size=normal.shape))
        sides.append(side * np.sign(np.sum(side * normal, axis=-1))[:, None])
    return ScatteringGeometry(normal, *sides)
