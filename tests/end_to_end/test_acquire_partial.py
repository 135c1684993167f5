"""A rotating-retarder Stokes polarimeter from YAML alone: plan, emulators, capture, product."""

import numpy as np
import pytest

from processing.commands.application import main as process
from processing.storage.images import MuellerImage

PLAN = """
kind: plan
title: Stokes polarimeter
mode: drr
omega_deg: 35
sample: {name: red_sphere}
states: {kind: table, angles: {psa: [0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5]}}
exposure_s: 0.02
"""


def test_from_plan_to_product(acquire, small_rig, configs, tmp_path):
    mode = {"instrument": str(configs / "instruments/rotating_retarder_stokes.yaml")}
    # The fixture makes the other modes' paths absolute; this one is.
    rig = small_rig(top={"modes": {"drr": mode}})
    plan = tmp_path / "plan.yaml"
    plan.write_text(PLAN)
    code, _, err = acquire("--plan", plan, "--rig", rig, "--out", tmp_path / "out")
    assert code == 0, err
    (capture,) = (tmp_path / "out").glob("*.h5")
    with pytest.raises(SystemExit) as end:
        process(["reduce", str(capture), "--out", str(tmp_path / "m.h5"), "--no-figure"])
    assert not end.value.code
    image = MuellerImage.load(tmp_path / "m.h5")
    assert image.facts["rank"] == 4
    stokes = image.values[:, 0]
    lit = stokes[0] > 30 * image.errors[0, 0]
    assert lit.mean() > 0.1
    # Unpolarized light on a red sphere leaves it partly polarized, and never more than fully.
    degree = np.sqrt((stokes[1:, lit] ** 2).sum(axis=0)) / stokes[0, lit]
    assert 0.005 < np.median(degree) < 0.5
    assert np.isnan(image.values[:, 1:]).all()
