"""The optical bench: scene, true optics and true axis angles in, camera counts out.

electrons = flux * exposure * (a . M . g) per pixel, with the true instrument; then dark current, shot noise, full
well, read noise, gain, black level and digitizing. Random numbers come from (seed, exposure index), never from time:
the same plan and seed give the same frames byte for byte, unless an effect changes with time.
"""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from processing.arrays import Image
from processing.instrument.applied_effects import changes_at
from processing.instrument.model import InstrumentModel
from processing.storage.captures.schema import Detector
from simulators.bench.effects.base import BenchEffect, Shot

#: The IMX250 and kin, rounded: 12 bits, 10.5 ke full well, 2.3 e read noise.
DETECTOR = Detector(black_level_counts=64.0, gain_e_per_count=2.6, read_noise_e=2.3, full_well_e=10_500.0, bits=12)
DARK_CURRENT_E_PER_S = 2.0
BLOCK_PIXELS = 1 << 16
#: From one exposure to the next where no times are given.
STATE_PERIOD_S = 1.0


class SceneImage(Protocol):
    """Something to look at; `simulators.bench.scene.Scene` is one."""

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.floating]:
        """Mueller matrices (rows, columns, 4, 4) in the instrument frames."""


class FixedScene:
    """The same Mueller image (rows, columns, 4, 4), or one matrix (4, 4) all over, from every side."""

    def __init__(self, mueller: ArrayLike) -> None:
        self.mueller = np.asarray(mueller, dtype=np.float64)

    def mueller_image(self, omega_deg: float, wavelength_nm: float, rows: int, columns: int) -> NDArray[np.float64]:
        """The image itself; ValueError if it has another size."""
        if self.mueller.ndim == 4 and self.mueller.shape[:2] != (rows, columns):
            raise ValueError(f"the scene has {self.mueller.shape[:2]} pixels, the camera {rows} x {columns}")
        return np.broadcast_to(self.mueller, (rows, columns, 4, 4))


class SimulatedBench:
    """Turns true angles into frames.

    Parameters
    ----------
    scene : SceneImage
    instrument : InstrumentModel
        The optics as they really are; the capture may declare another model.
    wavelength_nm : float
    rows, columns : int
        Pixels of the camera.
    detector : Detector
        Noise constants; gain, read noise, full well and bits must be given.
    flux_e_per_s : float
        Electrons a second for a . M . g = 1.
    seed : int
    effects : sequence of BenchEffect
        What happens on the bench besides; applied in this order within a stage.

    Examples
    --------
    >>> from acquisition import Scene, SimulatedBench
    >>> optics = InstrumentModel.load("instrument.yaml")
    >>> bench = SimulatedBench(Scene.load("scenes/air.yaml"), optics, 662, rows=24, columns=32)
    >>> bench.expose({"psg": 0.0, "psa": 0.0}, 0.02, index=0, light=False).shape
    (24, 32)
    """

    def __init__(
        self,
        scene: SceneImage,
        instrument: InstrumentModel,
        wavelength_nm: float,
        *,
        rows: int = 600,
        columns: int = 600,
        detector: Detector = DETECTOR,
        flux_e_per_s: float = 1e6,
        dark_current_e_per_s: float = DARK_CURRENT_E_PER_S,
        seed: int = 0,
        effects: Sequence[BenchEffect] = (),
    ) -> None:
        if detector.gain_e_per_count is None or detector.bits is None:
            raise ValueError("a simulated detector needs gain_e_per_count and bits")
        self.rows, self.columns = rows, columns
        self.detector = detector
        self.flux_e_per_s = flux_e_per_s
        self.dark_current_e_per_s = dark_current_e_per_s
        self.seed = seed
        self.effects = tuple(effects)
        self._scene_key: tuple[float, float] | None = None
        self.put(scene, instrument, wavelength_nm)

    def put(self, scene: SceneImage, instrument: InstrumentModel, wavelength_nm: float) -> None:
        """Another sample, other optics, another wavelength."""
        self.scene = scene
        self.instrument = instrument.at(wavelength_nm)
        self.wavelength_nm = wavelength_nm
        self._scene_key = None

    def look(self, omega_deg: float) -> None:
        """Compute the scene for an arm angle ahead of the exposures there."""
        self._planes(omega_deg)

    def expose(
        self,
        angles_deg: Mapping[str, float],
        exposure_s: float,
        index: int,
        *,
        light: float = 1.0,
        omega_deg: float = 180.0,
        time_s: float | None = None,
    ) -> NDArray[np.uint16]:
        """Counts of one exposure.

        Parameters
        ----------
        angles_deg : true angle of each axis that the instrument names, degrees.
        index : number of the exposure; it seeds the noise.
        light : of the source, as a fraction of its nominal light; 0 with the shutter closed.
        omega_deg : true angle of the arm, unless `angles_deg` has "arm".
        time_s : when it is, for effects that change with time; default: `STATE_PERIOD_S` from one index to the next.

        Returns
        -------
        ndarray of uint16, (rows, columns), or (channels, rows, columns) with several channels that do not share the
        detector as a mosaic or as beams side by side.
        """
        expected, shot = self._expected(angles_deg, exposure_s, index, light, omega_deg=omega_deg, time_s=time_s)
        random = np.random.default_rng([self.seed, index + (1 << 31)])
        expected += np.float32(self.dark_current_e_per_s * exposure_s)
        electrons = random.poisson(np.maximum(expected, 0)).astype(np.float32)
        for effect in self.effects:
            electrons = effect.detector(electrons, shot)
        return self._digitize(electrons, random)

    def expected_electrons(
        self,
        angles_deg: Mapping[str, float],
        exposure_s: float,
        index: int = 0,
        *,
        light: float = 1.0,
        omega_deg: float = 180.0,
    ) -> Image:
        """Expected photo-electrons of an exposure, without dark current and noise; same shape as `expose`."""
        return self._expected(angles_deg, exposure_s, index, light, omega_deg=omega_deg, time_s=None)[0]

    def _expected(
        self,
        angles_deg: Mapping[str, float],
        exposure_s: float,
        index: int,
        light: float,
        *,
        omega_deg: float,
        time_s: float | None,
    ) -> tuple[Image, Shot]:
        angles = dict(angles_deg)
        time_s = index * STATE_PERIOD_S if time_s is None else time_s
        shot = Shot(index, exposure_s, time_s, self.seed, dict(angles), float(light))
        model = self.instrument
        for effect in self.effects:
            angles = effect.angles(angles, shot)
            model = effect.train(model, shot)
        level = float(light)
        for effect in self.effects:
            level = effect.source(level, shot)
        shared = model.mosaic is not None or model.beams is not None
        shape = (self.rows, self.columns) if shared or len(model.channels) == 1 else None
        image = np.zeros(shape or (len(model.channels), self.rows, self.columns), dtype=np.float32)
        if light:
            axes = {name: [angles[name]] for name in model.axes} or {"none": [0.0]}

            def seen(optics: InstrumentModel) -> Image:
                weights = optics.rows(axes, changes_at(optics, axes))[0] * (level * self.flux_e_per_s * exposure_s)
                through = np.zeros_like(image)
                self._render(through, weights.astype(np.float32), optics, float(angles.get("arm", omega_deg)))
                return through

            image = seen(model)
            for effect in self.effects:
                image = effect.field(image, model, seen)
        for effect in self.effects:
            # Stray light comes from the source too: with the shutter closed it is dark everywhere.
            image = effect.optics(image, shot) if light else image
        return image, shot

    def _render(self, image: Image, weights: NDArray[np.float32], model: InstrumentModel, omega_deg: float) -> None:
        planes = self._planes(omega_deg)
        if model.mosaic is None:
            # One camera, or beams side by side on one, are strips of its frame.
            stack = image if image.ndim == 3 else np.hsplit(image, self.columns // planes.shape[-1])
            for channel, row in zip(stack, weights, strict=True):
                _add_product(channel, row, planes)
            return
        names = [c.name for c in model.channels]
        height, width = len(model.mosaic), len(model.mosaic[0])
        for r, line in enumerate(model.mosaic):
            for c, name in enumerate(line):
                pixels = (slice(r, None, height), slice(c, None, width))
                _add_product(image[pixels], weights[names.index(name)], planes[(slice(None), *pixels)])

    def _planes(self, omega_deg: float) -> NDArray[np.float32]:
        """Scene as (16, rows, columns of a beam), computed anew when the arm has moved by more than 0.01 degrees."""
        beams = self.instrument.beams
        columns = self.columns // len(beams) if beams else self.columns
        key = (round(omega_deg, 2), self.wavelength_nm)
        if key != self._scene_key:
            mueller = self.scene.mueller_image(key[0], self.wavelength_nm, self.rows, columns)
            flat = np.asarray(mueller, dtype=np.float32).reshape(self.rows, columns, 16)
            self._scene_planes = np.ascontiguousarray(np.moveaxis(flat, -1, 0))
            self._scene_key = key
        return self._scene_planes

    def _digitize(self, electrons: Image, random: np.random.Generator) -> NDArray[np.uint16]:
        d = self.detector
        gain, bits = d.gain_e_per_count or 1.0, d.bits or 16
        if d.full_well_e is not None:
            np.minimum(electrons, np.float32(d.full_well_e), out=electrons)
        if d.read_noise_e:
            electrons += np.float32(d.read_noise_e) * random.standard_normal(electrons.shape, dtype=np.float32)
        counts = electrons / np.float32(gain) + np.float32(d.black_level_counts)
        digital: NDArray[np.uint16] = np.clip(np.rint(counts), 0, (1 << bits) - 1).astype(np.uint16)
        return digital


def _add_product(out: NDArray[np.float32], row: NDArray[np.float32], planes: NDArray[np.float32]) -> None:
    # Element by element instead of BLAS: the order of the sum, and so every byte, is the same on any machine.
    # In blocks of rows that stay in the cache over the sixteen elements.
    rows = max(1, BLOCK_PIXELS // max(1, out.shape[-1]))
    term = np.empty((rows, out.shape[-1]), dtype=np.float32)
    for start in range(0, out.shape[0], rows):
        block = out[start : start + rows]
        product = term[: block.shape[0]]
        for weight, plane in zip(row, planes, strict=True):
            if weight != 0:
                np.multiply(plane[start : start + rows], weight, out=product)
                block += product
