"""Rotating-element polarimeters from YAML alone, on emulators: plan, capture, product."""

from itertools import product

import numpy as np
import pytest
from scipy import ndimage

from processing.commands.application import main as process
from processing.storage.products.images import MuellerImage
from tests.commands import exit_code

PLAN = """
kind: plan
title: {name}
mode: {name}
omega_deg: 35
sample: {{name: red_sphere}}
states: {states}
exposure_s: 0.02
"""
SIXTEEN = "{kind: table, angles: {psg: [0,0,0,0,60,60,60,60,120,120,120,120,20,20,20,20], "
TELESCOPE = "{{kind: table, angles: {{hwp: {}, image_rotator: {}}}}}".format(
    *(list(angles) for angles in zip(*product((0.0, 22.5, 45.0, 67.5), (0.0, 20.0, 50.0)), strict=True))
)
#: States that determine all that the instrument can, and how many numbers that is.
INSTRUMENTS = {
    "rotating_retarder_stokes": ("{kind: table, angles: {psa: [0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5]}}", 4),
    "linear_mueller": (SIXTEEN + "psa: [0,60,120,100,0,60,120,100,0,60,120,100,0,60,120,100]}}", 9),
    "drr_wollaston": (f"{{kind: table, angles: {{psg: {[6.0 * k for k in range(18)]}}}}}", 16),
    "dual_beam_charis": (TELESCOPE, 9),
    "mosaic_polarimeter": ("{kind: table, angles: {psg: [0, 24, 48, 72, 96, 120]}}", 12),
}
#: What the rig's rotators are called; the axes are the user's.
ROTATORS = {"dual_beam_charis": ("hwp", "image_rotator")}


def rig_of(name, small_rig, configs):
    """A rig file with this instrument, a mode of its name, and its own names of the rotators."""
    first, second = ROTATORS.get(name, ("psg", "psa"))
    zaber = {"kind": "zaber", "port": "sim:rotators"}
    rotators = {first: zaber | {"address": 1}, second: zaber | {"address": 2}}
    arm = {"kind": "smc100", "port": "sim:arm", "address": 1, "limits_deg": [0, 180]}
    return small_rig(
        top={
            "modes": {name: {"instrument": str(configs / f"instruments/{name}.yaml")}},
            "axes": rotators | {"arm": arm},
            "home_order": ["arm", first, second],
            "endless": [first, second],
        },
        axes={
            first: {"port": "rotators", "index": 0},
            second: {"port": "rotators", "index": 1},
            "arm": {"port": "arm", "index": 0},
        },
    )


#: Of the others `test_partial_polarimeters.py` and `test_reduce.py` reduce captures.
SHORT = {"dual_beam_charis", "mosaic_polarimeter"}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.long] * (name not in SHORT)) for name in INSTRUMENTS]
)
def test_from_plan_to_product(name, acquire, small_rig, configs, tmp_path):
    states, rank = INSTRUMENTS[name]
    rig = rig_of(name, small_rig, configs)
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN.format(name=name, states=states))
    acquire.made("--plan", plan, "--rig", rig, "--out", tmp_path / "out")
    (capture,) = (tmp_path / "out").glob("*.h5")
    assert exit_code(process, "reduce", capture, "--out", tmp_path / "m.h5", "--no-figure") == 0
    image = MuellerImage.load(tmp_path / "m.h5")
    assert image.facts["rank"] == rank
    is_determined = np.isfinite(image.values).any(axis=(2, 3)).reshape(16)
    assert is_determined.sum() == rank
    lit = image.values[0, 0] > 30 * image.errors[0, 0]
    # At the outline the four polarizers of a super-pixel look at different things.
    lit = ndimage.binary_erosion(lit)
    assert lit.mean() > 0.1
    # Nothing passive sends on more polarized light than light: no element exceeds m00 by more than five errors.
    values, errors = (plane.reshape(16, *lit.shape)[is_determined][:, lit] for plane in (image.values, image.errors))
    assert (np.abs(values) <= values[0] + 5 * errors).mean() > 0.999
    # And some light is polarized: an analysis that saw nothing would report zeros.
    assert np.abs(values[1:] / values[0]).max(axis=0).mean() > 0.01
