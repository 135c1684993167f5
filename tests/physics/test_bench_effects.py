"""Undeclared faults of the simulated rig against the effects that `diagnose` fits: two routes, one answer."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from processing.instrument.applied_effects import instrument_effects
from processing.instrument.changes import Changes, Conditions
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from simulators.bench.bench import FixedScene
from simulators.bench.bench import SimulatedBench as Bench
from simulators.bench.effects import AnyBenchEffect

ANGLES = {"psg": np.linspace(0, 351, 24), "psa": 4.91 * np.linspace(0, 351, 24)}
SIDE = 9

#: Settings of a bench fault, and the effect that is the same: kind, place, values.
CASES = [
    (
        {"kind": "window", "behind": "psg_polarizer", "retardance_deg": 0.4},
        "generator_ellipticity",
        "psg_polarizer",
        [0.2],
    ),
    (
        {"kind": "window", "behind": "psg_retarder", "azimuth_deg": 0, "retardance_deg": 0.7},
        "path_retardance",
        "",
        [0.7, 0],
    ),
    (
        {"kind": "plate_transmission", "axis": "psg", "amplitude": 0.02, "harmonic": 2, "phase_deg": 90},
        "retarder_transmission",
        "psg_retarder",
        [0, 0, 0, 0.02],
    ),
    (
        {"kind": "plate_retardance", "element": "psa_retarder", "amplitude_deg": 0.8, "phase_deg": 30},
        "retardance_over_turn",
        "psa_retarder",
        [0.8 * np.cos(np.pi / 6), 0.4],
    ),
    ({"kind": "angle_slip", "axis": "psa", "at_index": 7, "slip_deg": 0.3}, "rotation_slip", "psa@7", [0.3]),
    ({"kind": "angle_scale", "axis": "psg", "scale_error": 1e-3}, "rotation_ratio", "psg", [1e-3]),
    ({"kind": "element_error", "element": "psa_retarder", "offset": 0.5}, "psa_retardance", "psa_retarder", [0.5]),
    (
        {"kind": "element_error", "element": "analyzer", "parameter": "extinction", "offset": 0.01},
        "psa_extinction",
        "analyzer",
        [0.01],
    ),
    (
        {"kind": "element_error", "element": "psg_retarder", "parameter": "diattenuation", "offset": 0.01},
        "retarder_diattenuation",
        "psg_retarder",
        [0.01],
    ),
]


#: A weak polarizer and a retarder, the same everywhere.
GLASS = mueller.diattenuator(0.4, 1.0, 0.5) @ mueller.retarder(1.1, 0.8)


def bench(configs, *faults):
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    read = TypeAdapter(tuple[AnyBenchEffect, ...]).validate_python
    return Bench(
        FixedScene(GLASS), model, 662.0, rows=SIDE, columns=SIDE, flux_e_per_s=1e4, effects=read(faults)
    ), model.at(662.0)


def series(true_bench):
    shots = [
        true_bench.expected_electrons({a: float(v[k]) for a, v in ANGLES.items()}, 1.0, k)
        for k in range(len(ANGLES["psg"]))
    ]
    return np.stack(shots).astype(float)


PRESENT = [case for case in CASES if case[1] in instrument_effects()]


@pytest.mark.parametrize(("fault", "kind", "place", "values"), PRESENT, ids=[f"{c[0]['kind']}-{c[1]}" for c in PRESENT])
def test_fault_is_the_effect(configs, fault, kind, place, values):
    true_bench, model = bench(configs, fault)
    changes = Changes(Conditions.of(ANGLES))
    effect = instrument_effects()[kind]
    effect.apply(changes, model, place, np.array(values, dtype=float))
    want = 1e4 * model.rows(ANGLES, changes)[:, 0] @ GLASS.reshape(16)
    electrons = series(true_bench)[:, 0, 0]
    plain = series(bench(configs)[0])[:, 0, 0]
    assert np.abs(electrons - plain).max() > 1e-3 * plain.max()
    np.testing.assert_allclose(electrons, want, rtol=2e-5, atol=2e-5 * plain.max())


def test_field_retardance_is_another_retarder_in_every_pixel(configs):
    true_bench, _ = bench(configs, {"kind": "field_retardance", "element": "psg_retarder", "edge_deg": 3.0, "x": 0.5})
    image = series(true_bench)
    for row, column in ((0, 0), (4, 8), (8, 3)):
        x, y = -1 + column / 4, -1 + row / 4
        offset = 3.0 * ((x - 0.5) ** 2 + y**2)
        pixel_bench, _ = bench(configs, {"kind": "element_error", "element": "psg_retarder", "offset": offset})
        np.testing.assert_allclose(image[:, row, column], series(pixel_bench)[:, 0, 0], rtol=1e-4, atol=1.0)


def test_play_is_taken_up_before_the_shaft_follows(configs):
    true_bench, _ = bench(configs, {"kind": "angle_play", "axis": "psg", "play_deg": 0.5})
    (fault,) = true_bench.effects
    turned = [fault.angles({"psg": a}, None)["psg"] for a in (10.0, 20.0, 20.6, 20.2, 15.0)]
    np.testing.assert_allclose(turned, [9.5, 19.5, 20.1, 20.1, 15.5])


def test_counts_are_bent_and_lifted(configs):
    read = TypeAdapter(tuple[AnyBenchEffect, ...]).validate_python
    curve, black = read(
        ({"kind": "tone_curve", "gamma": 2.0, "full_scale_e": 100.0}, {"kind": "black_offset", "electrons": 5})
    )
    electrons = np.array([[0.0, 25.0, 100.0]], dtype=np.float32)
    np.testing.assert_allclose(curve.detector(electrons, None), [[0, 50, 100]])
    np.testing.assert_allclose(black.detector(electrons, None), [[5, 30, 105]])


def test_channel_and_element_must_exist(configs):
    for fault in ({"kind": "channel_error", "channel": "no"}, {"kind": "window", "behind": "no"}):
        true_bench, _ = bench(configs, fault)
        with pytest.raises(KeyError, match="has no"):
            series(true_bench)
