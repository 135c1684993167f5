"""Mueller images of one matrix, taken many times with Poisson and read noise: for `error_bars.py` and the tests.

The noise is drawn here, not by the project's detector model, and the capture is the RGB950's with 40 states.
"""

from pathlib import Path

import numpy as np

from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.polarization import mueller, triply_degenerate
from processing.storage.captures.schema import CaptureHeader
from processing.storage.products.images import MuellerImage

READ_NOISE_E = 2.3
CONFIGS = Path(__file__).resolve().parents[1] / "configs"


def rgb950(wavelength_nm: float = 662) -> np.ndarray:
    """W (40, 16) of the RGB950's own state table."""
    model = InstrumentModel.load(CONFIGS / "instruments/rgb950.yaml").at(wavelength_nm)
    return np.asarray(model.rows(rotating_retarders(1.0).angles_deg).reshape(-1, 16))


def two_plates(retardances_deg: tuple[float, float], angles_rad: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """W (N, 16) of two turning plates between crossed polarizers."""
    generator = mueller.retarder(angles_rad[0], np.deg2rad(retardances_deg[0])) @ np.array([1.0, 1, 0, 0]) / 2
    analyzer = np.array([1.0, -1, 0, 0]) / 2 @ mueller.retarder(angles_rad[1], np.deg2rad(retardances_deg[1]))
    return np.asarray(np.einsum("ni,nj->nij", analyzer, generator).reshape(-1, 16))


def state_tables() -> dict[str, np.ndarray]:
    """W (N, 16) of good and of deliberately poor states, condition number 7 to 80."""

    def steps(count: int, step_deg: float, ratio: float) -> tuple[np.ndarray, np.ndarray]:
        angles = np.deg2rad(step_deg) * np.arange(count)
        return angles, ratio * angles

    def drawn(seed: int) -> tuple[np.ndarray, np.ndarray]:
        random = np.random.default_rng(seed)
        return random.uniform(0, np.pi, 24), random.uniform(0, np.pi, 24)

    return {
        "RGB950's 40": rgb950(),
        "two plates of 90 degrees, 5 to 1, 30": two_plates((90, 90), steps(30, 6.0, 5.0)),
        "127 degrees, 9 to 1, 41": two_plates((127, 127), steps(41, 4.7, 9.0)),
        "60 and 150 degrees, 4.3 to 1, 36": two_plates((60, 150), steps(36, 10.0, 4.3)),
        "24 random states": two_plates((127, 95), drawn(19)),
        "24 others": two_plates((127, 95), drawn(262)),
    }


def seven_instruments() -> dict[str, np.ndarray]:
    """The state tables, and the RGB950's states at 451 nm."""
    return state_tables() | {"RGB950's 40 at 451 nm": rgb950(451)}


def random_processes(count: int, seed: int) -> np.ndarray:
    """Mueller-Jones matrices (count, 4, 4) with m00 = 1, even over all Jones matrices."""
    parts = np.random.default_rng(seed).normal(size=(2, count, 4))
    jones = parts[0] + 1j * parts[1]
    matrices = mueller.coherency_to_mueller(jones[:, :, None] * jones[:, None, :].conj())
    return np.asarray(matrices / matrices[:, :1, :1])


def five_samples() -> dict[str, np.ndarray]:
    """Matrices (4, 4) with m00 = 1 of five kinds."""
    element = mueller.retarder(0.4, 1.2) @ mueller.diattenuator(0.9, 1.0, 0.25) @ mueller.rotation(0.25)
    pure = element / element[0, 0]
    mirror = mueller.diattenuator(0.0, 1.0, 0.6) @ mueller.IDEAL_MIRROR
    mirror = mirror / mirror[0, 0]
    inverting = np.diag([1.0, 0.3, 0.25, -0.35])
    inverting[0, 1], inverting[1, 0], inverting[2, 3] = 0.2, 0.15, 0.05
    return {
        "non-depolarizing": pure,
        "diagonal depolarizer": np.diag([1.0, 0.6, 0.5, 0.35]),
        "triply degenerate": triply_degenerate.mueller_matrix(pure, 0.55),
        "mirror-like": triply_degenerate.mueller_matrix(mirror, 0.95),
        "det < 0": inverting,
    }


def noisy_image(
    matrices: np.ndarray,
    electrons: float,
    seed: int | list[int],
    w: np.ndarray | None = None,
    *,
    darks: int = 0,
    read_noise_e: float = READ_NOISE_E,
) -> MuellerImage:
    """Image (1, pixels) reduced from a capture of each matrix (pixels, 4, 4) with m00 = 1.

    Parameters
    ----------
    electrons : mean over the states for an ideal depolarizer with m00 = 1; one electron is one count.
    darks : dark frames whose mean is subtracted; 0: the black is known.
    """
    w = rgb950() if w is None else w
    rng = np.random.default_rng(seed)
    scale = electrons / w[:, 0].mean()
    expected = scale * matrices.reshape(-1, 16) @ w.T
    counts = rng.poisson(np.maximum(expected, 0)) + rng.normal(0, read_noise_e, expected.shape)
    inverse = np.linalg.pinv(w)
    dark = np.zeros((16, 0))
    if darks:
        error = read_noise_e / np.sqrt(darks)
        counts -= rng.normal(0, error, (len(counts), 1))
        dark = inverse.sum(axis=1, keepdims=True) * error
    m = inverse @ counts.T
    floor = np.full(len(w), read_noise_e**2)
    variance = np.maximum(w @ m + floor[:, None], 0.5 * floor[:, None])
    shape = (1, len(expected))
    residual = counts.T - w @ m
    return MuellerImage(
        values=m.reshape(4, 4, *shape).astype(np.float32),
        errors=np.sqrt(inverse**2 @ variance + dark.sum(axis=1, keepdims=True) ** 2).reshape(4, 4, *shape).astype("f4"),
        mask=np.zeros(shape, np.uint8),
        residual_rms=np.sqrt(np.mean(residual**2, axis=0)).reshape(shape).astype(np.float32),
        w=w,
        noise_slope=np.ones(len(w)),
        noise_floor=floor,
        header=CaptureHeader(title="noise", simulated=True, mode="mueller", wavelength_nm=662),
        steps=(),
        simulated=True,
        facts={"weighted": False},
        dark=dark,
    )


def nineteen_samples() -> dict[str, np.ndarray]:
    """Matrices (4, 4) with m00 = 1: the five kinds, and those at which a quantity ends, folds or is not unique."""
    pure = five_samples()["non-depolarizing"]

    def polarizer(extinction: float) -> np.ndarray:
        matrix = mueller.diattenuator(0.3, 1.0, 1 / extinction)
        return np.asarray(matrix / matrix[0, 0])

    def retarder(degrees: float) -> np.ndarray:
        return triply_degenerate.mueller_matrix(mueller.retarder(0.4, np.deg2rad(degrees)), 0.97)

    # Small eigenvalues 3 % apart, as those of the paper's sphere at 662 nm.
    second = mueller.retarder(0.9, 2.0) @ mueller.IDEAL_MIRROR
    apart = triply_degenerate.mueller_matrix(pure, 0.55) + 0.03 * (second - mueller.IDEAL_DEPOLARIZER)
    weak = np.diag([1.0, 0.06, 0.055, 0.05])
    weak[1, 0], weak[0, 1] = 0.03, 0.02
    return five_samples() | {
        "ideal depolarizer": np.array(mueller.IDEAL_DEPOLARIZER, dtype=float),
        "nearly ideal depolarizer": weak,
        "DoLP 0.2": triply_degenerate.mueller_matrix(polarizer(10), 0.25 + 0.75 * 0.2 / 0.8182),
        "air": np.eye(4),
        "mirror": np.array(mueller.IDEAL_MIRROR, dtype=float),
        "polarizer 1:10": polarizer(10),
        "polarizer 1:100": polarizer(100),
        "polarizer 1:1000": polarizer(1000),
        "polarizer 1:10000": polarizer(10_000),
        "retarder 2": retarder(2),
        "retarder 90": retarder(90),
        "retarder 178": retarder(178),
        "retarder 180": retarder(180),
        "triply degenerate, 3 % off": apart,
    }
