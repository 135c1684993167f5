"""Noise of a camera from frames that repeat each other: a photon-transfer line through differences of pairs.

Two frames of one scene differ by noise alone. Half the variance of their difference, against their mean, is the
line variance = slope * signal + floor (EMVA 1288, "photon transfer"). The line gives gain and read noise.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from processing.errors import NotDetermined, ProcessError
from processing.reduction.black import Black
from processing.reduction.noise import QUANTIZATION, NoiseModel
from processing.storage.captures.capture import Capture
from processing.storage.products.pixel_mask import Mask
from processing.storage.products.product import Plane, Product, Step
from processing.storage.products.product_writer import ProductWriter

#: Levels between black and the brightest pixel at which the variance is taken.
LEVELS = 48
#: Pixels that a level needs.
FEWEST = 200
#: Angles within this are the same state.
SAME_DEG = 0.02
#: A pixel is bad where its dark mean or its noise lies this many robust standard deviations out.
OUTLIER = 8.0
#: Above this part of the range a pixel may clip.
CLIPPING = 0.97

PLANES = {
    "dark_mean": Plane((), "count", "mean of the dark frames of the shortest exposure"),
    "pixel_flags": Plane((), "", f"0 = good; bits: {Mask.meaning()}", np.uint8),
}


@dataclass(frozen=True)
class PhotonTransfer:
    """Photon-transfer line and the points that it goes through.

    Attributes
    ----------
    slope, floor : counts, counts^2; variance = slope * signal + floor.
    covariance : (2, 2) of (slope, floor).
    signal, variance, stderr : (levels,), counts above black, counts^2.
    chi_square : reduced, of the line; well above 1: not linear, or the light flickered.
    black_counts : mean of the dark frames of the shortest exposure.
    """

    slope: float
    floor: float
    covariance: NDArray[np.float64]
    signal: NDArray[np.float64]
    variance: NDArray[np.float64]
    stderr: NDArray[np.float64]
    chi_square: float
    black_counts: float

    @property
    def gain_e_per_count(self) -> float:
        """Electrons a count."""
        return 1.0 / self.slope

    @property
    def gain_stderr(self) -> float:
        """Standard error of the gain."""
        return float(np.sqrt(self.covariance[0, 0])) / self.slope**2

    @property
    def read_noise_e(self) -> float:
        """Read noise in electrons, rounding to whole counts taken out."""
        return float(np.sqrt(max(self.floor - QUANTIZATION, 0.0)) / self.slope)

    @property
    def read_noise_stderr(self) -> float:
        """Standard error of the read noise, first order; NaN where none was found above the rounding."""
        level = self.floor - QUANTIZATION
        if level <= 0:
            return float("nan")
        gradient = self.read_noise_e * np.array([-1 / self.slope, 0.5 / level])
        return float(np.sqrt(gradient @ self.covariance @ gradient))


def repeats(capture: Capture) -> list[NDArray[np.int64]]:
    """Groups of states that repeat each other: same role, exposure and angles; at least two each."""
    angles = np.stack([*capture.angles_deg.values(), np.zeros(len(capture.role))])
    steps = np.round(np.nan_to_num(angles, nan=-1e6) / SAME_DEG)
    exposure = np.nan_to_num(capture.column("exposure_s"), nan=-1.0)
    keys: dict[tuple[Any, ...], list[int]] = {}
    for k, role in enumerate(capture.role):
        keys.setdefault((role, float(exposure[k]), *steps[:, k]), []).append(k)
    return [np.array(group) for group in keys.values() if len(group) > 1]


def photon_transfer(captures: Sequence[Capture]) -> PhotonTransfer:
    """Fit the photon-transfer line to all repeated states of some captures of one camera.

    Raises
    ------
    ProcessError : no dark states, or no repeated states.
    NotDetermined : the light spans too small a range.
    """
    darks = [dark for c in captures if (dark := Black.of(c)) is not None]
    if not darks:
        raise ProcessError("no dark states in these captures: the black level is needed. Take some (plan key `darks`).")
    black = float(np.mean([d.means[0].mean() for d in darks]))
    pairs = list(_pairs(captures, darks[0]))
    if not pairs:
        raise ProcessError(
            "no two states of these captures repeat each other, so noise cannot be told from signal. "
            "Capture one pose several times, e.g. `acquire --mode stokes`."
        )
    top = max(float(signal.max()) for signal, _ in pairs)
    edges = np.linspace(0.0, max(top, 1.0), LEVELS + 1)
    edges[0] = -np.inf
    sums = np.zeros((4, LEVELS))
    for signal, difference in pairs:
        index = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, LEVELS - 1)
        count = np.bincount(index, minlength=LEVELS).astype(float)
        mean = np.bincount(index, difference, LEVELS) / np.maximum(count, 1)
        # The mean difference of a level is drift of the light, not noise.
        square = np.bincount(index, (difference - mean[index]) ** 2, LEVELS)
        sums += [count, np.bincount(index, signal, LEVELS), square / 2, (count > 0).astype(float)]
    enough = sums[0] >= FEWEST
    count, free = sums[0][enough], sums[0][enough] - sums[3][enough]
    signal, variance = sums[1][enough] / count, sums[2][enough] / free
    if enough.sum() < 3 or signal.max() < 20 * np.sqrt(max(variance[0], 1e-12)):
        raise NotDetermined(
            f"the repeated states hold {enough.sum()} usable light levels up to {signal.max():.3g} counts: too little "
            "to separate shot noise from read noise. Capture something bright, with a gradient, and without clipping."
        )
    fitted = variance
    for _ in range(3):
        # The error of a variance is in proportion to it; taken from the line, because a level whose variance
        # came out small by chance must not count more for it.
        stderr = fitted * np.sqrt(2 / free)
        design = np.stack([signal, np.ones_like(signal)], axis=1) / stderr[:, None]
        covariance = np.linalg.inv(design.T @ design)
        slope, floor = covariance @ design.T @ (variance / stderr)
        fitted = np.maximum(slope * signal + floor, 0.1 * variance)
    chi_square = float(np.mean(((variance - slope * signal - floor) / stderr) ** 2) * len(signal) / (len(signal) - 2))
    if slope <= 3 * np.sqrt(covariance[0, 0]):
        raise NotDetermined("the variance does not grow with the signal; the captures hold no shot noise to fit.")
    return PhotonTransfer(
        float(slope), float(floor), covariance * max(chi_square, 1.0), signal, variance, stderr, chi_square, black
    )


def _pairs(captures: Sequence[Capture], default: Black) -> Iterator[tuple[NDArray[Any], NDArray[Any]]]:
    """Signal and difference of pairs of repeated frames, scaled to single frames; clipped pixels are left out."""
    for capture in captures:
        bits = capture.header.detector.bits
        top = capture.full_scale_counts or (2**bits - 1 if bits else np.inf)
        ceiling = CLIPPING * top if capture.integer_counts else np.inf
        averaged, exposure_s = capture.column("repeats"), capture.column("exposure_s").astype(float)
        darks = Black.of(capture) or default
        for group in repeats(capture):
            black = float(darks.at(exposure_s[group[0]]).mean())
            # Each frame serves in one pair, so that pairs are independent.
            for first, second in zip(group[0::2], group[1::2], strict=False):
                a, b = (capture.frames(int(k)).astype(np.float64).reshape(-1) for k in (first, second))
                keep = (a < ceiling) & (b < ceiling) & np.isfinite(a) & np.isfinite(b)
                scale = np.sqrt(float(averaged[first]))
                yield (a[keep] + b[keep]) / 2 - black, (a[keep] - b[keep]) * scale


def bad_pixels(capture: Capture) -> NDArray[np.bool_]:
    """Pixels (rows, columns) whose dark signal lies far from the others'; none without dark states."""
    black = Black.of(capture)
    bad = np.zeros(capture.frame_shape, dtype=bool)
    # Hot pixels show best in the longest darks.
    for channel in () if black is None else black.means[-1]:
        centre = np.median(channel)
        spread = 1.4826 * np.median(np.abs(channel - centre))
        # Whole counts can make the spread vanish; a count is the least that means anything.
        bad |= np.abs(channel - centre) > OUTLIER * max(float(spread), 0.3)
    return bad


def write_camera(
    paths: Sequence[Path], out: Path, step: Step, overwrite: bool
) -> tuple[PhotonTransfer, dict[str, Any], bool]:
    """Measure a camera from captures and write its product ("camera"): the line, the facts, whether simulated."""
    captures = [Capture(p) for p in paths]
    try:
        if len({c.simulated for c in captures}) > 1:
            raise ProcessError("simulated and measured captures are mixed; measure a camera from one kind only.")
        if len({c.frame_shape for c in captures}) > 1:
            raise ProcessError("the captures have different frame sizes; they are not of one camera.")
        line = photon_transfer(captures)
        first = captures[0]
        bad = np.any([bad_pixels(c) for c in captures], axis=0)
        darks = [dark.means[0] for c in captures if (dark := Black.of(c)) is not None]
        facts: dict[str, Any] = {
            "gain_e_per_count": line.gain_e_per_count,
            "gain_stderr": line.gain_stderr,
            "read_noise_e": line.read_noise_e,
            "read_noise_stderr": line.read_noise_stderr,
            "black_counts": line.black_counts,
            "slope": line.slope,
            "floor": line.floor,
            "line_chi_square": line.chi_square,
            "highest_signal": float(line.signal.max()),
            "bad_pixels": int(bad.sum()),
            "integer": first.integer_counts,
            "warnings": _warnings(line, first),
        }
        with ProductWriter(
            out, "camera", first.header, first.frame_shape, planes=PLANES, steps=(step,), overwrite=overwrite
        ) as writer:
            mask = np.where(bad, np.uint8(Mask.BAD), np.uint8(0))
            mean = np.mean([d.mean(axis=0) for d in darks], axis=0).astype(np.float32)
            writer.write(slice(0, first.frame_shape[0]), dark_mean=mean, pixel_flags=mask)
            points = np.stack([line.signal, line.variance, line.stderr])
            writer.array("photon_transfer", points, "count", "signal (count), variance and its standard error (count2)")
            writer.seal(facts)
        return line, facts, first.simulated
    finally:
        for capture in captures:
            capture.close()


def read_camera(path: Path) -> tuple[NoiseModel, NDArray[np.bool_]]:
    """Noise model and bad pixels (rows, columns) of a camera product."""
    with Product(path) as product:
        product.require("camera")
        facts = product.facts
        rounding = QUANTIZATION if facts["integer"] else 0.0
        source = f"{path.name}: gain {facts['gain_e_per_count']:.4g} e/count, read noise {facts['read_noise_e']:.3g} e"
        noise = NoiseModel(facts["slope"], max(facts["floor"] - rounding, 0.0), rounding, source)
        return noise, (product.get("pixel_flags") & np.uint8(Mask.BAD)) != 0


def _warnings(line: PhotonTransfer, capture: Capture) -> list[str]:
    warnings = []
    if line.chi_square > 3:
        warnings.append(
            f"the variance does not follow a straight line (reduced chi-square {line.chi_square:.1f}): the camera "
            "is not linear there, or the scene changed between repeats"
        )
    stated = capture.header.detector.gain_e_per_count
    if stated is not None and abs(line.gain_e_per_count - stated) > 5 * line.gain_stderr + 0.02 * stated:
        warnings.append(f"the capture's header says {stated:g} e/count, the frames say {line.gain_e_per_count:.4g}")
    return warnings
