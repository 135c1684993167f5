"""Finds the exposure of a capture: the states that can be brightest are probed before the first is taken."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from acquisition.capture.plan import AutoExposure
from acquisition.rig.rig import Rig
from acquisition.rig.way import Pose
from acquisition.screen.observer import Observer
from processing.instrument.applied_effects import changes_at
from processing.instrument.model import InstrumentModel
from processing.instrument.states import StateTable
from processing.polarization import mueller

#: Probes are not tries of a state: observers count them apart.
PROBE = 1000
#: States probed for each kind of sample that nothing is known about.
PROBES_EACH = 2
TRIES = 12


def brightest_states(table: StateTable, instrument: InstrumentModel, sample: str) -> list[int]:
    """States to probe, the one that is brightest for the sample first.

    An unknown sample may depolarize, reflect like a mirror or pass the light on: the brightest states of each of
    the three are probed.
    """
    light = [k for k, role in enumerate(table.role) if role != "dark"]
    if not instrument.axes:
        return light[:1]
    angles = {axis: table.angles_deg[axis][light] for axis in instrument.axes}
    w = instrument.rows(angles, changes_at(instrument, angles)).max(axis=1)
    ideal = {"air": [np.eye(4)], "mirror": [mueller.IDEAL_MIRROR]}
    samples = ideal.get(sample, [mueller.IDEAL_DEPOLARIZER, np.eye(4), mueller.IDEAL_MIRROR])
    probes: list[int] = []
    for matrix in samples:
        for k in np.argsort(-(w @ np.asarray(matrix).ravel()))[:PROBES_EACH]:
            if light[int(k)] not in probes:
                probes.append(light[int(k)])
    return probes


def find_exposure(
    rig: Rig,
    table: StateTable,
    poses_deg: Sequence[Pose],
    instrument: InstrumentModel,
    *,
    sample: str,
    auto: AutoExposure,
    observers: Sequence[Observer],
    warn: Callable[[str], None],
) -> float:
    """Exposure in seconds at which the percentile of the brightest probed state comes to its target.

    The axes are moved through `poses_deg` of the probed states with the light on. The result has three digits, so
    that it does not depend on the last photon.
    """
    camera = rig.require_camera()
    black = rig.config.detector.black_level_counts
    # The table holds the start times the factors of the bracket: all of them must fit the rig.
    least, most = float(table.exposure_s.min()) / auto.start_s, float(table.exposure_s.max()) / auto.start_s
    low_s, high_s = rig.config.exposure_s[0] / least, min(rig.config.exposure_s[1] / most, auto.longest_s)
    span = camera.full_scale - black
    exposure_s = min(max(auto.start_s, low_s), high_s)
    brightest = 0.0
    if rig.source is not None:
        rig.source.set_light(True)
    for number, state in enumerate(brightest_states(table, instrument, sample)):
        rig.go(poses_deg[state], poses_deg)
        for _ in range(TRIES):
            rig.set_exposure(exposure_s, 1)
            for observer in observers:
                observer.exposing(state, PROBE + number)
            frame = camera.capture(1)[0]
            level = (float(np.percentile(frame.pixels, auto.percentile)) - black) / span
            if level > 0.95 and exposure_s > low_s:
                exposure_s = max(exposure_s / 4, low_s)
            elif level < auto.target / 4 and exposure_s < high_s:
                exposure_s = min(exposure_s * min(auto.target / max(level, 0.02), 20.0), high_s)
            else:
                break
        brightest = max(brightest, level / exposure_s)
        exposure_s = min(max(auto.target / max(brightest, 1e-9), low_s), high_s)
    if auto.target / max(brightest, 1e-9) > high_s:
        reached = 100 * brightest * exposure_s
        warn(f"auto exposure: {exposure_s:g} s is the longest allowed and reaches {reached:.1f} % of full scale")
    digits = 2 - math.floor(math.log10(exposure_s))
    return round(exposure_s, digits)
