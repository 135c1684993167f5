"""Rotating-element polarimeters from YAML alone, on emulators: plan, capture, product."""

import numpy as np
import pytest

from processing.commands.application import main as process
from processing.storage.images import MuellerImage

PLAN = """
kind: plan
title: {name}
omega_deg: 35
sample: {{name: red_sphere}}
states: {states}
exposure_s: 0.02
"""
SIXTEEN = "{kind: table, angles: {psg: [0,0,0,0,60,60,60,60,120,120,120,120,20,20,20,20], "
#: States that determine all that the instrument can, and how many numbers that is.
INSTRUMENTS = {
    "rotating_retarder_stokes": ("{kind: table, angles: {psa: [0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5]}}", 4),
    "rotating_analyzer": ("{kind: table, angles: {psa: [0, 30, 60, 90, 120, 150]}}", 3),
    "linear_mueller": (SIXTEEN + "psa: [0,60,120,100,0,60,120,100,0,60,120,100,0,60,120,100]}}", 9),
    "drr_5to1": ("{kind: rotating_retarders, states: 30, step_deg: 6, ratio: 5}", 16),
}


@pytest.mark.parametrize("name", INSTRUMENTS)
def test_from_plan_to_product(name, acquire, small_rig, configs, tmp_path):
    states, wanted = INSTRUMENTS[name]
    rig = small_rig(top={"modes": {"drr": {"instrument": str(configs / f"instruments/{name}.yaml")}}})
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN.format(name=name, states=states))
    code, _, err = acquire("--plan", plan, "--rig", rig, "--out", tmp_path / "out")
    assert code == 0, err
    (capture,) = (tmp_path / "out").glob("*.h5")
    with pytest.raises(SystemExit) as end:
        process(["reduce", str(capture), "--out", str(tmp_path / "m.h5"), "--no-figure"])
    assert not end.value.code
    image = MuellerImage.load(tmp_path / "m.h5")
    assert image.facts["rank"] == wanted
    seen = np.isfinite(image.values).any(axis=(2, 3)).reshape(16)
    assert seen.sum() == wanted
    lit = image.values[0, 0] > 30 * image.errors[0, 0]
    assert lit.mean() > 0.1
    # Nothing passive sends on more polarized light than light: no element exceeds m00 by more than five errors.
    values, errors = (plane.reshape(16, *lit.shape)[seen][:, lit] for plane in (image.values, image.errors))
    assert (np.abs(values) <= values[0] + 5 * errors).mean() > 0.999
    # And some light is polarized: an analysis that saw nothing would report zeros.
    assert np.abs(values[1:] / values[0]).max(axis=0).mean() > 0.01
