"""Faults of a bench in a lab, their frequencies and sizes: the distribution that real benches are drawn from.

Sizes are what is left after an ordinary calibration of an ordinary bench, drawn evenly in the logarithm between the
two numbers, with a random sign where the fault has one. docs/studies/real-benches.md has them with
their reasons. `weight` is the relative chance that a bench has the fault at all.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Prior:
    """Chance (relative) and sizes of one kind of fault; in the unit of the fault."""

    weight: float
    sizes: tuple[float, float]
    reason: str

    @property
    def rms(self) -> float:
        """Root mean square of the sizes."""
        low, high = self.sizes
        return float(np.sqrt((high**2 - low**2) / (2 * np.log(high / low))))


#: How many faults a bench has, least and most.
FAULTS = (6, 10)

PRIORS: dict[str, Prior] = {
    "psg_retardance": Prior(0.6, (0.2, 2.0), "degrees; plates are sold to lambda/300 to lambda/100, and warm up"),
    "psa_retardance": Prior(0.6, (0.2, 2.0), "degrees; as the generator's"),
    "psg_azimuth": Prior(0.5, (0.05, 0.5), "degrees; homing switches repeat to 0.05, marks on mounts to 0.5"),
    "psa_azimuth": Prior(0.5, (0.05, 0.5), "degrees; as the generator's"),
    "analyzer_azimuth": Prior(0.4, (0.05, 0.5), "degrees; turned by hand to a scale"),
    "psg_extinction": Prior(0.3, (0.0003, 0.005), "film polarizers, and prisms in a cone of light"),
    "psa_extinction": Prior(0.3, (0.0003, 0.005), "as the generator's"),
    "generator_ellipticity": Prior(0.25, (0.1, 0.8), "degrees; strain between polarizer and plate"),
    "retarder_diattenuation": Prior(0.4, (0.001, 0.01), "coatings differ for the two axes"),
    "retarder_transmission": Prior(0.4, (0.001, 0.008), "wedge, dust and tilt of a turning plate"),
    "field_retardance": Prior(0.2, (0.2, 1.5), "degrees at the edge; a field of some degrees through the plate"),
    "retardance_drift": Prior(0.3, (0.2, 1.0), "degrees; 0.1 to 0.5 a kelvin of a polymer or multi-order plate"),
    "retardance_over_turn": Prior(0.2, (0.1, 1.0), "degrees; a wedged plate beside its axis"),
    "stray_light": Prior(0.3, (0.002, 0.01), "of the light; room and reflections past the analyzer"),
    "path_retardance": Prior(0.3, (0.2, 1.5), "degrees; windows and lenses under stress"),
    "rotation_eccentricity": Prior(0.5, (0.03, 0.3), "degrees; 10 to 100 micrometres on a scale of 20 mm radius"),
    "rotation_ratio": Prior(0.2, (5e-5, 5e-4), "steps a turn rounded to whole numbers, a slack belt"),
    "rotation_backlash": Prior(0.15, (0.02, 0.2), "degrees; worm stages of a lab"),
    "rotation_slip": Prior(0.07, (0.1, 1.0), "degrees; steps lost in one capture"),
    "angle_per_state": Prior(0.15, (0.01, 0.1), "degrees; open-loop and piezo stages repeat to 0.01 to 0.1"),
    "source_drift": Prior(0.6, (0.003, 0.03), "of the light in some minutes; LEDs and lamps that warm up"),
    "source_flicker": Prior(0.4, (0.001, 0.006), "of the light; supplies, and lines of a lamp"),
    "detector_nonlinearity": Prior(0.5, (0.003, 0.02), "lost at full scale; data sheets say below 1 to 2 %"),
    "detector_offset": Prior(0.25, (10, 80), "counts of 65535; a black level without darks of the day"),
    "tone_curve": Prior(0.05, (0.01, 0.03), "of gamma; a driver's curve that was not switched off"),
    "image_drift": Prior(0.4, (0.05, 0.6), "pixels; supports creep"),
    "beam_wander": Prior(0.4, (0.05, 0.5), "pixels; wedge of a turning plate"),
}
#: Of each group a bench has one at most: in the counts they are nearly the same thing.
EXCLUSIVE = ({"detector_nonlinearity", "tone_curve"},)


def draw_kinds(random: np.random.Generator) -> list[str]:
    """Kinds of fault of one bench."""
    count = int(random.integers(FAULTS[0], FAULTS[1] + 1))
    drawn: list[str] = []
    while len(drawn) < count:
        excluded = set(drawn).union(*(group for group in EXCLUSIVE if group & set(drawn)))
        open_kinds = [k for k in PRIORS if k not in excluded]
        weights = np.array([PRIORS[k].weight for k in open_kinds])
        drawn.append(str(random.choice(open_kinds, p=weights / weights.sum())))
    return drawn
