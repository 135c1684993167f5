"""What `diagnose` made of a real bench against its truth: the Mueller matrix of another sample, and the names."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from simulators.blind.real_bench import FITTED, VALIDATION, RealBench, TrueFault

Result = Mapping[str, Any]

#: Captures that are given to `diagnose`, by name.
GIVEN: dict[str, tuple[str, ...]] = {"joint": FITTED, **{name: (name,) for name in FITTED}}
#: Mistakes of wiring that are a wrong ratio.
TURNED_OTHERWISE = ("psg_reversed", "psa_reversed", "both_reversed", "ratio", "half_degrees", "double_degrees")
#: Words that a sentence about a mistake of wiring must have.
WIRING_WORDS = {
    "psg_reversed": "axis 'psg' turns the other way",
    "psa_reversed": "axis 'psa' turns the other way",
    "both_reversed": "both axes turn the other way",
    "axes_swapped": "each other's place",
    "ratio": "axis 'psa' was driven with a ratio of",
    "psg_zero": "'psg_retarder' is a quarter turn off",
    "psa_zero": "'psa_retarder' is a quarter turn off",
    "analyzer_zero": "'analyzer' is a quarter turn off",
    "frame_order": "in reverse order",
    "off_by_one": "the states are one ",
    "half_degrees": "in units of two degrees",
    "double_degrees": "in half degrees",
    "wavelength": "wavelength",
    "mirrored_image": "mirrored left and right",
    "rotated_image": "turned by 180 degrees",
    "mosaic_order": "mirrored up and down",
}
#: Names that are true as well: in the counts the fault is that.
TRUE_AS_WELL = {
    "lamp_beat": {"source_flicker"},
    "lamp_jump": {"source_flicker"},
    **{name: {"rotation_ratio"} for name in TURNED_OTHERWISE},
    "off_by_one": {"psg_azimuth", "psa_azimuth"},
    "psg_zero": {"psg_azimuth"},
    "psa_zero": {"psa_azimuth"},
    "analyzer_zero": {"analyzer_azimuth"},
    "wavelength": {"psg_retardance", "psa_retardance"},
}
#: Probability of a cause that is called by a word alone.
WORDS = {"sure": 0.99, "likely": 0.9, "one_of": 0.9, "unknown": 0.5}
NAME = re.compile(r"(?P<kind>\w+)(?:\[(?P<place>[^\]]*)\])?")


@dataclass(frozen=True)
class TrueCause:
    """One cause that `diagnose` tells.

    `certainty` is a word of `WORDS`; `probability` that one of the set is there; `right` says that the name is true,
    `right_set` that it or another of its set is.
    """

    label: str
    certainty: str
    probability: float
    right: bool
    right_set: bool


@dataclass(frozen=True)
class Matter:
    """A true fault, its size (see `TrueFault`), and its outcome: "named", "in a set" or "missed"."""

    label: str
    size: float
    told: str


@dataclass(frozen=True)
class BenchJudgement:
    """One bench, diagnosed from the captures `given`.

    Attributes
    ----------
    declared, corrected, oracle : rms error of M / m00 of the validation sample without noise, with the instrument as
        declared, with the file that `diagnose` wrote, and with a fit of the true set; NaN where there is none.
    own : the same of each capture that was given, as declared and corrected.
    coverage_pixels, coverage_patches : of the validation sample with noise.
    written : whether there is a file.
    """

    name: str
    group: str
    given: str
    verdict: str
    seconds: float
    declared: float
    corrected: float
    oracle: float
    own: dict[str, tuple[float, float]]
    coverage_pixels: float
    coverage_patches: float
    written: bool
    causes: tuple[TrueCause, ...] = ()
    matters: tuple[Matter, ...] = ()
    wiring: tuple[TrueCause, ...] = ()
    noise: str = ""
    left_out: tuple[Any, ...] = field(default=())


def judgement_of(raw: Mapping[str, Any]) -> BenchJudgement:
    """A judgement from its JSON."""
    return BenchJudgement(
        **{
            **raw,
            "own": {name: (pair[0], pair[1]) for name, pair in raw["own"].items()},
            "causes": tuple(TrueCause(**c) for c in raw["causes"]),
            "matters": tuple(Matter(**m) for m in raw["matters"]),
            "wiring": tuple(TrueCause(**c) for c in raw["wiring"]),
        }
    )


def names_of(result: Result, truth: RealBench, captures: Sequence[str]) -> tuple[TrueCause, ...]:
    """Every cause of a result, compared with the faults that act in the captures given."""
    acting = active(truth, captures)
    return tuple(_cause(e, acting) for e in result["effects"])


def active(truth: RealBench, captures: Iterable[str]) -> list[TrueFault]:
    """Faults that act in some of these captures."""
    return [f for f in truth.faults if f.capture is None or f.capture in captures]


def _cause(effect: Mapping[str, Any], faults: Sequence[TrueFault]) -> TrueCause:
    also = tuple(effect["indistinguishable_from"])
    certainty = _certainty(effect)
    probability = effect.get("probability")
    capture = effect.get("capture")
    name = f"{effect['kind']}[{effect['element'] or ''}]"
    right = _is_true(name, capture, faults)
    return TrueCause(
        name + (f" in {capture}" if capture else ""),
        certainty,
        WORDS[certainty] if probability is None else float(probability),
        right,
        right or any(_is_true(text, capture, faults) for text in also),
    )


def _certainty(effect: Mapping[str, Any]) -> str:
    """A word of `WORDS`: the answer of the result; of a result without one, that its `confident` stands for."""
    if effect.get("answer"):
        return str(effect["answer"]).replace(" ", "_")
    if not effect["confident"]:
        return "unknown"
    return "one_of" if effect["indistinguishable_from"] else "sure"


def _is_true(text: str, capture: str | None, faults: Sequence[TrueFault]) -> bool:
    return any(_names(text, capture, f) for f in faults)


def _names(text: str, capture: str | None, fault: TrueFault) -> bool:
    """Whether a name, "kind" or "kind[place]", is that of a fault."""
    match = NAME.match(text)
    if match is None:
        return False
    kind, place = match["kind"], match["place"]
    if capture is not None and fault.capture is not None and capture.partition(" ")[0] != fault.capture:
        return False
    if kind in TRUE_AS_WELL.get(fault.kind, ()):
        return True
    return kind == fault.kind and (not place or not fault.place or place == fault.place)


def matters_of(result: Result, truth: RealBench, captures: Sequence[str]) -> tuple[Matter, ...]:
    """Size and outcome of each fault that acts in the captures."""
    out = []
    for fault in active(truth, captures):
        size = max((v for c, v in fault.matters.items() if c in (*captures, VALIDATION)), default=0.0)
        outcome = "missed"
        for effect in result["effects"]:
            if _certainty(effect) == "unknown":
                continue
            if _names(f"{effect['kind']}[{effect['element'] or ''}]", effect.get("capture"), fault):
                outcome = "named"
                break
            if any(_names(text, effect.get("capture"), fault) for text in effect["indistinguishable_from"]):
                outcome = "in a set"
        label = f"{fault.kind}[{fault.place}]" + (f" in {fault.capture}" if fault.capture else "")
        out.append(Matter(label, size, outcome))
    return tuple(out)


def wiring_of(result: Result, truth: RealBench) -> tuple[TrueCause, ...]:
    """The mistake of wiring that was reported, compared with the truth."""
    text = result.get("wiring")
    if not text:
        return ()
    right = any(WIRING_WORDS[f.kind] in text for f in truth.faults if f.kind in WIRING_WORDS)
    return (TrueCause(text, "sure", WORDS["sure"], right, right),)
