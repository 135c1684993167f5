"""What can be wrong with an object on its mount, the arm and the illumination: scenes and optics that do not say so.

Each takes the scene (or the optics) that the processing believes in and returns the true one.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.geometry.frames import ScatteringGeometry, dot, unit
from processing.geometry.sphere import Sphere
from processing.instrument.model import InstrumentModel, Polarizer, Retarder
from processing.polarization import mueller, triply_degenerate
from processing.reflectance import first_surface
from simulators.bench.bench import SceneImage
from simulators.bench.scene import Scene, Surface


def moved_sphere(scene: Scene, x_mm: float = 0.0, y_mm: float = 0.0, scale: float = 0.0) -> Scene:
    """The sphere stands off the centre of rotation, and is larger by this part of its radius."""
    geometry = scene.object.geometry
    if not isinstance(geometry.shape, Sphere):
        raise ValueError("only a sphere can be moved")
    sphere = Sphere(radius_mm=geometry.shape.radius_mm * (1 + scale), centre_mm=(x_mm, y_mm, 0.0))
    spec = scene.object.model_copy(update={"geometry": geometry.model_copy(update={"shape": sphere})})
    return Scene(spec, scene.material)


class ArmZeroFault:
    """The arm stands `error_deg` further round than it reads."""

    def __init__(self, scene: SceneImage, error_deg: float) -> None:
        self.scene, self.error_deg = scene, error_deg

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """The scene at the true angle."""
        return self.scene.mueller_image(omega_deg + self.error_deg, wavelength_nm, rows, columns)


def turned_generator(instrument: InstrumentModel, error_deg: float) -> InstrumentModel:
    """Every element of the generator stands turned about the beam, as one unit that was put in askew."""
    return instrument.model_copy(update={"generator": _turned(instrument.generator, error_deg)})


def turned_analyzer(instrument: InstrumentModel, error_deg: float) -> InstrumentModel:
    """The whole analyzer, with the polarizers of all channels, turned about the beam; the image stays upright."""
    channels = tuple(c.model_copy(update={"elements": _turned(c.elements, error_deg)}) for c in instrument.channels)
    analyzer = _turned(instrument.analyzer, error_deg)
    return instrument.model_copy(update={"analyzer": analyzer, "channels": channels})


def _turned(elements: tuple[Any, ...], error_deg: float) -> tuple[Any, ...]:
    train = []
    for element in elements:
        if not isinstance(element, Polarizer | Retarder):
            raise ValueError(f"a {element.kind} cannot be turned")
        azimuth = element.azimuth_deg
        new = {k: v + error_deg for k, v in azimuth.items()} if isinstance(azimuth, dict) else azimuth + error_deg
        train.append(element.model_copy(update={"azimuth_deg": new}))
    return tuple(train)


class LitSupport:
    """A white disc below the sphere, lit by the source, lights the sphere's lower side with depolarized light.

    The disc is a Lambertian of albedo 1 in patches; each patch's light meets the same surface, whose triply degenerate
    matrix then acts on unpolarized light. `strength` is the disc's irradiance over that on the sphere; `uneven` by how
    much the irradiance differs at the disc's edge, along x and along z.
    """

    PATCHES = 24

    def __init__(
        self,
        scene: Scene,
        strength: float = 1.0,
        radius_mm: float = 20.0,
        below_mm: float = 30.0,
        *,
        uneven: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.scene, self.strength = scene, strength
        rings = np.sqrt((np.arange(self.PATCHES) + 0.5) / self.PATCHES) * radius_mm
        turns = np.pi * (3 - np.sqrt(5)) * np.arange(self.PATCHES)
        height = np.full(self.PATCHES, -below_mm)
        self.patches = np.stack([rings * np.cos(turns), height, rings * np.sin(turns)], axis=1)
        self.area_mm2 = np.pi * radius_mm**2 / self.PATCHES
        self.brightness = np.maximum(1 + self.patches[:, ::2] @ np.array(uneven) / radius_mm, 0.0)

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """The scene, and the disc's light on it."""
        out = self.scene.mueller_image(omega_deg, wavelength_nm, rows, columns)
        spec = self.scene.object
        image = spec.geometry.at(omega_deg, rows, columns)
        surface = _surface(self.scene, wavelength_nm)
        g = image.points
        centre = spec.geometry.shape.centre_mm if isinstance(spec.geometry.shape, Sphere) else (0.0, 0.0, 0.0)
        radius = spec.geometry.shape.radius_mm if isinstance(spec.geometry.shape, Sphere) else 0.0
        points = np.asarray(centre) + radius * g.normal
        added = np.zeros((len(points), 4, 4))
        for patch, brightness in zip(self.patches, self.brightness, strict=True):
            towards = patch - points
            square = dot(towards, towards)
            direction = towards / np.sqrt(square)[:, None]
            # The surface's own law holds the cosine of incidence on it.
            cosine = (dot(g.normal, direction) > 0) * np.maximum(-direction[:, 1], 0.0)
            weight = self.strength * brightness * self.area_mm2 / np.pi * cosine / square
            from_patch = ScatteringGeometry(g.normal, direction, g.to_camera)
            m = _triply_degenerate(self.scene, surface, from_patch, wavelength_nm)
            m[..., 1:] = 0.0
            added += weight[:, None, None] * m
        out[image.mask] += added.astype(np.float32)
        return out


class Dented:
    """A sphere whose normals wave by `amplitude_deg`, `waves` times over its width: no sphere for polarization."""

    def __init__(self, scene: Scene, amplitude_deg: float, waves: float) -> None:
        self.scene, self.amplitude_deg, self.waves = scene, amplitude_deg, waves

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """The scene with bent normals."""
        image = self.scene.object.geometry.at(omega_deg, rows, columns)
        g = image.points
        tilt = np.deg2rad(self.amplitude_deg) * np.sin(np.pi * self.waves * (g.normal[:, 0] + 0.6 * g.normal[:, 1]))
        bent = unit(g.normal + tilt[:, None] * np.array([0.5, 0.8, 0.0]))
        points = ScatteringGeometry(bent, g.to_source, g.to_camera)
        out = np.zeros((rows, columns, 4, 4), dtype=np.float32)
        out[image.mask] = _triply_degenerate(self.scene, _surface(self.scene, wavelength_nm), points, wavelength_nm)
        return out


class SecondLamp:
    """A second source at another arm angle, with the same polarization, `strength` times as bright."""

    def __init__(self, scene: Scene, omega_deg: float, strength: float) -> None:
        self.scene, self.omega_deg, self.strength = scene, omega_deg, strength

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """The scene lit from both."""
        first = self.scene.mueller_image(omega_deg, wavelength_nm, rows, columns)
        second = self.scene.mueller_image(self.omega_deg, wavelength_nm, rows, columns)
        return np.asarray(first + np.float32(self.strength) * second)


class SlowTurn:
    """Strained glass before the sphere turns the illumination by an angle that waves over the image."""

    def __init__(self, scene: Scene, amplitude_deg: float) -> None:
        self.scene, self.amplitude_deg = scene, amplitude_deg

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """The scene behind the glass."""
        m = self.scene.mueller_image(omega_deg, wavelength_nm, rows, columns)
        y, x = np.mgrid[-1 : 1 : rows * 1j, -1 : 1 : columns * 1j]
        turn = np.deg2rad(self.amplitude_deg) * np.sin(3 * x + 5 * y)
        return np.asarray(m @ mueller.rotation(turn), dtype=np.float32)


class WetPatch:
    """A round patch of the sphere carries water: first-surface reflection at its index, without the diffuse term."""

    WATER = 1.33

    def __init__(self, scene: Scene, right_deg: float, up_deg: float, radius_deg: float) -> None:
        constants = {nm: first_surface.Constants(n=self.WATER) for nm in scene.object.surface}
        self.dry, self.wet = scene, Scene(scene.spec, first_surface.Model(name="water", constants=constants))
        x, y = np.deg2rad(right_deg), np.deg2rad(up_deg)
        self.axis = np.array([np.sin(x) * np.cos(y), np.sin(y), np.cos(x) * np.cos(y)])
        self.radius_deg = radius_deg

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """The scene, wet where the patch is."""
        image = self.dry.object.geometry.at(omega_deg, rows, columns)
        patch = np.zeros((rows, columns), dtype=bool)
        patch[image.mask] = image.points.normal @ self.axis > np.cos(np.deg2rad(self.radius_deg))
        dry, wet = (s.mueller_image(omega_deg, wavelength_nm, rows, columns) for s in (self.dry, self.wet))
        return np.where(patch[..., None, None], wet, dry)


class BroadSource:
    """The source is a bar `width_deg` wide as seen from the object, where a point is meant."""

    PARTS = 5

    def __init__(self, scene: Scene, width_deg: float) -> None:
        self.scene, self.width_deg = scene, width_deg

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float32]:
        """Mean of the scene over the source."""
        places = omega_deg + self.width_deg * ((np.arange(self.PARTS) + 0.5) / self.PARTS - 0.5)
        parts = [self.scene.mueller_image(float(w), wavelength_nm, rows, columns) for w in places]
        return np.asarray(np.mean(parts, axis=0, dtype=np.float32))


def _surface(scene: Scene, wavelength_nm: float) -> Surface:
    return next(s for nm, s in scene.object.surface.items() if abs(nm - wavelength_nm) < 0.5)


def _triply_degenerate(scene: Scene, surface: Surface, points: ScatteringGeometry, wavelength_nm: float) -> Array:
    if scene.optics is None:
        raise ValueError("an object scene needs its reflectance model")
    m0 = scene.optics.mueller_jones(points, wavelength_nm)
    xi0, m00 = surface.xi0(points), surface.m00(points)
    return np.array(triply_degenerate.mueller_matrix(m0, xi0, m00), dtype=float)
