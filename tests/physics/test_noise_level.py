"""Noise as large as the pixels show it: a gain stated a little wrong, an offset that looks like read-out noise."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from bench_capture import read

from processing.diagnosis.captured.screening import screened
from processing.diagnosis.instrument import whole_bench
from processing.diagnosis.instrument.diagnose import diagnose
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.instrument.effects.field_retardance import FieldRetardance
from processing.storage.captures.schema import Sample
from simulators.blind.real_bench import Disc
from simulators.blind.undeclared_captures import Bench, Scene, digitize, expose, state_angles, write_capture

SIDE, STATES = 64, 40


def captured(folder, configs, bench, scene=None):
    """A capture as `diagnose` reads it: of air, or of an unknown sample."""
    random, file = np.random.default_rng(11), configs / "instruments/rgb950.yaml"
    angles = state_angles(STATES, bench.mosaic, bench.zigzag)
    seen = Scene(random, np.eye(4)) if scene is None else scene(random, None)
    sample = Sample(kind="air" if scene is None else "unknown")
    path = folder / f"{sample.kind}.h5"
    write_capture(path, bench, digitize(bench, expose(bench, seen, angles), random), angles, sample, file.read_text())
    return read(path, file)


def said(model, *captures):
    """What `diagnose` says of captures, by kind whether a name is sure."""
    found = diagnose(InstrumentProblem(model, list(captures)), lambda line: None).diagnosis
    return found, {e.kind: e.answer for e in found.effects if e.confident}


@pytest.mark.parametrize("times", [0.965, 1.04])
def test_a_gain_that_is_stated_some_percent_wrong_hides_no_cause(configs, tmp_path, times):
    """Four percent of the variance of 160 000 intensities is eleven standard deviations of their sum of squares."""
    bench = Bench(rows=SIDE, columns=SIDE)
    bench.dg += np.deg2rad(0.4)
    bench.ellipticity = np.deg2rad(0.5)
    bench.level.append(lambda k, a: 1 + 0.01 * k / (STATES - 1))
    model, data = captured(tmp_path, configs, bench)
    found, sure = said(model, replace(data, slope=times * data.slope, floor=times * data.floor))
    assert found.verdict == "explained"
    assert {"psg_retardance", "source_drift"} <= set(sure)
    assert found.error_after.chi2_reduced == pytest.approx(1.0, abs=0.01)


def test_an_offset_is_no_other_read_noise(configs, tmp_path):
    """A ball before a dark wall: what is added to all counts takes photon noise along in what is expected of them."""
    bench = Bench(rows=SIDE, columns=SIDE, read_noise=3.0)
    bench.da += np.deg2rad(0.5)
    bench.stored.append(lambda counts: counts + 60)
    model, ball = captured(tmp_path, configs, bench, Disc)
    _, air = captured(tmp_path, configs, bench)
    told = []
    ball, air = (screened(d, model, told.append) for d in (ball, air))
    assert any("variance of a pixel" in line for line in told)
    found, sure = said(model, ball, air)
    assert found.noise.verdict == "as_declared"
    assert {"psa_retardance", "detector_offset"} <= set(sure)


def test_what_varies_over_the_image_may_be_absent_where_the_noise_is_asked_beside_it(monkeypatch):
    """Asked again without a bend, a field is as free not to be there as it was."""
    field = SimpleNamespace(effect=object.__new__(FieldRetardance))
    bench, asked = object.__new__(WholeBench), []
    bench.pool, bench.base = [field], SimpleNamespace(candidates=())
    bench.whole = SimpleNamespace(noise_known=False, holds_out_states=False)
    for name, answer in {"_offered": False, "_clipped": [], "_posterior": "plain", "_with_fields": "beside"}.items():
        monkeypatch.setattr(bench, name, lambda *of, answer=answer: answer)
    monkeypatch.setattr(bench, "_take_noise_of_light", lambda *of: None)
    monkeypatch.setattr(bench, "as_many_as_intensities", lambda *of: set())
    monkeypatch.setattr(bench, "_with_what_scatters_so", lambda found, fixed: asked.append((found, fixed)) or found)
    monkeypatch.setattr(whole_bench, "applied", lambda *of: ())
    assert bench.run() == "beside"
    assert asked == [("plain", []), ("beside", [])]


def test_a_bend_that_does_not_scatter_so_hides_no_noise_of_the_others(monkeypatch):
    """The light of a tone curve and an offset was refused together, and the noise stayed that without any (6 % off)."""
    tone, offset = "tone_curve", "detector_offset"
    bench, adopted = object.__new__(WholeBench), []
    bench.whole = SimpleNamespace(
        noise_known=True, level_noise=lambda space, values: True, has_noise_of=lambda space, seen: seen in adopted
    )
    monkeypatch.setattr(whole_bench, "Space", lambda candidates: SimpleNamespace(candidates=candidates))
    monkeypatch.setattr(whole_bench, "first_look", lambda whole, space, fixed, start: (space.candidates, 1.0))
    monkeypatch.setattr(bench, "_values_at_start", lambda space: space.candidates)
    monkeypatch.setattr(
        bench, "_refuted_by_scatter", lambda space, seen: {tone: -200.0, offset: -30.0} if tone in seen else {}
    )

    def adopt(space, seen):
        if tone not in seen:
            adopted.append(seen)
        return tone not in seen

    monkeypatch.setattr(bench, "_adopt_noise", adopt)
    bench._take_noise_of_light([tone, offset], [])
    assert adopted == [(offset,)]


def test_beside_a_map_over_the_image_all_take_part_with_the_noise_of_their_light(monkeypatch):
    """What was unlikely, or spoken against, where the map was missing: 300 values were kept, and a bend was dropped."""
    bench, looked = object.__new__(WholeBench), []
    field, found = Mock(label="field"), None
    space = SimpleNamespace(candidates=(), size=0, slices=())
    bench.base, bench.say = None, lambda line: None
    bench.whole = SimpleNamespace(sums=lambda space, values: None)
    both = SimpleNamespace(candidates=(field,), size=5, pairs=[(field, slice(0, 5))])
    monkeypatch.setattr(whole_bench, "applied", lambda found, base: (space, np.zeros(0)))
    monkeypatch.setattr(whole_bench, "Space", lambda candidates: both)
    monkeypatch.setattr(whole_bench, "score", lambda *of: (1000.0,))
    monkeypatch.setattr(whole_bench, "prior", lambda space: None)
    monkeypatch.setattr(bench, "_least_unit", lambda found: 1.0)
    monkeypatch.setattr(bench, "_take_noise_of_light", lambda candidates, fixed: looked.append(candidates))
    monkeypatch.setattr(bench, "_posterior", lambda candidates, fixed: candidates)
    kept = bench._with_fields(found, ["clipped"], ["bend", "unlikely"], [field])
    assert kept == ["clipped", "bend", "unlikely", field]
    assert looked == [kept]
