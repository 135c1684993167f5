"""Captures of a bench that does something which its declared model does not know: by Jones calculus, ray and electron.

This is the second route for `diagnose`: nothing here calls the functions that it fits. Light goes through the trains
as Jones matrices (coherency of the generator's output, Hermitian form of the analyzer), the scene is a smooth function
of position that is looked up where the ray lands, counts come from Poisson electrons and a real transfer curve.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array, ComplexArray
from processing.instrument.model import InstrumentModel, Polarizer, Retarder
from processing.storage.captures.schema import CaptureHeader, Detector, Sample, create_layout, write_closing

#: Pauli matrices in the order of docs/conventions.md.
_PAULI = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]], dtype=complex)
BITS = 16
BLACK = 100.0


def retarder_jones(azimuth_rad: float, retardance_rad: Any, t_fast: float = 1.0, t_slow: float = 1.0) -> ComplexArray:
    """Jones matrices (..., 2, 2) of a retarder; phase so that S3 has the sign of docs/conventions.md."""
    d = np.asarray(retardance_rad, dtype=float)[..., None, None]
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    fast = np.array([[c * c, c * s], [c * s, s * s]])
    slow = np.eye(2) - fast
    return np.asarray(np.sqrt(t_fast) * fast * np.exp(-0.5j * d) + np.sqrt(t_slow) * slow * np.exp(0.5j * d))


def polarizer_jones(azimuth_rad: float, extinction: float = 0.0) -> ComplexArray:
    """Jones matrix (2, 2) of a polarizer that leaks the intensity `extinction`."""
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    along = np.array([[c * c, c * s], [c * s, s * s]])
    return np.asarray(along + np.sqrt(extinction) * (np.eye(2) - along), dtype=complex)


@dataclass
class TrueBench:
    """True state of the optics; a fault changes these numbers or hooks into `shot`, `image` and `counts`.

    Angles in radians. `field_retardance` gives (rows, columns) in radians to add to the generator retarder's.
    """

    rows: int = 32
    columns: int = 32
    wavelength_nm: float = 662.0
    dg: float = np.deg2rad(127.12)
    og: float = np.deg2rad(-17.02)
    da: float = np.deg2rad(94.78)
    oa: float = np.deg2rad(13.41)
    lp: float = np.deg2rad(-0.53)
    extinction_g: float = 0.0
    extinction_a: float = 0.0
    fast_slow_g: tuple[float, float] = (1.0, 1.0)
    fast_slow_a: tuple[float, float] = (1.0, 1.0)
    ellipticity: float = 0.0
    path: tuple[float, float] = (0.0, 0.0)
    band: Array = field(default_factory=lambda: np.ones(1))
    field_retardance: Array | None = None
    mosaic: bool = False
    channel_azimuth: Array = field(default_factory=lambda: np.zeros(4))
    channel_extinction: Array = field(default_factory=lambda: np.zeros(4))
    channel_gain: Array = field(default_factory=lambda: np.ones(4))
    electrons: float = 20_000.0
    gain: float = 0.5
    read_noise: float = 3.0
    full_well: float = 32_000.0
    # Hooks: (state, angles) -> angles, level, shift in pixels, retardances to add; (state, electrons) -> electrons.
    angles: list[Callable[[int, dict[str, float]], dict[str, float]]] = field(default_factory=list)
    level: list[Callable[[int, dict[str, float]], float]] = field(default_factory=list)
    shift: list[Callable[[int, dict[str, float]], tuple[Any, Any]]] = field(default_factory=list)
    light: list[Callable[[int, Array], Array]] = field(default_factory=list)
    transfer: list[Callable[[Array], Array]] = field(default_factory=list)
    retardance: list[Callable[[int, dict[str, float]], tuple[float, float]]] = field(default_factory=list)
    #: Number of a material of the scene, and (state) -> its level.
    material_level: list[tuple[int, Callable[[int], float]]] = field(default_factory=list)
    order: NDArray[np.int64] | None = None
    shared_light: float = 0.0
    zigzag: bool = False
    #: Axis that a fault of one axis acts on; drawn if None.
    axis: str | None = None
    #: (state) -> angle in radians by which the sample has turned about the line of sight.
    turned: list[Callable[[int], float]] = field(default_factory=list)
    #: (electrons of all states, random) -> electrons: noise that no model of the light has.
    noise: list[Callable[[Array, np.random.Generator], Array]] = field(default_factory=list)
    #: (counts of all states) -> counts, as a program stores them.
    stored: list[Callable[[Array], Array]] = field(default_factory=list)
    #: (true angles in degrees) -> angles as the capture file has them.
    recorded: list[Callable[[dict[str, Array]], dict[str, Array]]] = field(default_factory=list)
    #: Detector as declared in the capture file, where it is not the true one.
    declared: dict[str, float | None] = field(default_factory=dict)
    #: (N,) when each state was taken, by the camera's clock; default: evenly. And how late the host stamped it.
    times_s: Array | None = None
    late_s: Array | float = 0.0

    def generated(self, angles: dict[str, float], state: int) -> Array:
        """Stokes vectors (..., 4) of the light on the sample; leading axes if the retardance varies over the image."""
        d = self.dg + sum(r(state, angles)[0] for r in self.retardance)
        out: Array | float = 0.0
        for k in self.band:
            delta = d * k if self.field_retardance is None else d * k + self.field_retardance
            j = retarder_jones(angles["psg"] + self.og, delta, *self.fast_slow_g) @ self._ellipse()
            j = self._window() @ j @ polarizer_jones(0.0, self.extinction_g)
            coherency = j @ np.swapaxes(j.conj(), -1, -2) / 2
            out = out + np.einsum("aij,...ji->...a", _PAULI, coherency).real / len(self.band)
        return np.asarray(out)

    def _ellipse(self) -> ComplexArray:
        c, s = np.cos(self.ellipticity), np.sin(self.ellipticity)
        # S3 = I(right) - I(left) > 0 for positive ellipticity: (c, -i s) with the Pauli matrix s3 of the conventions.
        return np.array([[c, -1j * s], [-1j * s, c]])

    def _window(self) -> ComplexArray:
        size, azimuth = np.hypot(*self.path), np.arctan2(self.path[1], self.path[0]) / 2
        return retarder_jones(azimuth, size)

    def analyzed(self, angles: dict[str, float], state: int) -> Array:
        """Analyzer vectors (channels, 4)."""
        if self.mosaic:
            azimuths = np.deg2rad([0, 45, 90, 135]) + self.channel_azimuth
            trains = [
                np.sqrt(g) * polarizer_jones(t, e)
                for t, e, g in zip(azimuths, self.channel_extinction, self.channel_gain, strict=True)
            ]
            return np.stack([_analyzer(j) for j in trains])
        d = self.da + sum(r(state, angles)[1] for r in self.retardance)
        rows = []
        for k in self.band:
            plate = retarder_jones(angles["psa"] + self.oa, d * k, *self.fast_slow_a)
            rows.append(_analyzer(polarizer_jones(self.lp, self.extinction_a) @ plate))
        return np.asarray(np.mean(rows, axis=0)[None])


def _analyzer(jones: ComplexArray) -> Array:
    # Intensity behind J of Stokes vector S is 1/2 sum of S_a tr(J s_a J^H).
    return np.asarray(0.5 * np.einsum("ij,ajk,ik->a", jones, _PAULI, jones.conj()).real)


class TrueScene:
    """Mueller matrices as a smooth function of position: four materials mixed by slow waves, or one everywhere."""

    def __init__(self, random: np.random.Generator, mueller: Array | None = None, brightness: float = 0.6) -> None:
        self.mueller = mueller
        self.brightness = brightness
        self.waves = random.normal(size=(5, 8, 4))
        self.materials = np.stack([self._material(random) for _ in range(4)])

    @staticmethod
    def _material(random: np.random.Generator) -> Array:
        jones = polarizer_jones(random.uniform(0, np.pi), random.uniform(0.2, 0.9)) @ retarder_jones(
            random.uniform(0, np.pi), random.uniform(0, 3)
        )
        pure = 0.5 * np.einsum("aij,jk,bkl,il->ab", _PAULI, jones, _PAULI, jones.conj()).real
        keep = random.uniform(0.1, 0.9)
        return np.asarray(pure / pure[0, 0] * np.where(np.arange(16).reshape(4, 4) == 0, 1.0, keep))

    def at(self, x: Array, y: Array, levels: Array | None = None) -> Array:
        """Mueller matrices (..., 4, 4) at positions in image widths; `levels` (4,) of the materials, default 1."""
        k = self.waves
        # Up to about three periods over the image, weaker the faster.
        sums = [
            sum(
                a * np.sin(3.0 * n * (np.cos(4 * b) * x + np.sin(4 * b) * y) + 3 * c) / n
                for n, (a, b, c, _) in zip((1, 1, 2, 2, 3, 3, 4, 5), row, strict=True)
            )
            for row in k
        ]
        shade = np.exp(self.brightness * 0.4 * np.asarray(sums[4]))
        shade = shade / (1 + shade)
        if self.mueller is not None:
            if levels is not None:
                # In air it is a window that gets dirty, or clean, in places.
                shade = shade * (1 + (np.prod(levels) - 1) / (1 + np.exp(-np.asarray(sums[0]))))
            return np.asarray((0.35 + 0.65 * shade)[..., None, None] * self.mueller)
        weights = np.exp(1.5 * np.stack(sums[:4], axis=-1))
        weights /= weights.sum(axis=-1, keepdims=True)
        if levels is not None:
            weights = weights * levels
        mixed = np.einsum("...m,mij->...ij", weights, self.materials)
        return np.asarray(shade[..., None, None] * mixed)


def expose(bench: TrueBench, scene: TrueScene, angles_deg: dict[str, Array]) -> Array:
    """Expected electrons (N, rows, columns) of all states; on a mosaic each pixel looks through its own polarizer."""
    n = next(iter(angles_deg.values())).size
    ys, xs = np.mgrid[0 : bench.rows, 0 : bench.columns].astype(float)
    out = np.zeros((n, bench.rows, bench.columns))
    constant_m = (
        None if bench.shift or bench.material_level or bench.turned else scene.at(xs / bench.columns, ys / bench.rows)
    )
    for k in range(n):
        angles = {axis: float(np.deg2rad(v[k])) for axis, v in angles_deg.items()}
        for hook in bench.angles:
            angles = hook(k, angles)
        m = constant_m
        if m is None:
            shifts = [(0.0, 0.0), *(s(k, angles) for s in bench.shift)]
            dx, dy = (sum(parts) for parts in zip(*shifts, strict=True))
            levels = np.ones(4)
            for material, course in bench.material_level:
                levels[material] *= course(k)
            m = scene.at((xs - dx) / bench.columns, (ys - dy) / bench.rows, levels)
            if bench.turned:
                m = _turned(scene, bench, xs - dx, ys - dy, angle=sum(t(k) for t in bench.turned))
        g, a = bench.generated(angles, k), bench.analyzed(angles, k)
        light = np.einsum("ci,hwij,...j->chw", a, m, g) if g.ndim == 1 else np.einsum("ci,hwij,hwj->chw", a, m, g)
        out[k] = _sample_mosaic(light) if bench.mosaic else light[0]
        for factor in bench.level:
            out[k] *= factor(k, angles)
        # Light without any polarization: a quarter of m00, in every state.
        out[k] += bench.shared_light * 0.25 * m[..., 0, 0]
    if bench.order is not None:
        out = out[bench.order]
    out *= bench.electrons / out.max()
    for k in range(n):
        for change in bench.light:
            out[k] = change(k, out[k])
    return np.asarray(out)


def _turned(scene: TrueScene, bench: TrueBench, xs: Array, ys: Array, *, angle: float) -> Array:
    """Mueller matrices of the scene turned counter-clockwise by an angle (radians) about the middle of the image."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = xs - (bench.columns - 1) / 2, ys - (bench.rows - 1) / 2
    # Rows run downwards: counter-clockwise as seen is clockwise in (column, row).
    unrotated = scene.at(
        (c * x - s * y + (bench.columns - 1) / 2) / bench.columns, (s * x + c * y + (bench.rows - 1) / 2) / bench.rows
    )
    c, s = np.cos(2 * angle), np.sin(2 * angle)
    r = np.array([[1, 0, 0, 0], [0, c, -s, 0], [0, s, c, 0], [0, 0, 0, 1]])
    return np.asarray(r @ unrotated @ r.T)


def _sample_mosaic(light: Array) -> Array:
    # 90 45 / 135 0 from the top left; channels come as 0, 45, 90, 135.
    out = np.empty(light.shape[1:])
    for (r, c), k in {(0, 0): 2, (0, 1): 1, (1, 0): 3, (1, 1): 0}.items():
        out[r::2, c::2] = light[k, r::2, c::2]
    return out


def digitize(bench: TrueBench, electrons: Array, random: np.random.Generator) -> NDArray[np.uint16]:
    """Counts of expected electrons: shot noise, full well, transfer curve, read noise, black level, rounding."""
    signal = np.minimum(random.poisson(np.maximum(electrons, 0)).astype(float), bench.full_well)
    for curve in bench.transfer:
        signal = curve(signal)
    for add in bench.noise:
        signal = add(signal, random)
    return counted(bench, signal + bench.read_noise * random.standard_normal(signal.shape))


def counted(bench: TrueBench, electrons: Array) -> NDArray[np.uint16]:
    """Counts of collected electrons (N, rows, columns), as they are stored."""
    counts = np.rint(electrons / bench.gain + BLACK)
    for change in bench.stored:
        counts = change(counts)
    return np.asarray(np.clip(np.rint(counts), 0, 2**BITS - 1), dtype=np.uint16)


def write_capture(
    path: Path,
    bench: TrueBench,
    counts: NDArray[np.uint16],
    angles_deg: dict[str, Array],
    *,
    sample: Sample,
    instrument: str,
) -> None:
    """A capture file as the bench's own program would write it: the declared instrument, no word of the fault."""
    detector = Detector(
        black_level_counts=BLACK,
        gain_e_per_count=bench.gain,
        read_noise_e=bench.read_noise,
        full_well_e=bench.full_well,
        bits=BITS,
    ).model_copy(update=bench.declared)
    for change in bench.recorded:
        angles_deg = change(angles_deg)
    layout = (("90", "45"), ("135", "0")) if bench.mosaic else None
    header = CaptureHeader(
        title=path.stem,
        simulated=True,
        mode="blind",
        wavelength_nm=bench.wavelength_nm,
        sample=sample,
        detector=detector,
        mosaic=layout,
        instrument_yaml=instrument,
    )
    n = counts.shape[0]
    with h5py.File(path, "w") as h5:
        create_layout(
            h5,
            header,
            angles_deg,
            ("sample",) * n,
            frame_shape=counts.shape[1:],
            dtype=counts.dtype,
            start_time="2020-01-01T00:00:00",
        )
        h5["entry/instrument/detector/data"][...] = counts[:, None]
        for axis, values in angles_deg.items():
            h5[f"entry/instrument/{axis}/value"][...] = values
        states = h5["entry/states"]
        states["exposure_s"][...] = 0.1
        taken_s = np.arange(n) * 2.0 if bench.times_s is None else bench.times_s
        states["host_time_s"][...] = taken_s + bench.late_s
        states["camera_time_ns"][...] = np.rint(taken_s * 1e9).astype(np.int64)
        states["repeats"][...] = 1
        states["done"][...] = 1
        write_closing(h5, "complete", {})


def expected_electrons(bench: TrueBench, electrons: Array) -> Array:
    """Electrons (N, rows, columns) that the detector collects on average."""
    signal = np.minimum(electrons, bench.full_well)
    for curve in bench.transfer:
        signal = curve(signal)
    return signal


def expected(bench: TrueBench, electrons: Array) -> Array:
    """Counts (N, rows, columns) above black that the detector reports on average."""
    return np.asarray(expected_electrons(bench, electrons) / bench.gain)


def declared_bench(model: InstrumentModel, nm: float, size: int, mosaic: bool, *, electrons: float) -> TrueBench:
    """A bench that is what its model (resolved at the wavelength) declares."""
    bench = TrueBench(rows=size, columns=size, mosaic=mosaic, electrons=electrons, wavelength_nm=nm)
    for element in model.elements():
        azimuth = _radians(element.azimuth_deg)
        if isinstance(element, Retarder):
            retardance = _radians(element.retardance_deg)
            if element.axis == "psg":
                bench.og, bench.dg = azimuth, retardance
            else:
                bench.oa, bench.da = azimuth, retardance
        elif isinstance(element, Polarizer) and element.name == "analyzer":
            bench.lp = azimuth
    return bench


def _radians(value_deg: float | dict[float, float]) -> float:
    if isinstance(value_deg, dict):
        raise ValueError("the model is not resolved at a wavelength")
    return float(np.deg2rad(value_deg))


def state_angles(
    states: int, mosaic: bool, zigzag: bool, step_deg: float | None = None, *, ratio: float = 4.91
) -> dict[str, Array]:
    """Angles of both axes in degrees; `zigzag` reaches states from both sides. Steps divide a turn, or half of it."""
    step = step_deg or (180.0 if mosaic else 360.0) / states
    psg = np.asarray(step * np.arange(states), dtype=np.float64)
    order = np.arange(states)
    if zigzag:
        # Every third step goes back: states are reached from both sides.
        order = np.concatenate([g[::-1] for g in np.array_split(order, max(states // 3, 1))])
    return {"psg": np.asarray(psg[order]), "psa": np.asarray(ratio * psg[order])}
