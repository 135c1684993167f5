"""What stands at the centre of the simulated rig: an object, air, a mirror or a diffuser, as a true Mueller image."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, RootModel

from processing.arrays import RealArray
from processing.geometry.frames import GeometryImage
from processing.geometry.viewing import ViewingGeometry
from processing.polarization import mueller, triply_degenerate
from processing.reflectance.base import ReflectanceModel, load_reflectance
from processing.section import Section
from processing.yaml_file import ConfigError, load_yaml
from simulators.bench.scattering_laws import M00Law, Xi0Law, split_eigenvalues
from simulators.bench.traced_surface import trace_surface

BLOCK_PIXELS = 1 << 17

#: Mueller matrix of what fills the whole frame, up to its throughput.
IDEAL = {"air": np.eye(4), "mirror": mueller.IDEAL_MIRROR, "flat": mueller.IDEAL_DEPOLARIZER}


class SceneError(ConfigError):
    """The scene cannot be seen as asked; the message says why and what to do."""


class Surface(Section):
    """What the object's surface does at one wavelength.

    `eigenvalue_deviation` takes the three small coherency eigenvalues apart by up to this much, growing
    as sin(theta_h): a surface that no TD model describes. 0 keeps it triply degenerate.
    """

    xi0: Xi0Law = Field(description="law of the largest coherency eigenvalue")
    m00: M00Law = Field(description="law of the throughput")
    eigenvalue_deviation: float = Field(
        default=0.0, ge=0, lt=0.25, description="what the three small eigenvalues differ by"
    )


class ObjectScene(Section):
    """An object with a reflectance model as its dominant process, before a background that reflects nothing.

    `material` is a file, relative to the scene's. `background_m00` is a perfectly depolarizing background.
    """

    kind: Literal["object"]
    name: str = Field(description="name that messages and other files use")
    geometry: ViewingGeometry = Field(description="camera, source and shape")
    material: str = Field(description="material file, relative to this file")
    surface: dict[float, Surface] = Field(description="laws of depolarization and brightness")
    background_m00: float = Field(default=0.0, ge=0, description="throughput beside the object")


class AirScene(Section):
    """Nothing: M is the identity, seen where the source stands opposite to the camera (180 degrees)."""

    kind: Literal["air"]
    name: str = Field(default="air", description="name that messages and other files use")
    throughput: float = Field(default=1.0, gt=0, le=1, description="factor on the light")


class MirrorScene(Section):
    """An ideal flat mirror that fills the frame and turns with the arm: M = diag(1, 1, -1, -1)."""

    kind: Literal["mirror"]
    name: str = Field(default="mirror", description="name that messages and other files use")
    throughput: float = Field(default=1.0, gt=0, le=1, description="factor on the light")


class FlatScene(Section):
    """An even white diffuser that fills the frame, for flat fields: it depolarizes perfectly, M = diag(1, 0, 0, 0)."""

    kind: Literal["flat"] = "flat"
    name: str = Field(default="white_diffuser", description="name that messages and other files use")
    throughput: float = Field(default=0.5, gt=0, le=1, description="factor on the light")


AnyScene = Annotated[ObjectScene | AirScene | MirrorScene | FlatScene, Field(discriminator="kind")]


class _SceneFile(RootModel[AnyScene]):
    pass


@dataclass(frozen=True)
class SceneTruth:
    """The true result of a measurement.

    Attributes
    ----------
    xi0, m00 : (rows, columns), NaN outside the mask.
    mask : (rows, columns), pixels that see a lit point of the sample.
    geometry : of those pixels; None without an object.
    """

    xi0: RealArray
    m00: RealArray
    mask: NDArray[np.bool_]
    geometry: GeometryImage | None


class Scene:
    """A scene that answers with true Mueller images, in the instrument frames, throughput included.

    Examples
    --------
    >>> from acquisition import Scene
    >>> scene = Scene.load("scenes/air.yaml")
    >>> scene.mueller_image(omega_deg=180, wavelength_nm=662, rows=24, columns=32).shape
    (24, 32, 4, 4)
    """

    def __init__(self, spec: AnyScene, material: ReflectanceModel | None = None) -> None:
        if isinstance(spec, ObjectScene) and material is None:
            raise ValueError("an object scene needs its reflectance model")
        self.spec = spec
        self.material = material
        #: What light meets: the material's physics by another way than the one that the processing takes.
        self.optics = None if material is None else trace_surface(material)

    @classmethod
    def load(cls, path: Path | str) -> "Scene":
        """Read a scene file and the material it names. Raises ConfigError with file, line and key."""
        spec = load_yaml(path, _SceneFile).root
        material = None
        if isinstance(spec, ObjectScene):
            folder = Path(path).parent
            material = load_reflectance(folder / spec.material)
            spec = spec.model_copy(update={"geometry": spec.geometry.relative_to(folder)})
        return cls(spec, material)

    @property
    def name(self) -> str:
        """Name for headers and reports."""
        return self.spec.name

    @property
    def object(self) -> ObjectScene:
        """The object's description. Raises SceneError for air, mirror and flat."""
        if not isinstance(self.spec, ObjectScene):
            raise SceneError(f"scene {self.name!r} is {self.spec.kind} and has no object")
        return self.spec

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """True Mueller image (rows, columns, 4, 4), float32, throughput included.

        Raises
        ------
        SceneError
            No light reaches the camera at this arm angle.
        ConfigError
            The scene or its material has no values at this wavelength.
        """
        spec = self.spec
        if not isinstance(spec, ObjectScene):
            _check_angle(spec, omega_deg)
            ideal = IDEAL[spec.kind]
            return np.tile((spec.throughput * ideal).astype(np.float32), (rows, columns, 1, 1))
        out = np.zeros((rows, columns, 4, 4), dtype=np.float32)
        out[..., 0, 0] = spec.background_m00
        surface = self._surface(spec, wavelength_nm)
        for block in _row_blocks(rows, columns):
            image = spec.geometry.at(omega_deg, rows, columns, block)
            out[block][image.visible] = 0.0
            if image.mask.any():
                out[block][image.mask] = self._points(surface, image, wavelength_nm)
        return out

    def truth(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> SceneTruth:
        """xi0, M00, mask and geometry of each pixel. Raises as `mueller_image`."""
        spec = self.spec
        if not isinstance(spec, ObjectScene):
            _check_angle(spec, omega_deg)
            full = np.ones((rows, columns))
            xi0 = 0.25 if isinstance(spec, FlatScene) else 1.0
            return SceneTruth(xi0 * full, spec.throughput * full, full > 0, None)
        surface = self._surface(spec, wavelength_nm)
        image = spec.geometry.at(omega_deg, rows, columns)
        return SceneTruth(
            xi0=image.fill(surface.xi0(image.points)),
            m00=image.fill(surface.m00(image.points)),
            mask=image.mask,
            geometry=image,
        )

    def _surface(self, spec: ObjectScene, wavelength_nm: float) -> Surface:
        for key, value in spec.surface.items():
            if abs(key - wavelength_nm) < 0.5:
                return value
        listing = ", ".join(f"{k:g}" for k in spec.surface)
        raise ConfigError(f"scene {spec.name!r} is given at {listing} nm, not at {wavelength_nm:g} nm")

    def _points(self, surface: Surface, image: GeometryImage, wavelength_nm: float) -> RealArray:
        optics = self.optics
        if optics is None:
            raise ValueError("an object scene needs its reflectance model")
        points = image.points
        xi0 = surface.xi0(points)
        m = triply_degenerate.mueller_matrix(optics.mueller_jones(points, wavelength_nm), xi0, surface.m00(points))
        if surface.eigenvalue_deviation == 0:
            return m
        small = (1 - xi0) / 3
        # Stays a physical matrix whose largest eigenvalue is still xi0.
        limit = 0.9 * np.minimum(small, np.abs(xi0 - small))
        shift = np.minimum(surface.eigenvalue_deviation * np.sin(points.angles.theta_h), limit)
        return split_eigenvalues(np.asarray(m, dtype=float), optics.jones(points, wavelength_nm), shift)


def _check_angle(spec: AirScene | MirrorScene | FlatScene, omega_deg: float) -> None:
    if isinstance(spec, AirScene) and abs(abs(omega_deg) - 180) > 0.5:
        raise SceneError(
            f"air sends no light to the camera at omega {omega_deg:g} degrees. "
            "Go to 180 degrees, or choose another scene."
        )
    if not isinstance(spec, AirScene) and abs(omega_deg) > 170:
        raise SceneError(
            f"the {spec.kind} cannot send light to the camera at omega {omega_deg:g} degrees: it would stand edge-on. "
            "Stay within 170 degrees."
        )


def _row_blocks(rows: int, columns: int) -> Iterator[slice]:
    step = max(1, BLOCK_PIXELS // max(columns, 1))
    for start in range(0, rows, step):
        yield slice(start, min(start + step, rows))
