"""Constants by which noise is told, and by which something is left out of a capture."""

from types import SimpleNamespace as Some

import numpy as np
from rule_decisions import Patch, decides
from scipy.linalg import hadamard
from steady_capture import steady_capture

from processing.arrays import Array
from processing.diagnosis.captured import bad_frames, black_jitter, checked_noise, outliers, read_capture, read_frames
from processing.diagnosis.captured.capture_data import CaptureData
from processing.diagnosis.captured.common_rest import Whitened
from processing.diagnosis.captured.steep_pixels import without_steep_pixels
from processing.diagnosis.instrument import noise_level

STATES = 40


def jitters(dim: float = 0.01, pixels: int = 60, deviations: float = 20.0) -> bool:
    """Whether a black level is seen that jitters by so many standard deviations, where so many pixels are dim."""
    offsets = np.random.default_rng(0).normal(size=STATES)
    offsets -= offsets.mean()
    # Noise of dim pixels is as it should be: the median is exact, and half of them are within its scatter.
    noise = 1e-4 * np.tile([-2.0, -1.0, 0.0, 1.0, 2.0], pixels)[:pixels]
    noise = np.sort(noise) - np.median(noise)
    scatter = np.median(np.abs(noise)) / black_jitter.NORMAL_MAD
    of_median = black_jitter.MEDIAN * scatter**2 / pixels
    free = STATES - 1
    offsets *= np.sqrt(of_median * (free + deviations * np.sqrt(2 * free)) / np.sum(offsets**2))
    signal = np.ones((STATES, 1, 1, 2 * pixels))
    signal[..., pixels:] = dim + noise
    data = Some(
        signal=signal + offsets[:, None, None, None],
        usable=np.ones((1, 2 * pixels), dtype=bool),
        clipped=np.zeros((1, 2 * pixels), dtype=bool),
        row_counts=np.ones(STATES, dtype=bool),
        values_per_pixel=STATES,
    )
    return black_jitter.black_jitter(data, np.ones((STATES, 1))) is not None


@decides
def test_noise_sure(m: Patch) -> bool:
    return jitters(deviations=6.5) and not jitters(deviations=5.5)


@decides
def test_dim(m: Patch) -> bool:
    return jitters(dim=0.047) and not jitters(dim=0.053)


@decides
def test_fewest_dim(m: Patch) -> bool:
    return jitters(pixels=30) and not jitters(pixels=29)


def images(signal: np.ndarray, noise: float) -> CaptureData:
    """Two equal states of an image (rows, columns), of so much noise."""
    return steady_capture(np.broadcast_to(signal, (2, *signal.shape)), noise)


def dark(level: float) -> int:
    """Pixels that are left out where the middle one has so many standard deviations of signal."""
    signal = np.full((21, 21), 1000.0)
    signal[10, 10] = level
    return int(np.sum(~read_capture.without_dark_pixels(images(signal, 1.0)).usable))


@decides
def test_faintest(m: Patch) -> bool:
    return dark(4.8) > 0 and dark(5.2) == 0


@decides
def test_dark_rim(m: Patch) -> bool:
    return dark(0.0) == 9**2


@decides
def test_cut_off(m: Patch) -> bool:
    cut = []
    for black in (58.0, 62.0):
        detector = Some(gain_e_per_count=1.0, read_noise_e=10.0, black_level_counts=black)
        cut.append(read_frames._cuts_off(Some(integer_counts=True, header=Some(detector=detector))))
    return cut == [False, True]


def steep(profile: Array) -> int:
    """Columns of 100 that are left out of an image that has this profile (100,) over them, in its noise."""
    found = without_steep_pixels(images(np.broadcast_to(100 + profile, (5, 100)), 1.0))
    return int(np.sum(~found.usable[0]))


@decides
def test_lost_by_moving(m: Patch) -> bool:
    columns = np.arange(100)
    return steep(8.2 * (columns > 50)) == 0 and steep(8.8 * (columns > 50)) > 0


@decides
def test_most_steep(m: Patch) -> bool:
    columns = np.arange(100)

    def striped(wide: int) -> int:
        return steep(100.0 * ((columns % 2 == 0) & (columns < wide)))

    # Five columns beside the stripes are felt to be at an edge; of those that are, the flattest stay in the end.
    return striped(68) == 73 and striped(74) == 75


STATES_OUTSIDE, UNKNOWNS = 40, 16
Q = np.linalg.qr(np.random.default_rng(1).normal(size=(STATES_OUTSIDE, UNKNOWNS)))[0]
REST = np.eye(STATES_OUTSIDE) - Q @ Q.T


def hits(deviations: float, states: int = 1, pixels: int = 1, of: int = 100) -> int:
    """Hits that are found where so many states of some pixels were struck."""
    size = np.sqrt(np.diag(REST))
    r = np.zeros((STATES_OUTSIDE, of), dtype=np.float32)
    for k in range(states):
        r[:, :pixels] += (REST[:, k] / size[k] * deviations)[:, None]
    noise = np.ones_like(r)
    return int(outliers._hits(r, (r / size[:, None]).astype(np.float32), noise, REST)[0].sum())


@decides
def test_hit(m: Patch) -> bool:
    return hits(7.8) == 0 and hits(8.2) == 1


@decides
def test_most_struck(m: Patch) -> bool:
    return hits(1000.0, states=4) == 4 and hits(1000.0, states=5) == 0


@decides
def test_most_hits(m: Patch) -> bool:
    return hits(20.0, pixels=19, of=1000) == 19 and hits(20.0, pixels=21, of=1000) == 0


def bad(variance: float, free: int) -> bool:
    """Whether a pixel of such a variance is bad among others."""
    noisy = np.ones((15, 15))
    noisy[5, 5] = variance
    return bool(outliers._noisier_than_around(noisy, free)[5, 5])


@decides
def test_bad_pixel(m: Patch) -> bool:
    return bad(4.2, 10**6) and not bad(3.8, 10**6)


@decides
def test_bad_deviations(m: Patch) -> bool:
    return bad(6.2, 8) and not bad(5.8, 8)


@decides
def test_also_bad(m: Patch) -> bool:
    found = []
    for number in (4, 5):
        noisy = np.ones((5, 5))
        noisy.flat[[12, *range(number - 1)]] = 100.0
        found.append(bool(outliers._noisier_than_around(noisy, 10**6)[2, 2]))
    return found == [True, False]


def bad_states(m: Patch, misfit: float, following: float, left: float = 0.1, states: int = 47) -> int:
    """Frames that are bad where each misfits by so much, and the next that is left by a part of it."""

    class Moments:
        def __init__(self, *args: object) -> None:
            self.size = states

        def suspect(self, rest: list[int]) -> bad_frames.BadFrame:
            return bad_frames.BadFrame(rest[0], misfit * following ** (states - len(rest)))

        def left(self, rest: list[int]) -> float:
            return left ** (states - len(rest))

        def exchanged(self, rest: list[int]) -> tuple[()]:
            return ()

    m.setattr(bad_frames, "_Moments", Moments)
    data = Some(
        signal=np.ones((states, 1, 1, 1)),
        usable=np.ones((1, 1), dtype=bool),
        clipped=np.zeros((1, 1), dtype=bool),
        variance_of=lambda good: np.ones((states, 1, 1)),
        values_per_pixel=states,
        noise_known=True,
        row_counts=np.ones(states, dtype=bool),
    )
    return len(bad_frames.bad_frames(data, np.ones((states, 1))))


@decides
def test_least_misfit(m: Patch) -> bool:
    return bad_states(m, 0.0155, 0.01) == 1 and bad_states(m, 0.0145, 0.01) == 0


@decides
def test_against_next(m: Patch) -> bool:
    return bad_states(m, 0.03, 8.2**-0.5) == 1 and bad_states(m, 0.03, 7.8**-0.5) == 0


@decides
def test_mostly(m: Patch) -> bool:
    return bad_states(m, 0.1, 0.01, left=0.48) == 1 and bad_states(m, 0.1, 0.01, left=0.52) == 0


@decides
def test_most_bad_frames(m: Patch) -> bool:
    return bad_states(m, 1e9, 0.01) == 5


@decides
def test_beyond_noise(m: Patch) -> bool:
    rows, repeats = 24, 100
    noise = np.tile(hadamard(32)[:rows], repeats).astype(np.float32)
    edge = (1 + np.sqrt(rows / noise.shape[1])) ** 2
    left = []
    for times in (1.13, 1.17):
        y = noise.copy()
        y[0] *= np.sqrt(times * edge)
        white = Whitened(y, np.ones_like(y), np.ones(rows), np.zeros((rows, 0)), np.eye(rows))
        left.append(round(float(np.trace(white.rest(np.ones(y.shape[1], dtype=bool))))))
    return left == [rows, rows - 1]


def shown(shot: float, dark_part: float, error: float = 1e-3, white: float | None = None, mixed: float = 1.0) -> tuple:
    """Factors on the declared variance with and without light that the images lead to."""
    found = Some(
        shot=shot * mixed,
        dark=dark_part * mixed,
        white=(shot if white is None else white) * mixed,
        covariance=np.eye(2) * (error * mixed) ** 2,
        bent=1.0,
        light_share=0.9,
    )
    return checked_noise.noise_factors(found, mixed, False)


@decides
def test_noise_off(m: Patch) -> bool:
    return shown(1.055, 1.055) == (1.0, 1.0) and shown(1.065, 1.065) != (1.0, 1.0)


@decides
def test_gain_off(m: Patch) -> bool:
    def taken(white: float) -> bool:
        m.setattr(noise_level, "detector_noise", lambda *of: Some(white=white, white_error=0.0, each=white))
        m.setattr(noise_level, "noise_factors", lambda *of, estimated: (1.0, 1.0))
        # A bend that changes nothing.
        m.setattr(noise_level, "undoing", lambda *of: lambda signal: (signal, np.ones(())))
        return noise_level.with_noise_of_light(images(np.ones((2, 2)), 1.0), np.ones((2, 1)), {"bend": 0}) is not None

    return taken(1.028) and not taken(1.032) and taken(0.972) and not taken(0.968)


@decides
def test_noise_off_mixed(m: Patch) -> bool:
    return shown(1.145, 1.145, mixed=0.9) == (1.0, 1.0) and shown(1.155, 1.155, mixed=0.9) != (1.0, 1.0)


@decides
def test_dark_noise_off(m: Patch) -> bool:
    return shown(1.0, 1.48) == (1.0, 1.0) and shown(1.0, 1.52) != (1.0, 1.0)


@decides
def test_as_good(m: Patch) -> bool:
    # So many standard deviations beside the curve of another gain, which is (s, s^2).
    away = np.array([4.0, -1.0]) / np.sqrt(17.0)
    factors = [shown(*(np.array([2.0, 4.0]) + 0.2 * k * away), error=0.2, white=2.0) for k in (2.8, 3.2)]
    return [bool(np.isclose(dark_part, shot**2)) for shot, dark_part in factors] == [True, False]


@decides
def test_noise_alike(m: Patch) -> bool:
    mixed = [checked_noise._mixed(Some(right=r, down=0.0, alike_error=1e-4)).right > 0 for r in (0.048, 0.052)]
    return mixed == [False, True]
