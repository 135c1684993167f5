"""Changes by effects in the forward model of one capture: elements, gains and counts, state by state."""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from processing.arrays import Array

#: Standard deviation of a normal distribution over its median absolute deviation.
MAD_TO_SIGMA = 1.4826
#: [of full scale] Below this, a power of the counts is taken as straight: curved within the noise of a dark pixel, it
#: would narrow that noise, which looks like evidence for it. Cameras with a tone curve are straight up to about 0.003.
STRAIGHT_BELOW = 1e-3
#: Names of the smooth terms of what varies over the image.
FIELD_TERMS = ("x", "y", "x2", "xy", "y2")


@dataclass(frozen=True)
class Conditions:
    """Conditions of the states of one capture.

    Attributes
    ----------
    angles_deg : axis name to (N,), as read back.
    states : N.
    channels : names of the detector channels.
    elapsed : (N,), time since the middle of the capture over its whole length, -0.5 to 0.5; state number
        instead of time where the capture has no clock.
    elapsed_error : standard error of these times.
    full_scale : counts at the top of the detector's range.
    run : (N,) number, from 0, of the run that took each state; the source may jump between them.
    """

    angles_deg: Mapping[str, Array]
    states: int
    channels: tuple[str, ...]
    elapsed: Array
    full_scale: float = 1.0
    run: NDArray[np.int64] = field(default_factory=lambda: np.zeros(1, dtype=np.int64))
    elapsed_error: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "run", np.broadcast_to(self.run, (self.states,)))

    @classmethod
    def of(cls, angles_deg: Mapping[str, Array], channels: tuple[str, ...] = ("camera",)) -> "Conditions":
        """Conditions of bare angles: equal steps in time, full scale 1."""
        sizes = {np.size(v) for v in angles_deg.values()} or {1}
        n = sizes.pop()
        arrays = {k: np.asarray(v, dtype=float).reshape(-1) for k, v in angles_deg.items()}
        return cls(arrays, n, channels, elapsed(None, n))


def elapsed(time_s: Array | None, states: int) -> Array:
    """Time (N,) scaled to -0.5 ... 0.5; state number where no time is known."""
    t = np.arange(states, dtype=float)
    if time_s is not None and np.all(np.isfinite(time_s)) and np.ptp(time_s) > 0:
        t = np.asarray(time_s, dtype=float)
    span = np.ptp(t)
    return np.asarray((t - t.min()) / span - 0.5 if span > 0 else np.zeros(states))


def elapsed_error(time_s: Array, other_s: Array) -> float:
    """Standard error of `elapsed`, as a second clock (N,) shows it; 0 where that does not run.

    Of differences between one state and the next, whose median a clock that is set or begins anew does not move.
    """
    steps = np.diff(time_s) - np.diff(other_s)
    if steps.size == 0 or not (np.all(np.isfinite(steps)) and np.ptp(other_s) > 0 and np.ptp(time_s) > 0):
        return 0.0
    return float(MAD_TO_SIGMA * np.median(np.abs(steps)) / np.sqrt(2) / np.ptp(time_s))


def places(height: int, width: int) -> tuple[Array, Array]:
    """Position of each pixel (rows, columns) of an image, x to the right and y down, from -1 to 1."""
    y, x = (np.linspace(-1, 1, size) if size > 1 else np.zeros(1) for size in (height, width))
    return np.broadcast_to(x, (height, width)), np.broadcast_to(y[:, None], (height, width))


def field_terms(x: Array, y: Array) -> Array:
    """(5, ...) the smooth terms, each with mean zero over the image; x and y run from -1 to 1, right and down."""
    return np.stack([x, y, x * x - 1 / 3, x * y, y * y - 1 / 3])


#: Changes by name that an element's own Mueller matrices depend on.
OF_MATRICES = ("azimuth_rad", "retardance_rad", "extinction", "diattenuation", "depolarization")
#: Changes by name that the vectors of a generator or an analyzer depend on.
OF_TRAINS = (*OF_MATRICES, "after", "before")
#: Changes by name that add up.
ADDED = (*OF_MATRICES, "field_retardance_rad", "response")
#: Matrices and vectors that were built before, by what they are and the changes of their elements.
Built = dict[tuple[object, ...], Array]


def _zeros() -> defaultdict[str, Array]:
    return defaultdict(lambda: np.zeros(()))


@lru_cache(maxsize=64)
def _nothing(states: int, channels: int) -> tuple[Array, Array, Array]:
    """Gain, shift and blur that change nothing: one object, so that who adds changes sees what has none."""
    arrays = np.ones((states, channels)), np.zeros((states, 2)), np.zeros(states)
    for array in arrays:
        array.flags.writeable = False
    return arrays


@dataclass
class Changes:
    """Sum of what all effects ask for; an empty one is the model as it stands.

    Light side, all by element name: `azimuth_rad`, `retardance_rad` (each () or (N,)), `extinction`, `diattenuation`,
    `depolarization`, `after` (a Mueller matrix (4, 4) that follows the element), `field_retardance_rad` (5,)
    coefficients of `field_terms`.
    Detector side: `gain` (N, channels), `stray` (fraction of the mean signal that bypasses the optics), `mixing`
    (channels, channels), `lag` (share of a state that is read with the next one). Count side, what is added to the
    counts: `response` by feature of the counts, some of them times the place in the image, () or (N, channels);
    `shift_px` (N, 2), by how much the image has moved to the right and down; `blur_px2` (N,), variance of a blur of
    each axis, beyond the usual one.
    """

    conditions: Conditions
    azimuth_rad: defaultdict[str, Array] = field(default_factory=_zeros)
    retardance_rad: defaultdict[str, Array] = field(default_factory=_zeros)
    extinction: defaultdict[str, Array] = field(default_factory=_zeros)
    diattenuation: defaultdict[str, Array] = field(default_factory=_zeros)
    depolarization: defaultdict[str, Array] = field(default_factory=_zeros)
    after: dict[str, Array] = field(default_factory=dict)
    before: dict[str, Array] = field(default_factory=dict)
    field_retardance_rad: defaultdict[str, Array] = field(default_factory=_zeros)
    gain: Array = field(init=False)
    stray: Array | float = 0.0
    mixing: Array | None = None
    lag: float = 0.0
    response: defaultdict[str, Array] = field(default_factory=_zeros)
    shift_px: Array = field(init=False)
    blur_px2: Array = field(init=False)
    drop_clipped: bool = False
    #: Shared by all changes of one model and capture: a fit changes one element at a time.
    built: Built | None = None

    def __post_init__(self) -> None:
        self.gain, self.shift_px, self.blur_px2 = _nothing(self.conditions.states, len(self.conditions.channels))

    def of_states(self, chosen: NDArray[np.int64]) -> "Changes":
        """The same for some of the states, by their positions."""
        states, c = self.conditions.states, self.conditions

        def among(x: Array) -> Array:
            return x[chosen] if np.ndim(x) and len(x) == states else x

        subset = copy(self)
        subset.built = None
        subset.conditions = replace(
            c,
            angles_deg={axis: angle[chosen] for axis, angle in c.angles_deg.items()},
            states=len(chosen),
            elapsed=c.elapsed[chosen],
            run=c.run[chosen],
        )
        subset.gain, subset.shift_px, subset.blur_px2 = self.gain[chosen], self.shift_px[chosen], self.blur_px2[chosen]
        subset.stray = among(np.asarray(self.stray))
        subset.after = {key: among(x) if np.ndim(x) == 3 else x for key, x in self.after.items()}
        subset.before = {key: among(x) if np.ndim(x) == 3 else x for key, x in self.before.items()}
        for name in ("azimuth_rad", "retardance_rad", "response"):
            of_all = getattr(self, name)
            setattr(subset, name, defaultdict(of_all.default_factory, {key: among(x) for key, x in of_all.items()}))
        return subset

    @property
    def corrects_counts(self) -> bool:
        """Whether anything is added to the counts."""
        _, shift_px, blur_px2 = _nothing(self.conditions.states, len(self.conditions.channels))
        return bool(self.response) or self.shift_px is not shift_px or self.blur_px2 is not blur_px2

    def copied(self, built: Built | None = None) -> "Changes":
        """A copy to which others can be added."""
        new = object.__new__(Changes)
        own = {name: getattr(self, name).copy() for name in (*ADDED, "after", "before")}
        vars(new).update(vars(self) | own, built=built)
        return new

    def once(self, what: str, elements: Sequence[str], kinds: tuple[str, ...], make: Callable[[], Array]) -> Array:
        """The array of `make`. It is made anew only if these kinds of changes of its elements are new.

        `what` names the array: an element for its matrices (N, 4, 4), or a train for its vectors.
        """
        if self.built is None:
            return make()
        changes = [(kind, by_name) for kind in kinds if (by_name := vars(self)[kind])]
        values = [(kind, name, by_name[name]) for kind, by_name in changes for name in elements if name in by_name]
        # A train and one of its elements may have the same name, but not the same kinds.
        key = (what, kinds, *((kind, name, np.asarray(value, float).tobytes()) for kind, name, value in values))
        if key not in self.built:
            self.built[key] = make()
        return self.built[key]

    def add(self, other: "Changes") -> None:
        """Add what others ask for, of the same conditions."""
        for name in ADDED:
            if more := getattr(other, name):
                total = getattr(self, name)
                for key, value in more.items():
                    total[key] = total[key] + value if key in total else value
        for element, mueller in other.after.items():
            self.follow(element, mueller)
        for element, mueller in other.before.items():
            self.precede(element, mueller)
        if other.mixing is not None:
            self.mixing = other.mixing if self.mixing is None else other.mixing @ self.mixing
        gain, shift_px, blur_px2 = _nothing(self.conditions.states, len(self.conditions.channels))
        if other.gain is not gain:
            self.gain = self.gain * other.gain
        if other.shift_px is not shift_px:
            self.shift_px = self.shift_px + other.shift_px
        if other.blur_px2 is not blur_px2:
            self.blur_px2 = self.blur_px2 + other.blur_px2
        self.stray = self.stray + other.stray
        self.lag += other.lag
        self.drop_clipped = self.drop_clipped or other.drop_clipped

    def turn_axis(self, axis: str, error_deg: Array, elements: Mapping[str, float]) -> None:
        """The axis has an error of `error_deg` (N,); `elements` are the ratios of the elements that it turns."""
        for name, ratio in elements.items():
            self.azimuth_rad[name] = self.azimuth_rad[name] + ratio * np.deg2rad(error_deg)

    def follow(self, element: str, mueller: Array) -> None:
        """Put a Mueller matrix behind an element."""
        self.after[element] = mueller @ self.after[element] if element in self.after else mueller

    def precede(self, element: str, mueller: Array) -> None:
        """Put a Mueller matrix before an element."""
        self.before[element] = self.before[element] @ mueller if element in self.before else mueller
