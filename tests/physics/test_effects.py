"""Every effect of the folders: what it does at zero, its derivative, and what makes a file an effect."""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import processing
from processing.effect import BASE, EffectError, load_effects
from processing.instrument.applied_effects import apply_to, changes_at, changes_of, instrument_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.effects.base import InstrumentEffect
from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel
from processing.reflectance.effects.base import ReflectanceEffect, reflectance_effects
from simulators.conformance import EffectConformance, ReflectanceEffectConformance
from simulators.conformance.effect import small_capture

INSTRUMENT_KINDS = list(instrument_effects())
REFLECTANCE_KINDS = list(reflectance_effects())


#: Instruments that have a place for every effect between them; the first that has one is taken.
INSTRUMENTS = (("rgb950", 662), ("mosaic_polarimeter", 662), ("drr_imaging_630nm", 630))


class TestEveryEffectOfTheInstrument(EffectConformance):
    @pytest.fixture(params=INSTRUMENT_KINDS)
    def kind(self, request):
        return request.param

    @pytest.fixture
    def case(self, kind, configs):
        for file, wavelength_nm in INSTRUMENTS:
            model, capture = small_capture(InstrumentModel.load(configs / f"instruments/{file}.yaml").at(wavelength_nm))
            if instrument_effects()[kind].places(model, capture.conditions):
                break
        return model, capture


class TestEveryEffectOfTheReflectance(ReflectanceEffectConformance):
    @pytest.fixture(params=REFLECTANCE_KINDS)
    def kind(self, request):
        return request.param


def test_an_effect_of_one_capture_holds_for_that_capture_only(rgb950):
    model, capture = small_capture(rgb950)
    drift = AppliedEffect(
        kind="source_drift",
        scope="capture",
        captures=("one",),
        parameters={n: EffectParameter(value=v, unit="1") for n, v in (("fraction", 0.1), ("curvature", 0.0))},
    )
    changed = model.model_copy(update={"effects": (drift,)})
    assert np.ptp(changes_of(changed, capture.conditions, "one").gain) == pytest.approx(0.1)
    assert np.ptp(changes_of(changed, capture.conditions, "another").gain) == 0
    angles = capture.conditions.angles_deg
    assert changed.rows(angles, changes_at(changed, angles)) == pytest.approx(model.rows(angles))


def test_rows_of_an_instrument_with_effects_need_their_changes(rgb950):
    model, capture = small_capture(rgb950)
    turned = AppliedEffect(
        kind="psg_azimuth", element="psg_retarder", parameters={"azimuth": EffectParameter(value=1.0, unit="degree")}
    )
    changed = model.model_copy(update={"effects": (turned,)})
    angles = capture.conditions.angles_deg
    with pytest.raises(ValueError, match="has effects"):
        changed.rows(angles)
    assert np.abs(changed.rows(angles, changes_at(changed, angles)) - model.rows(angles)).max() > 1e-3


@pytest.mark.parametrize(("kind", "element"), [("gremlin", None), ("psg_azimuth", "lens"), ("psg_azimuth", None)])
def test_unknown_effects_are_refused(kind, element, rgb950):
    model, capture = small_capture(rgb950)
    with pytest.raises(EffectError):
        apply_to(Changes(capture.conditions), model, AppliedEffect(kind=kind, element=element, parameters={}))


ROOT = Path(processing.__file__).parent
FOLDERS = ("processing.instrument.effects", "processing.reflectance.effects")
FILES = [
    (folder, info.name)
    for folder in FOLDERS
    for info in pkgutil.iter_modules(importlib.import_module(folder).__path__)
    if info.name != BASE and not info.name.startswith("_")
]

#: A new effect of an instrument, whole.
DIMMER = '''"""The source is dimmer. Cause: a filter. Mend: take it out."""
from processing.effect import Parameter
from processing.instrument.effects.base import OfOneCapture, SourceEffect

class Dimmer(SourceEffect, OfOneCapture):
    """Share of the light that is lost."""

    def places(self, model, conditions):
        return ("",)

    def parameters(self, model, conditions, place):
        return (Parameter("lost", "1", 0, 1, 0.1),)

    def apply(self, changes, model, place, values):
        changes.gain = changes.gain * (1 - values[0])
'''
#: A new effect of a reflectance, whole.
SKEW = '''"""The arm is skew. Cause: a bent arm. Mend: straighten it."""
from processing.effect import Parameter
from processing.reflectance.effects.base import ReflectanceEffect

class Skew(ReflectanceEffect):
    """Degrees."""

    def parameters(self, place):
        return (Parameter("skew", "degree", -1, 1, 0.1),)

    def bend(self, changes, place, values):
        changes.arm_rad += values[0]
'''
#: What a user's commands do with the two folders.
USE = """
import numpy as np, sys
import processing.commands.diagnose, processing.commands.loaded_late.diagnose_surface
import processing.diagnosis.surface.write
from processing.diagnosis.search.candidate import pool
from processing.instrument.changes import Conditions
from processing.instrument.model import InstrumentModel
from processing.reflectance.effects.base import reflectance_effects
model = InstrumentModel.load(sys.argv[1]).at(662)
kinds = {c.kind for c in pool(model, [Conditions.of({"psg": np.arange(8.0) ** 2, "psa": np.arange(8.0) ** 2})])}
print(processing.__path__[0])
print(*sorted(kinds))
print(*sorted(reflectance_effects()))
"""


def test_no_file_imports_an_effect():
    effects = {f"{folder}.{name}" for folder, name in FILES}
    for path in (p for top in ("processing", "simulators", "acquisition") for p in (ROOT.parent / top).rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if ".effects" in text else ():
            if isinstance(node, ast.ImportFrom):
                names = {node.module, *(f"{node.module}.{a.name}" for a in node.names)}
            elif isinstance(node, ast.Import):
                names = {a.name for a in node.names}
            else:
                continue
            assert not names & effects, f"{path} imports {names & effects}"


def test_some_of_the_states_have_matrices_of_their_own(rgb950):
    conditions = Conditions.of({"psg": 7.0 * np.arange(12), "psa": 34.0 * np.arange(12)})
    changes = Changes(conditions, built={})
    changes.retardance_rad["psa_retarder"] = np.array(0.02)
    whole, again = (rgb950.rows(conditions.angles_deg, changes) for _ in range(2))
    assert np.array_equal(whole, again)
    chosen = np.array([1, 4, 9])
    some = changes.of_states(chosen)
    assert rgb950.rows(some.conditions.angles_deg, some) == pytest.approx(whole[chosen])


def test_files_go_and_come_in_a_copy(tmp_path, configs):
    # All but one of each folder are deleted, and one that is new comes.
    for path in ROOT.rglob("*"):
        folder = ".".join(("processing", *path.relative_to(ROOT).parent.parts))
        is_hidden = (folder, path.stem) in FILES and path.stem not in ("psg_azimuth", "arm_zero")
        target = tmp_path / "processing" / path.relative_to(ROOT)
        if path.is_file() and not is_hidden and path.suffix != ".pyc":
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    (tmp_path / "processing/instrument/effects/dimmer.py").write_text(DIMMER)
    (tmp_path / "processing/reflectance/effects/skew.py").write_text(SKEW)
    run = subprocess.run(
        [sys.executable, "-c", USE, str(configs / "instruments/rgb950.yaml")],
        capture_output=True,
        text=True,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )
    assert run.stdout.splitlines() == [str(tmp_path / "processing"), "dimmer psg_azimuth", "arm_zero skew"], run.stderr


def test_a_plug_in_is_found_for_both_kinds(monkeypatch):
    class EntryPoint:
        name = "gremlin"

        def __init__(self, family: type) -> None:
            self.family = family

        def load(self) -> type:
            return self.family

    class Gremlin(ReflectanceEffect):
        def parameters(self, place):
            return ()

        def bend(self, changes, place, values):
            pass

    groups = []
    monkeypatch.setattr("processing.effect.entry_points", lambda group: groups.append(group) or [EntryPoint(Gremlin)])
    effects = load_effects(FOLDERS[1], ReflectanceEffect, "umov.reflectance_effects")
    assert (effects["gremlin"].kind, groups) == ("gremlin", ["umov.reflectance_effects"])


@pytest.mark.parametrize("text", ["", DIMMER + DIMMER.replace("Dimmer", "Second")])
def test_a_file_without_just_one_effect_is_refused(text, tmp_path, monkeypatch):
    name = f"folder_{len(text)}"
    (tmp_path / name).mkdir()
    (tmp_path / name / "__init__.py").write_text("")
    (tmp_path / name / "thing.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(EffectError, match="thing has to define one InstrumentEffect"):
        load_effects(name, InstrumentEffect, "nothing")
