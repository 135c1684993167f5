"""Mistakes of wiring and of files: the declared bench is wrong by a discrete step.

Each changes what the capture file says or how the bench is put together, and its truth has the name of the hypothesis
that mends it. Sizes that a calibration could find are in `lab_priors`.
"""

from collections.abc import Callable

import numpy as np

from processing.arrays import Array
from simulators.blind.undeclared_captures import TrueBench
from simulators.blind.undeclared_faults import Fault, Truth

Angles = dict[str, Array]


def _angle_fault(name: str, change: Callable[[Angles], Angles]) -> Fault:
    """The angles in the capture file are not those of the bench."""

    def fault(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
        bench.recorded.append(change)
        return Truth(name)

    return fault


def _frame_fault(name: str, change: Callable[[Array], Array]) -> Fault:
    """The frames in the capture file are not as the camera took them."""

    def fault(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
        bench.stored.append(change)
        return Truth(name)

    return fault


def _zero(name: str, attribute: str, steps_deg: tuple[float, ...]) -> Fault:
    """An element stands at another mark of its mount."""

    def fault(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
        step = float(random.choice(steps_deg))
        setattr(bench, attribute, getattr(bench, attribute) + np.deg2rad(step))
        return Truth(name, "", {"azimuth": step})

    return fault


def wavelength(bench: TrueBench, random: np.random.Generator, states: int) -> Truth:
    """The filter in the beam is not the one that the capture file names (RGB950: 451 for 662 nm, or the reverse)."""
    retardances = {451.0: (130.01, 143.13), 662.0: (127.12, 94.78)}
    true_nm = next(nm for nm in retardances if nm != bench.wavelength_nm)
    bench.dg, bench.da = np.deg2rad(retardances[true_nm])
    return Truth("wavelength", "", {"true_nm": true_nm})


WIRING: dict[str, Fault] = {
    "psg_reversed": _angle_fault("psg_reversed", lambda a: a | {"psg": -a["psg"]}),
    "psa_reversed": _angle_fault("psa_reversed", lambda a: a | {"psa": -a["psa"]}),
    "both_reversed": _angle_fault("both_reversed", lambda a: {name: -v for name, v in a.items()}),
    "axes_swapped": _angle_fault("axes_swapped", lambda a: a | {"psg": a["psa"], "psa": a["psg"]}),
    "ratio": _angle_fault("ratio", lambda a: a | {"psa": 5.0 * a["psg"]}),
    "psg_zero": _zero("psg_zero", "og", (20.0, -20.0, 45.0, 90.0)),
    "psa_zero": _zero("psa_zero", "oa", (20.0, -20.0, 45.0, 90.0)),
    "analyzer_zero": _zero("analyzer_zero", "lp", (20.0, -20.0, 45.0, 90.0)),
    "frame_order": _angle_fault("frame_order", lambda a: {name: v[::-1].copy() for name, v in a.items()}),
    "off_by_one": _angle_fault("off_by_one", lambda a: {name: np.roll(v, 1) for name, v in a.items()}),
    "half_degrees": _angle_fault("half_degrees", lambda a: {name: v / 2 for name, v in a.items()}),
    "double_degrees": _angle_fault("double_degrees", lambda a: {name: 2 * v for name, v in a.items()}),
    "wavelength": wavelength,
}
#: Of a polarization camera: what moves its super-pixels against the declared layout.
MOSAIC_WIRING: dict[str, Fault] = {
    "mirrored_image": _frame_fault("mirrored_image", lambda c: c[..., ::-1]),
    "rotated_image": _frame_fault("rotated_image", lambda c: c[:, ::-1, ::-1]),
    "mosaic_order": _frame_fault("mosaic_order", lambda c: c[:, ::-1]),
}
