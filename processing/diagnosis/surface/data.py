"""Pixels of a capture that see the object, ready to be compared with the triply degenerate model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from processing.arrays import Array
from processing.diagnosis.captures.capture_data import CaptureData
from processing.diagnosis.captures.read_capture import read_capture
from processing.diagnosis.search.rules import FEWEST_OF_MANY, FOLDS_OF_TILES, SMALL, TILES
from processing.diagnosis.surface.view import SurfaceView
from processing.errors import ProcessError
from processing.geometry.pinhole import PinholeCamera
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.changes import Conditions
from processing.instrument.model import InstrumentModel
from processing.reduction.counts_to_signal import CountCorrection
from processing.reduction.noise import NoiseModel
from processing.reduction.sample_states import sample_states
from processing.reflectance.base import ReflectanceModel
from processing.storage.captures.capture import Capture

#: [pixels] Of an object that are used at most, evenly spread.
MOST_OF_OBJECT = 4000
#: [of its radius] Rim of an object that is left out: one off its place would mix object and background there.
RIM_OF_OBJECT = 0.06
#: [pixels of the camera] The same, at least: the interpolation of a mosaic mixes as many.
RIM_PX = 6


@dataclass(frozen=True)
class SurfaceData:
    """Pixels (P,) of one capture.

    Attributes
    ----------
    y : (P, L) signals of all states and channels over full scale.
    variance : (P, L) expected of their noise, from the signals themselves.
    slope, floor : (L,) variance of a signal u is slope * u + floor.
    exposure : (L,) relative exposure of each row.
    fold, tile : (P,).
    where : (P, 2) row and column of each pixel in an image of `shape`.
    """

    name: str
    view: SurfaceView
    y: Array
    variance: Array
    slope: Array
    floor: Array
    exposure: Array
    conditions: Conditions
    fold: NDArray[np.int64]
    tile: NDArray[np.int64]
    where: NDArray[np.int64]
    shape: tuple[int, int]
    noise: str
    simulated: bool
    wavelength_nm: float
    omega_deg: float
    clipped_fraction: float

    def select(self, pixels: NDArray[np.bool_]) -> SurfaceData:
        """The same with some of the pixels alone."""
        same = {name: getattr(self, name)[pixels] for name in ("y", "variance", "fold", "tile", "where")}
        return replace(self, view=self.view.select(pixels), **same)

    def polarized(self, flat: Array) -> NDArray[np.bool_]:
        """Pixels (P,) of the tiles whose light is modulated by more than the noise of a pixel.

        The others have no say in the dominant process: what they add to a sum over pixels is noise. `flat` (L,) is what
        depolarized light gives in each row. Nothing else is assumed of the sample.
        """
        sigma = np.sqrt(self.variance)
        y, e = self.y / sigma, flat / sigma
        e /= np.linalg.norm(e, axis=1, keepdims=True)
        modulation = np.sum(y**2, axis=1) - np.sum(e * y, axis=1) ** 2 - (y.shape[1] - 1)
        pixels = np.maximum(np.bincount(self.tile), 1)
        return np.asarray((np.bincount(self.tile, modulation) / pixels > 1)[self.tile])


def read_surface(
    capture: Capture, model: InstrumentModel, view: ViewingGeometry, material: ReflectanceModel
) -> SurfaceData:
    """Read the pixels of a capture that see the object.

    Raises ProcessError: no arm angle, no noise, or too few pixels of the object.
    """
    if capture.header.mode == "drr" and model.mosaic is not None:
        raise ProcessError(
            f"{capture.path}: a capture without mosaic, and the instrument {model.name!r} has one. Captures of two "
            "instruments are diagnosed one after the other, each with its own instrument file."
        )
    model = capture.adapt(model)
    data, omega = read_capture(capture, model), capture.header.omega_deg
    if omega is None:
        raise ProcessError(f"{capture.path}: the capture does not say its arm angle; import it with --omega-deg.")
    if not data.noise_known:
        raise ProcessError(
            f"{capture.path}: its noise is not known, and without it no effect of the reflectance can be told from "
            "chance. Give the detector's gain and read noise in the capture's header."
        )
    cell = 1 if model.mosaic is None else len(model.mosaic)
    signal, share = _at_cell_centres(data, model) if cell > 1 else (data.signal, np.ones(data.signal.shape[1]))
    height, width = signal.shape[2:]
    rows, columns = capture.frame_shape
    camera = _grid(view.camera.resized(rows, columns), cell * data.binned, height, width)
    picked = _pick(data, signal, view.model_copy(update={"camera": camera}), omega, cell=cell)
    where = np.argwhere(picked)
    if len(where) < FEWEST_OF_MANY:
        raise ProcessError(
            f"{capture.path}: {len(where)} pixels see the lit object well within its outline; "
            f"{FEWEST_OF_MANY} are needed. Check the geometry file and the arm angle ({omega:g} degrees)."
        )
    states = signal[:, :, picked].astype(np.float64)
    exposure, conditions, state_slope, state_floor = data.exposure, data.conditions, data.slope, data.floor
    if not model.axes:
        # Nothing turns, so all states are one: their mean is as good, and cheaper.
        n, total = len(states), exposure.sum()
        states = states.sum(axis=0, keepdims=True) / n
        # The dark that was taken away is the same in all of them and does not average out.
        dark = _black_variance(capture) / data.conditions.full_scale**2
        state_slope, state_floor = np.array([data.slope.mean() / n]), np.array([data.floor.mean() / n + dark])
        exposure = np.array([total / n])
        # A rig records the angles of its axes all the same.
        conditions = replace(conditions, angles_deg={}, states=1, elapsed=np.zeros(1), run=np.zeros(1, dtype=np.int64))
    y = states.reshape(-1, len(where)).T
    channels = signal.shape[1]
    share = np.tile(share, conditions.states)
    slope, floor = np.repeat(state_slope, channels) * share, np.repeat(state_floor, channels) * share
    tile, fold = _tiles(where)
    return SurfaceData(
        name=data.name,
        view=SurfaceView(view, camera, picked, omega, material=material, wavelength_nm=data.wavelength_nm),
        y=y,
        variance=slope * np.maximum(y, 0) + floor,
        slope=slope,
        floor=floor,
        exposure=np.repeat(exposure, channels),
        conditions=conditions,
        fold=fold,
        tile=tile,
        where=where,
        shape=(height, width),
        noise=data.noise_source,
        simulated=data.simulated,
        wavelength_nm=data.wavelength_nm,
        omega_deg=omega,
        clipped_fraction=float(np.mean(data.clipped)),
    )


def _tiles(where: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Tile of each pixel (P, 2), and the part of a chessboard in which it is, each (P,)."""
    low = where.min(axis=0)
    tiles = (where - low) * TILES // (where.max(axis=0) - low + 1)
    return tiles[:, 0] * TILES + tiles[:, 1], tiles.sum(axis=1) % FOLDS_OF_TILES


def _black_variance(capture: Capture) -> float:
    """Variance, counts^2, of what is subtracted from the mean of all sample states."""
    black = CountCorrection.of(capture).black
    noise = NoiseModel.of(capture.header.detector, integer=capture.integer_counts)
    share = black.weights(capture.column("exposure_s")[sample_states(capture)].astype(float)).mean(axis=0)
    return float(share**2 @ black.mean_variance(noise))


def _pick(
    data: CaptureData, signal: NDArray[np.float32], view: ViewingGeometry, omega: float, *, cell: int
) -> NDArray[np.bool_]:
    mask = view.at(omega).mask
    if not mask.any():
        raise ProcessError(f"{data.name}: no pixel sees a lit point of the object at Omega {omega:g} degrees.")
    mean = signal.mean(axis=(0, 1), dtype=np.float64)
    lit = mean > SMALL * np.median(mean[mask])
    rim = int(np.ceil(max(RIM_OF_OBJECT * np.sqrt(mask.sum() / np.pi), RIM_PX / (cell * data.binned))))
    inside = ndimage.binary_erosion(mask & lit, iterations=rim)
    good = inside & data.usable & ~ndimage.binary_dilation(data.clipped, iterations=1)
    # Neighbours of an interpolated mosaic share pixels; every second one does not.
    step = max(int(np.ceil(np.sqrt(good.sum() / MOST_OF_OBJECT))), 2 if cell > 1 else 1)
    grid = np.zeros_like(good)
    grid[::step, ::step] = True
    return np.asarray(good & grid)


def _at_cell_centres(data: CaptureData, model: InstrumentModel) -> tuple[NDArray[np.float32], Array]:
    """Signals of all channels at the centres of the mosaic's cells, and the part of their variance that is left.

    Each channel is interpolated linearly between its two neighbours along rows and columns; the curvature of the
    image then changes all channels alike, so that no false polarization comes from it.
    """
    mosaic = model.mosaic or ()
    if any(len(line) != 2 for line in mosaic) or len(mosaic) != 2:
        raise ProcessError("effects of the reflectance are sought in mosaics of 2 x 2 pixels only.")
    where = {name: (r, c) for r, line in enumerate(mosaic) for c, name in enumerate(line)}
    far = 0.25 / data.binned
    centred = np.empty_like(data.signal)
    for k, channel in enumerate(model.channels):
        plane = data.signal[:, k]
        for axis, offset in zip((1, 2), where[channel.name], strict=True):
            # The rolled edge is outside of what is used.
            plane = (1 - far) * plane + far * np.roll(plane, 1 if offset else -1, axis=axis)
        centred[:, k] = plane
    return centred, np.full(len(model.channels), ((1 - far) ** 2 + far**2) ** 2)


def _grid(camera: PinholeCamera, side: int, height: int, width: int) -> PinholeCamera:
    """The camera with pixels `side` times as large, counted from the same corner."""
    row, column = camera.axis_px
    centre = ((row + 0.5) / side - 0.5, (column + 0.5) / side - 0.5)
    return camera.model_copy(
        update={"rows": height, "columns": width, "pixel_mm": camera.pixel_mm * side, "centre_px": centre}
    )
