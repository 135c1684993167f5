"""Sentences: what can be wrong with an instrument, as a site, a quantity, and a course over the states.

A listed effect (`processing.instrument.effects`) is a sentence with a name, a cause and a remedy. The others are
written here by rule, so that a fault without a name can be found, corrected and described. A quantity follows the own
axis of an element or that of an element before it: light does not go back.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from processing.arrays import Array
from processing.effect import Parameter
from processing.instrument.changes import Changes, Conditions
from processing.instrument.elements import Element, Retarder
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller

#: [log odds] Price of a sentence without a name: with some hundred sentences one fault in seven is none of the list.
PRICE = 3.0
#: [log odds] Price of each period a turn beyond the second.
OF_A_HARMONIC = 0.5
#: [log odds] Price of each further kind of quantity: most mechanisms change one.
OF_A_PART = 2.0
#: [sizes] Bounds of every value.
REACH = 20.0
#: [degree] Phase of a wave from which on it is more than a slope.
LEAST_TURN_DEG = 180.0
#: [states] From which on a course over time is one.
FEWEST_STATES = 7
#: Courses over the time of one capture.
TIMES = ("over time", "settling", "warming")
#: [modes] Of what wanders: half a period to so many halves in a capture; faster waves have a frequency.
MODES = 12
#: Sites without a zero of their own. M is that of the mean sample of a capture, with the image of the first state.
WITHOUT_ZERO = ("sample", "image")
#: Quantities that a plate that turns may have.
OF_A_PLATE = (
    "retardance at 45 degrees",
    "circular retardance",
    "diattenuation at 45 degrees",
    "circular diattenuation",
    "depolarization",
    "inner reflection",
)
#: Parts of what one mechanism does to a plate: it is tilted, or light of another kind or direction passes it too.
TOGETHER = ("azimuth", "retardance", "circular retardance", "depolarization")
TOGETHER_TURNING = ("gain", "azimuth", "retardance", "diattenuation")
#: Behind the generator train, and between the analyzer train and the elements of the channels.
PATHS = ("path", "exit")
#: Quantities of a path.
OF_THE_PATH = (
    ("retardance at 0 degrees", "retardance at 45 degrees"),
    ("circular retardance",),
    ("diattenuation", "diattenuation at 45 degrees"),
    ("depolarization",),
)
#: Quantities of the image beside its shift, which has a name where it drifts or goes round once a turn.
SHIFT = ("shift right", "shift down")
OF_THE_IMAGE = (("blur",), ("brightness right", "brightness down"))


def _unit(i: int, j: int) -> Array:
    matrix = np.zeros((4, 4))
    matrix[i, j] = 1.0
    return matrix


#: Generators of a Mueller matrix in the frame of an element.
GENERATORS: Mapping[str, Array] = {
    "retardance at 45 degrees": _unit(3, 1) - _unit(1, 3),
    "circular retardance": _unit(2, 1) - _unit(1, 2),
    "diattenuation": _unit(0, 1) + _unit(1, 0),
    "diattenuation at 45 degrees": _unit(0, 2) + _unit(2, 0),
    "circular diattenuation": _unit(0, 3) + _unit(3, 0),
    "depolarization": -np.diag([0.0, 1.0, 1.0, 1.0]),
    "retardance at 0 degrees": _unit(2, 3) - _unit(3, 2),
}
#: [degree], [1], [of full scale], [pixel] or [square pixel] Size of each quantity on a decent bench.
SIZES: Mapping[str, tuple[str, float]] = {
    "azimuth": ("degree", 0.3),
    "retardance": ("degree", 0.6),
    "retardance at 45 degrees": ("degree", 0.6),
    "retardance at 0 degrees": ("degree", 0.6),
    "circular retardance": ("degree", 0.4),
    "diattenuation": ("1", 0.005),
    "diattenuation at 45 degrees": ("1", 0.005),
    "circular diattenuation": ("1", 0.005),
    "depolarization": ("1", 0.003),
    "inner reflection": ("1", 0.003),
    "gain": ("1", 0.005),
    "stray": ("1", 0.003),
    "lag": ("1", 0.005),
    "offset": ("1", 0.0005),
    "shift right": ("pixel", 0.2),
    "shift down": ("pixel", 0.2),
    "blur": ("square pixel", 0.1),
    "brightness right": ("1", 0.005),
    "brightness down": ("1", 0.005),
}


@dataclass(frozen=True)
class Sentence:
    """One thing that can be wrong: `quantities` of a `site`, each following `course`."""

    site: str
    quantities: tuple[str, ...]
    course: str = ""

    @property
    def text(self) -> str:
        """The sentence; it is the place of the effect in files."""
        quantities = " and ".join(self.quantities)
        return f"{quantities} of {self.site}" + (f" {self.course}" if self.course else "")

    @property
    def of_one_capture(self) -> bool:
        """Whether it depends on the time of a capture, and differs in the next capture."""
        return bool(self.course) and not self.course.startswith("by ")

    def price(self, conditions: Conditions) -> float:
        """[log odds] Prior odds against the sentence: more for a high harmonic, and for one of many states or waves."""
        kind, _, wave = self.course.partition(" ")
        price = PRICE + OF_A_PART * (len({q.split()[0] for q in self.quantities}) - 1)
        if kind == "by":
            return price + OF_A_HARMONIC * max(int(wave.split()[0]) - 2, 0)
        of_several = {"from": conditions.states, "beating": _beats(conditions.states).size}.get(kind, 1)
        return price + float(np.log(of_several))

    def parameters(self, conditions: Conditions) -> tuple[Parameter, ...]:
        """One for each quantity and each part of the course."""
        names = _course_names(self.course)
        parameters = []
        for quantity in self.quantities:
            unit, size = SIZES[quantity]
            for name in names:
                full = "_".join(x for x in (quantity.replace(" ", "_") if len(self.quantities) > 1 else "", name) if x)
                parameters.append(Parameter(full or "value", unit, -REACH * size, REACH * size, size))
        return tuple(parameters)

    def apply(self, changes: Changes, model: InstrumentModel, values: Array) -> None:
        """Add the sentence with these values to the changes."""
        courses = course(self.course, changes.conditions)
        if self.site in WITHOUT_ZERO:
            is_first = self.site == "image" and self.of_one_capture
            courses = courses - (courses[:, :1] if is_first else courses.mean(axis=1, keepdims=True))
        parts = values.reshape(len(self.quantities), -1) @ courses
        for quantity, part in zip(self.quantities, parts, strict=True):
            _add(changes, model, self.site, quantity, part=part)


@lru_cache(maxsize=4096)
def parse_sentence(text: str) -> Sentence:
    """The sentence of a text. Raises KeyError: it is none."""
    quantity, _, remainder = text.partition(" of ")
    while quantity not in SIZES and not all(q in SIZES for q in quantity.split(" and ")):
        more, separator, remainder = remainder.partition(" of ")
        if not separator:
            raise KeyError(text)
        quantity = f"{quantity} of {more}"
    site, _, name = remainder.partition(" ")
    return Sentence(site, tuple(quantity.split(" and ")), name)


def _course_names(name: str) -> tuple[str, ...]:
    if name.startswith("beating"):
        return ("cos", "sin", "cos_trend", "sin_trend")
    if name == "wandering":
        return tuple(f"mode_{m}" for m in range(1, MODES + 1))
    return ("cos", "sin") if name.startswith("by ") else ("",)


def course(name: str, conditions: Conditions) -> Array:
    """Courses (k, N) over the states of one capture."""
    n = conditions.states
    k, t = np.arange(n), conditions.elapsed
    if not name:
        return np.ones((1, n))
    if name.startswith("by "):
        harmonic, axis = name[3:].split(" x ")
        angle = int(harmonic) * np.deg2rad(conditions.angles_deg[axis])
        return np.stack([np.cos(angle), np.sin(angle)])
    if name == "over time":
        return np.asarray(t[None])
    if name == "settling":
        return np.exp(-k / (n / 10))[None]
    if name == "warming":
        return (1 - np.exp(-k / (n / 2.7)))[None]
    if name == "wandering":
        # A random walk about its trend: the amplitude of a wave falls with its frequency.
        modes = np.arange(1, MODES + 1)[:, None]
        walk, trend = np.cos(np.pi * modes * (k + 0.5) / n) / modes, np.linalg.qr(np.stack([np.ones(n), k], axis=1))[0]
        return np.asarray(walk - walk @ trend @ trend.T)
    if name.startswith("beating "):
        # A wave of a frequency between two of the grid grows against its neighbour along the capture.
        turn, trend = 2 * np.pi * float(name.split()[1]) * k / n, 2 * k / n - 1
        return np.stack([np.cos(turn), np.sin(turn), trend * np.cos(turn), trend * np.sin(turn)])
    if name.startswith("from state "):
        return (k >= int(name[11:]))[None].astype(float)
    raise KeyError(name)


def _add(changes: Changes, model: InstrumentModel, site: str, quantity: str, *, part: Array) -> None:
    unit, _ = SIZES[quantity]
    value = np.deg2rad(part) if unit == "degree" else part
    if quantity == "azimuth" and site == "sample":
        for element in model.elements():
            changes.azimuth_rad[element.name] = changes.azimuth_rad[element.name] + value
    elif quantity == "azimuth":
        changes.azimuth_rad[site] = changes.azimuth_rad[site] + value
    elif quantity == "retardance":
        changes.retardance_rad[site] = changes.retardance_rad[site] + value
    elif quantity == "gain":
        changes.gain = changes.gain * (1 + value)[:, None]
    elif quantity == "stray":
        changes.stray = changes.stray + value
    elif quantity == "lag":
        changes.lag += float(value[0])
    elif quantity == "offset":
        changes.response["one"] = changes.response["one"] - value[:, None] * np.ones(len(changes.conditions.channels))
    elif quantity.startswith("brightness"):
        name = quantity.split()[1]
        changes.response[name] = changes.response[name] - value[:, None] * np.ones(len(changes.conditions.channels))
    elif quantity == "blur":
        changes.blur_px2 = changes.blur_px2 + value
    elif quantity in SHIFT:
        changes.shift_px = changes.shift_px + np.outer(value, (1, 0) if quantity == "shift right" else (0, 1))
    else:
        _bend(changes, model, site, quantity, value=value)


def _bend(changes: Changes, model: InstrumentModel, site: str, quantity: str, *, value: Array) -> None:
    """A Mueller matrix beside an element: behind it on the way to the sample, before it on the way from there."""
    if site in PATHS:
        last = (model.generator if site == "path" else model.analyzer)[-1]
        changes.follow(last.name, _exponential(value[:, None, None] * GENERATORS[quantity]))
        return
    element = site
    part = next(e for e in model.elements() if e.name == element)
    behind = any(e.name == element for e in model.generator)
    angle = part.azimuth_rad(changes.conditions.angles_deg, changes.conditions.states)
    share = value[:, None, None]
    if quantity == "inner reflection":
        # Light that is sent back twice inside a plate passes it three times.
        passage = part.mueller(angle)
        bent = np.eye(4) + share * (passage @ passage - np.eye(4))
    else:
        bent = mueller.rotation(angle) @ _exponential(share * GENERATORS[quantity]) @ mueller.rotation(-angle)
    (changes.follow if behind else changes.precede)(element, bent)


def _exponential(a: Array) -> Array:
    total = term = np.broadcast_to(np.eye(4), a.shape)
    for k in (1, 2, 3, 4):
        term = term @ a / k
        total = total + term
    return np.asarray(total)


def sentences(model: InstrumentModel, conditions: Conditions) -> tuple[Sentence, ...]:
    """All sentences about an instrument in these conditions, without the effects that have names."""
    turning = {axis: _turn_deg(conditions, axis) for axis in model.axes}
    times = TIMES if conditions.states >= FEWEST_STATES else ()
    result: list[Sentence] = []
    passed: dict[str, float] = {}
    for element in model.generator:
        result += _of_element(element, turning, passed, times, front=True)
    if len(model.generator) > 1:
        result += _of_path("path", passed, times)
        result.append(Sentence("path", ("diattenuation", "diattenuation at 45 degrees")))
        result += [Sentence("sample", ("azimuth",), time) for time in times]
    states = conditions.states if times else 0
    for element in model.analyzer:
        result += _of_element(element, turning, passed, times, front=False)
        if not isinstance(element, Retarder):
            result += _jumps(element.name, "azimuth", states)
    if states and model.analyzer and any(c.elements for c in model.channels):
        result += _of_path("exit", passed, times)
        result.append(Sentence("exit", OF_THE_PATH[0]))
    result += _of_source_and_detector(states, times, turning)
    # Once a turn it has a name.
    result += _waves("image", SHIFT, turning, (2,))
    for quantities in OF_THE_IMAGE:
        result += _waves("image", quantities, turning, (1, 2))
        result += [Sentence("image", quantities, time) for time in times[:1]]
    if states > 2 * MODES:
        result.append(Sentence("source", ("gain",), "wandering"))
    # Where its level in each state is projected out it has any course.
    return tuple(dict.fromkeys(s for s in result if s.site != "source" or not model.projects_source))


def _turn_deg(conditions: Conditions, axis: str) -> float:
    """Angle through which an axis turns; 0 where it takes no more than two."""
    angle = conditions.angles_deg.get(axis, np.zeros(1))
    return float(np.ptp(angle)) if np.unique(np.round(angle, 3)).size > 2 else 0.0


def _waves(
    site: str, quantities: tuple[str, ...], axes: Mapping[str, float], periods: Sequence[int]
) -> Iterator[Sentence]:
    """Sentences about harmonics of axes that turn through so many degrees, where each is more than a slope."""
    for axis, turn_deg in axes.items():
        for n in periods:
            if n * turn_deg > LEAST_TURN_DEG:
                yield Sentence(site, quantities, f"by {n} x {axis}")


def _of_element(
    element: Element, turning: Mapping[str, float], passed: dict[str, float], times: Sequence[str], *, front: bool
) -> Iterator[Sentence]:
    """Sentences about one element, which may depend on the axes that the light has `passed`, its own included."""
    name, earlier = element.name, dict(passed)
    axes = {element.axis: turning[element.axis]} if element.axis and turning[element.axis] else {}
    passed |= axes
    if isinstance(element, Retarder):
        yield from _waves(name, ("retardance",), axes, (2, 3, 4))
        yield from _waves(name, ("retardance",), earlier if not front else {}, (1, 2))
        yield from _waves(name, ("azimuth",), axes, (3, 4))
        yield from _waves("source", ("gain",), axes, (3, 4))
        yield from _waves(name, ("diattenuation",), axes, (1, 2))
        if axes:
            yield Sentence(name, TOGETHER)
            yield from _waves(name, TOGETHER_TURNING, axes, (1, 2))
            yield from (Sentence(name, (quantity,)) for quantity in OF_A_PLATE)
            yield from (Sentence(name, (q,), time) for time in times[1:] for q in ("azimuth", "retardance"))
    else:
        yield from _waves(name, ("azimuth",), earlier if not front else {}, (1, 2))
        yield from (Sentence(name, (q,), time) for time in times for q in ("azimuth", "retardance at 45 degrees"))
        if not front:
            yield Sentence(name, ("retardance at 45 degrees",))


def _of_path(site: str, passed: Mapping[str, float], times: Sequence[str]) -> Iterator[Sentence]:
    """Sentences about a path behind the axes that the light has `passed`."""
    at_exit = site == "exit"
    for quantities in (*OF_THE_PATH, ("circular diattenuation",)) if at_exit else OF_THE_PATH:
        yield from _waves(site, quantities, passed, (1, 2, 4) if at_exit else (1, 2))
        yield from (Sentence(site, quantities, time) for time in times)


def _jumps(site: str, quantity: str, states: int) -> Iterator[Sentence]:
    """From one state on, of which any may be it."""
    yield from (Sentence(site, (quantity,), f"from state {k}") for k in range(2, states - 1))


def _beats(states: int) -> Array:
    """Waves over a capture, half a wave apart."""
    return np.arange(1.5, states / 2, 0.5)


def _of_source_and_detector(states: int, times: Sequence[str], turning: Mapping[str, float]) -> Iterator[Sentence]:
    yield from (Sentence("source", ("gain",), time) for time in times[1:])
    yield from _jumps("source", "gain", states)
    yield from (Sentence("source", ("gain",), f"beating {n:g} times") for n in _beats(states))
    yield from (Sentence("detector", (quantity,), time) for quantity in ("stray", "offset") for time in times)
    # Light that a moving element sends back on its way.
    yield from _waves("detector", ("stray",), turning, (1, 2, 4))
    if states:
        yield Sentence("detector", ("lag",))
