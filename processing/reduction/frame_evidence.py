"""Evidence in the frames of a capture that the camera reports something false.

A frame with noise never comes twice, and neither does a frame number or a time of the camera's clock. The brightness
of a rotation is linear in the sixteen elements of the mean Mueller matrix, and so is each place of the picture. A state
that the others contradict by one factor, or that agrees with them once it is mirrored, has a cause outside the plan.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array
from processing.computing.filters import block_means

#: Every so many-th row is compared; noise makes each row unlike any other.
ROWS_APART = 8
#: Part of the rows of a frame that may be those of the frame before.
EQUAL_ROWS = 0.05
#: Rows compared from which on chance makes no frame like another.
FEWEST_ROWS = 4
#: States more than unknowns before a fit says anything.
SPARE = 4
#: [F ratio] What one factor must explain over what it leaves; undeclared effects leave up to several percent.
DECISIVE = 50.0
#: Least change of brightness that is reported; a lamp drifts by less between two states.
LEAST_CHANGE = 0.03
#: Part of the residual that mirroring all from one on must leave at most, and least residual over the signal for that.
MIRRORED_LEAVES, LEAST_PATTERN = 0.25, 0.01
#: How often a capture may have a sound state that is called mirrored.
MIRRORED_BY_CHANCE = 1e-3
#: Most degrees of freedom that cosines lend to each other.
MOST_FREEDOM = 1000.0
#: Part of the power of a cosine of the picture that noise may be: noise alone reaches a tenth once in a million (F with
#: 16 and 23 degrees of freedom).
NOISE_SHARE = 0.1
#: States of one capture that are named.
MOST_FOUND = 5
#: Blocks a side into which a picture is averaged.
BLOCKS = 16

Kind = Literal["identical", "number", "time", "settings", "brightness", "picture"]
#: Ways to mirror a picture (blocks, blocks), in words.
MIRRORS: dict[str, Callable[[Array], Array]] = {
    "mirrored left to right": lambda b: b[..., ::-1],
    "upside down": lambda b: b[..., ::-1, :],
    "turned by 180 degrees": lambda b: b[..., ::-1, ::-1],
}


@dataclass(frozen=True)
class FrameFinding:
    """A contradiction between a frame and the reports about it.

    Attributes
    ----------
    state : number in the plan, of the first state that it concerns.
    """

    state: int
    kind: Kind
    text: str


class FrameEvidence:
    """Compares frames as they come, and all of them at the end of a run.

    Parameters
    ----------
    black : counts without light, as declared.
    rows : of the measurement matrix (states, 16) for the mean of a frame, in the order of the plan; None where the
        instrument is not known.
    before : the frame before the first one, of another run; None where there was none.
    """

    def __init__(self, black: float, rows: Array | None, before: NDArray[np.generic] | None = None) -> None:
        self._black, self._rows = black, rows
        self._seen: set[int] = set()
        self._before = None if before is None else np.ascontiguousarray(before[::ROWS_APART])
        # State, number and time of the frame before.
        self._last = (0, 0, 0)
        self._blocks: dict[int, Array] = {}
        self.found: list[FrameFinding] = []

    def repeats(self, pixels: NDArray[np.generic]) -> str | None:
        """Why a frame is one that came before, in words; None for a new one. Frames of one value are not judged."""
        rows = np.ascontiguousarray(pixels[::ROWS_APART])
        uniform = len(rows) < FEWEST_ROWS or rows.min() == rows.max()
        before, self._before = self._before, rows
        if uniform:
            return None
        digest = zlib.crc32(rows.tobytes())
        if digest in self._seen or (before is not None and np.array_equal(before, rows)):
            return "the frame is the same, pixel by pixel, as an earlier one: the camera or its driver is frozen"
        self._seen.add(digest)
        if before is None or before.shape != rows.shape:
            return None
        equal = np.mean((before == rows).all(axis=1) & (rows.min(axis=1) != rows.max(axis=1)))
        if equal > EQUAL_ROWS:
            return f"{100 * equal:.0f} % of the frame's rows are those of the frame before: it did not arrive whole"
        return None

    def look(
        self, state: int, pixels: NDArray[np.generic], *, number: int, camera_ns: int, exposure_s: float, light: bool
    ) -> list[FrameFinding]:
        """New findings about a frame that is stored.

        Parameters
        ----------
        number, camera_ns : of the frame, as the camera reports them; 0 where it has no clock.
        light : whether it is a light state.
        """
        findings = []
        before, last_number, last_ns = self._last
        if number and number == last_number:
            text = (
                f"state {state} has the frame number {number} of state {before}: the camera does not count its frames"
            )
            findings.append(FrameFinding(state, "number", text))
        if camera_ns and last_ns and camera_ns <= last_ns:
            text = (
                f"state {state}: the camera's clock stands or runs back, its time is not after that of state {before}"
            )
            findings.append(FrameFinding(state, "time", text))
        self._last = state, number, camera_ns
        if light and self._rows is not None:
            means = block_means(pixels, BLOCKS, BLOCKS)
            self._blocks[state] = (means - self._black) / exposure_s
        # A clock that stands does so in every state from then on.
        findings = [finding for finding in findings if finding.kind not in {earlier.kind for earlier in self.found}]
        self.found += findings
        return findings

    def forget(self) -> None:
        """The states taken so far are taken again."""
        self._blocks.clear()

    def judge(self) -> list[FrameFinding]:
        """New findings from all light states of the run together."""
        if self._rows is None:
            return []
        states = np.array(sorted(self._blocks), dtype=int)
        rows = self._rows[states]
        if not len(states) or not np.isfinite(rows).all():
            return []
        blocks = np.array([self._blocks[state] for state in states])
        findings = mirrored_pictures(states, rows, blocks)
        findings = findings or brightness_steps(states, rows, blocks.mean(axis=(1, 2)))
        self.found += findings
        return findings


def brightness_steps(states: NDArray[np.int64], rows: Array, light: Array) -> list[FrameFinding]:
    """States that are brighter or darker by one factor than the others predict: single ones, or all from one on.

    Parameters
    ----------
    states : (N,) numbers in the plan, ascending.
    rows : (N, 16) of the measurement matrix.
    light : (N,) mean light of the frames.
    """
    findings: list[FrameFinding] = []
    keep = np.ones(len(states), dtype=bool)
    light = np.array(light, dtype=float)
    while len(findings) < MOST_FOUND:
        n, spare, outside = _outside(rows[keep])
        if spare < SPARE:
            break
        index, y = np.flatnonzero(keep), light[keep]
        residual = outside @ y
        rss = float(residual @ residual)
        # One state by itself: what it is over what the others say.
        free = np.clip(np.diag(outside), 1e-9, None)
        alone = np.where(free > 0.1, residual**2 / free, 0.0)
        k = int(np.argmax(alone))
        expected = y[k] - residual[k] / free[k]
        best = (rss - float(alone[k]), k, False, y[k] / expected if expected > 0 else np.inf)
        # From one on: what comes before is known but for what comes after, times a factor.
        for s in range(2, n - 1):
            before, after = outside[:, :s] @ y[:s], outside[:, s:] @ y[s:]
            norm = float(after @ after)
            gamma = -float(before @ after) / norm if norm > 0 else 1.0
            step = float(np.square(before + gamma * after).sum())
            # The part that has the fewer states is the one that is named.
            if gamma > 0.05 and step < best[0]:
                best = (step, s, True, 1 / gamma)
        remaining, k, onwards, factor = best
        if remaining >= rss or rss - remaining < DECISIVE * max(remaining, 1e-12 * float(y @ y)) / max(spare - 1, 1):
            break
        if abs(factor - 1) < LEAST_CHANGE or (onwards and _drifts(outside, y, remaining)):
            break
        state = int(states[index[k]])
        where = f"from state {state} on" if onwards else f"state {state} alone"
        findings.append(
            FrameFinding(
                state,
                "brightness",
                f"{where}: the light is {factor:.3g} times what the other states say, and nothing in the plan changes "
                "it: exposure, gain or lamp were not as reported",
            )
        )
        if onwards:
            light[index[k:]] /= factor
        else:
            keep[index[k]] = False
    return findings


def _outside(rows: Array) -> tuple[int, int, Array]:
    """Number of states, how many more they are than unknowns, and the projection (N, N) out of what rows explain."""
    u, s, _ = np.linalg.svd(rows, full_matrices=False)
    u = u[:, s > 1e-8 * s[0]]
    return len(rows), len(rows) - u.shape[1], np.eye(len(rows)) - u @ u.T


def _drifts(outside: Array, y: Array, step: float) -> bool:
    """Whether a linear drift of the light explains as much as a step."""
    ramp = outside @ (y * np.linspace(-1, 1, len(y)))
    residual = outside @ y
    norm = float(ramp @ ramp)
    return norm > 0 and float(residual @ residual) - float(residual @ ramp) ** 2 / norm <= 2 * step


def mirrored_pictures(states: NDArray[np.int64], rows: Array, blocks: Array) -> list[FrameFinding]:
    """All states from one on, or single ones, whose picture agrees with the others once it is mirrored.

    Parameters
    ----------
    states : (N,) numbers in the plan, ascending.
    rows : (N, 16) of the measurement matrix.
    blocks : (N, blocks, blocks) light of the parts of each picture.
    """
    _, spare, outside = _outside(rows)
    if spare < SPARE:
        return []
    if (step := _mirrored_from(outside, blocks)) is not None:
        k, words = step
        return [_mirrored(int(states[k]), f"from state {states[k]} on", words)]
    findings: list[FrameFinding] = []
    blocks = blocks.copy()
    while len(findings) < MOST_FOUND and (candidate := _mirrored_alone(rows, blocks)) is not None:
        k, words = candidate
        if int(states[k]) in (finding.state for finding in findings):
            break
        blocks[k] = MIRRORS[words](blocks[k])
        findings.append(_mirrored(int(states[k]), f"state {states[k]} alone", words))
    return findings


def _mirrored(state: int, where: str, words: str) -> FrameFinding:
    return FrameFinding(
        state, "picture", f"{where}: the picture is {words} against the other states: the camera changed"
    )


def _mirrored_from(outside: Array, blocks: Array) -> tuple[int, str] | None:
    """From which state on mirroring lets all agree with those before, and how; None if from no state on."""
    n = len(blocks)
    flat = blocks.reshape(n, -1)
    residual = outside @ flat
    rss, power = float(np.square(residual).sum()), float(np.square(flat).sum())
    best: tuple[float, int, str] = (MIRRORED_LEAVES * rss, 0, "")
    for words, mirror in MIRRORS.items():
        change = mirror(blocks).reshape(n, -1) - flat
        onwards = residual.copy()
        for k in range(n - 1, 0, -1):
            onwards += np.outer(outside[:, k], change[k])
            if k < n - 1:
                best = min(best, (float(np.square(onwards).sum()), k, words))
    is_visible = rss > LEAST_PATTERN**2 * power * np.trace(outside) / n**2
    return best[1:] if best[2] and is_visible else None


def _mirrored_alone(rows: Array, blocks: Array) -> tuple[int, str] | None:
    """The state whose picture has the odd part of its prediction with the opposite sign, and how; None without one.

    Mirroring changes the part of a picture that is odd under it, and nothing else. The others predict that part. How
    far the state's own part stays behind its prediction is held against the residuals of the others: Student's t, with
    a variance that all odd cosines share. Each counts by the part of its power that is not noise (Wiener).
    """
    # A program that takes a capture begins earlier without these libraries, which its end asks for.
    from scipy.fft import dctn, idctn
    from scipy.special import stdtrit

    n, best = len(rows), (np.inf, 0, "")
    cosines = dctn(blocks, axes=(1, 2), norm="ortho").reshape(n, -1)
    # Each cosine is even or odd under a mirror.
    ones = idctn(np.ones(blocks.shape[1:]), norm="ortho")
    odd = {words: (dctn(way(ones), norm="ortho") < 0).ravel() for words, way in MIRRORS.items()}
    for k in range(n):
        mask_others = np.arange(n) != k
        inverse = np.linalg.pinv(rows[mask_others], rcond=1e-8)
        weights = rows[k] @ inverse
        unknowns = round(float(np.trace(rows[mask_others] @ inverse)))
        freedom = n - 1 - unknowns
        if freedom < SPARE - 1:
            continue
        fitted = rows[mask_others] @ (inverse @ cosines[mask_others])
        residual = cosines[mask_others] - fitted
        power = np.square(fitted).mean(axis=0)
        noise = np.square(residual).sum(axis=0) / freedom
        noise_share = noise * unknowns / (n - 1) / np.maximum(power, np.finfo(float).tiny)
        share = np.where(noise_share < NOISE_SHARE, 1 - noise_share, 0.0)
        predicted = weights @ cosines[mask_others]
        for mask in odd.values():
            pattern = np.where(mask, share * predicted, 0.0)
            common, lent = _common_variance(noise[mask], freedom)
            spread = np.square(residual @ pattern).sum() + lent * common * (pattern @ pattern)
            spread *= (1 + weights @ weights) / (freedom + lent)
            limit = stdtrit(freedom + lent, MIRRORED_BY_CHANCE / (n * len(MIRRORS)))
            agreement = float(cosines[k] @ pattern)
            # The noise of the prediction agrees with itself.
            expected = float(predicted @ pattern) - float(share[mask] @ noise[mask]) * (weights @ weights)
            width = max(np.sqrt(spread), np.finfo(float).tiny)
            beyond = (agreement - expected) / width - limit
            # A mirrored picture that is turned back agrees as any other does.
            turned_back = expected > 0 and abs(agreement + expected) < -limit * width
            if turned_back and beyond < min(best[0], 0.0):
                # Mirroring turns the sign of the odd cosines.
                best = beyond, k, min(odd, key=lambda words: float((cosines[k] * predicted) @ odd[words]))
    return best[1:] if best[2] else None


def _common_variance(variances: Array, freedom: int) -> tuple[float, float]:
    """The variance that estimates with `freedom` degrees of freedom each have in common, and its degrees of freedom.

    The less their logarithms scatter beyond chance, the more each learns from all (Smyth, Stat. Appl. Genet. Mol. Biol.
    3, 3, 2004).
    """
    from scipy.special import digamma, polygamma

    logs = np.log(np.maximum(variances, np.finfo(float).tiny)) - digamma(freedom / 2) + np.log(freedom / 2)
    excess = float(logs.var(ddof=1) - polygamma(1, freedom / 2))
    # The inverse of the trigamma function, to 10 %.
    half = min(1 / excess + 0.5, MOST_FREEDOM / 2) if excess > 0 else MOST_FREEDOM / 2
    return float(np.exp(logs.mean() + digamma(half) - np.log(half))), 2 * half
