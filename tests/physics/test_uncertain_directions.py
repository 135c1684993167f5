"""Directions of what is uncertain in an instrument file: by label, as short as they can be, and equal when read."""

import math
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from processing.instrument.model import AppliedEffect, EffectParameter, InstrumentModel, SystematicError
from processing.yaml_file import ConfigError, dump_yaml, parse_yaml

ROOT = Path(__file__).resolve().parents[2]
STATES = 40


def effect(kind, element=None, capture=None, wavelength_nm=None, **values):
    parameters = {name: EffectParameter(value=value, unit="") for name, value in values.items()}
    place = {"captures": (capture,), "scope": "capture"} if capture else {}
    return AppliedEffect(kind=kind, element=element, parameters=parameters, wavelength_nm=wavelength_nm, **place)


@pytest.fixture
def model(configs):
    return InstrumentModel.load(configs / "instruments/rgb950.yaml")


def uncertain(model, *directions):
    error = SystematicError(directions=directions, rms_over_m00=0.001, wavelength_nm=662.0)
    return model.model_copy(update={"systematic": (error,)})


def test_what_is_written_is_read_as_it_was(model):
    flicker = tuple(math.sin(k) / 1000 for k in range(STATES))
    direction = (
        effect("detector_offset", offset=-0.5),
        effect("path_retardance", at_0=0.1, at_45=-0.2),
        effect("psg_retardance", "psg_retarder", wavelength_nm=451.5, retardance=1e-7),
        effect("rotation_slip", "psa@14", "flat in air", slip=0.3),
        effect("source_flicker", None, "20261124-082522_air_drr_662nm_omega180", states=flicker),
    )
    written = uncertain(model, direction, (effect("stray_light", fraction=0.01),))
    text = dump_yaml(written)
    assert parse_yaml(text, InstrumentModel) == written
    assert "source_flicker in 20261124-082522_air_drr_662nm_omega180:" in text
    assert "psg_retardance[psg_retarder] at 451.5 nm:" in text
    assert written.at(451).systematic == ()
    assert [e.kind for e in written.at(662).systematic[0].directions[0]][2:] == ["rotation_slip", "source_flicker"]


LETTERS = st.characters(categories=["L", "N", "P", "S", "Zs"], exclude_characters="/\0")
SAMPLES = st.lists(st.text(LETTERS, min_size=1, max_size=50), min_size=1, max_size=4).map(" ".join)


@example("red_sphere, drr, 662 nm, Omega 35 deg (20261124-082522_red_sphere_drr_662nm_omega35)", 35, [0.1])
@example("white paper, second sheet, the side that lay up while it was dried, after the lamp was changed", 35, [0.1])
@given(SAMPLES, st.integers(20, 90), st.lists(st.floats(-1, 1), min_size=1, max_size=44))
@settings(max_examples=60, deadline=None)
def test_any_file_name_of_a_capture_is_read_as_it_was(sample, omega, values):
    """`acquire` names a file by time, sample, mode, wavelength and angle; a user may call it anything."""
    name = f"20261124-082522_{sample}_drr_662nm_omega{omega}"
    base = InstrumentModel.load(ROOT / "configs/instruments/rgb950.yaml")
    flicker = effect("source_flicker", None, name, states=tuple(values))
    document = uncertain(base, (flicker, effect("rotation_slip", "psa@14", sample, slip=0.3)))
    document = document.model_copy(update={"effects": (flicker,)})
    assert parse_yaml(dump_yaml(document), InstrumentModel) == document


def test_a_capture_that_an_earlier_version_named_is_found(model):
    old = effect("source_drift", None, "red_sphere, drr, 662 nm, Omega 35 deg (20261124_omega35.h5)", fraction=0.02)
    assert old.captures == ("20261124_omega35",)


def test_a_file_of_an_earlier_version_is_read(model):
    plain = dump_yaml(model)
    old = "systematic:\n  - rms_over_m00: 0.1\n    directions:\n      - - kind: stray_light\n          parameters:\n"
    old += "            fraction: {value: 0.01, unit: '1'}\n"
    (error,) = parse_yaml(plain.replace("systematic: []\n", "") + old, InstrumentModel).systematic
    assert error.directions[0][0].parameters["fraction"].value == 0.01


def test_those_of_three_captures_leave_room_for_another_wavelength(model):
    """20 directions of three captures with two values for each state each, as real benches have them."""
    captures = ["sphere", "flat", "air"]
    kinds = [("source_flicker", None), ("angle_per_state", "psa")]
    each = tuple(effect(*kind, name, states=(0.1,) * STATES) for kind in kinds for name in captures)
    few = tuple(effect("rotation_eccentricity", "psa", cos_1=0.1, sin_1=0.2, cos_2=0.3, sin_2=0.4) for _ in range(1))
    error = uncertain(model, *[(*each, *few)] * 20).systematic[0]
    document = model.model_copy(update={"systematic": (error, error.model_copy(update={"wavelength_nm": 451.0}))})
    assert parse_yaml(dump_yaml(document), InstrumentModel) == document


@pytest.mark.parametrize(
    ("label", "values", "message"),
    [
        ("[psa]", "{fraction: 0.1}", "is not KIND[ELEMENT]"),
        ("source_flicker", "{states: 0.1 fast}", "fast"),
        ("source_flicker", "{states: 0.1 nan}", "finite"),
    ],
)
def test_a_slip_in_a_direction_is_told(model, label, values, message):
    head = dump_yaml(model).replace("systematic: []\n", "")
    text = f"{head}systematic:\n  - rms_over_m00: 0.1\n    directions:\n      - '{label}': {values}\n"
    with pytest.raises(ConfigError) as refused:
        parse_yaml(text, InstrumentModel)
    assert message in str(refused.value)
