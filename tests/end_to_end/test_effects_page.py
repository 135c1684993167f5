"""The catalogue of effects, its pictures and the faulty rig are what benchmarks/effects_page.py makes of the code."""

from io import BytesIO

import cv2
import effects_page
import numpy as np
import pytest

from acquisition.rig.config import load_rig
from simulators.bench.typical_faults import FAULTS


def test_the_page_is_that_of_the_effects():
    assert effects_page.PAGE.read_text(encoding="utf-8") == effects_page.page()


#: Every fifth picture, the others at night: the page and the faults are compared for all.
PICTURED = [
    pytest.param(kind, marks=[pytest.mark.long] * (n % 5 > 0)) for n, kind in enumerate(effects_page.pictured_kinds())
]


@pytest.mark.parametrize("kind", PICTURED)
def test_a_picture_shows_the_residual_of_its_fault(kind):
    shown = cv2.imread(str(effects_page.PICTURES / f"{kind}.png")).astype(int)
    out = BytesIO()
    effects_page.picture(FAULTS[kind]).savefig(out, format="png", dpi=100)
    picture = cv2.imdecode(np.frombuffer(out.getvalue(), np.uint8), cv2.IMREAD_COLOR).astype(int)
    assert picture.shape == shown.shape
    # Fonts differ a little from one version of the drawing library to the next, curves and maps do not.
    assert np.abs(picture - shown).mean() < 3


def test_no_picture_is_of_an_effect_that_went():
    assert {path.stem for path in effects_page.PICTURES.glob("*.png")} == set(effects_page.pictured_kinds())


def test_the_faulty_rig_is_the_simulated_one_with_faults(configs):
    text = effects_page.RIG.read_text(encoding="utf-8")
    assert text == effects_page.faulty_rig()
    faulty, plain = load_rig(effects_page.RIG), load_rig(configs / "rigs/simulated.yaml")
    effects = faulty.simulator.effects
    assert effects == tuple(FAULTS[kind].example() for kind in effects_page.SWITCHED_ON)
    simulator = faulty.simulator.model_copy(update={"effects": (), "rows": 600, "columns": 600})
    assert faulty.model_copy(update={"simulator": simulator, "name": plain.name}) == plain


def test_every_commented_fault_can_be_switched_on(tmp_path, configs):
    text = effects_page.RIG.read_text(encoding="utf-8").replace("../", f"{configs}/")
    path = tmp_path / "all.yaml"
    path.write_text(text.replace("\n#    - {", "\n    - {"))
    kinds = [kind for kind in FAULTS if FAULTS[kind].mode == "drr"]
    assert len(load_rig(path).simulator.effects) == len(kinds) > 20
