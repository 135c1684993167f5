"""What stays uncertain as directions: room for what another capture will have too; and what may hide a field."""

from types import SimpleNamespace as Some

import numpy as np
import pytest

from processing.diagnosis.instrument.mueller_error import MOST_STORED, MuellerErrors, _leading
from processing.diagnosis.instrument.whole_bench import WholeBench
from processing.diagnosis.search.candidate import Candidate
from processing.diagnosis.search.likely_set import likely_set
from processing.diagnosis.search.sets import Group, Noise, Quadratic, Sets
from processing.diagnosis.search.space import Space
from processing.effect import Parameter


def test_directions_hold_what_another_capture_will_have_too():
    """Values of a source in every state are large here and nothing there; a retardance is small, and here to stay."""
    size = 41
    covariance, lasts = np.diag([*np.full(40, 1.0), 0.01]), np.arange(size) == 40
    covariance[40, 0] = covariance[0, 40] = 0.05
    stored = _leading(covariance, np.eye(size), lasts)[1][:, :MOST_STORED]
    product = stored @ stored.T
    assert product[40, 40] == pytest.approx(0.01, rel=0.05)
    # What they share with it belongs to it.
    assert product[40, 0] == pytest.approx(0.05, rel=0.1)


def test_without_anything_that_lasts_the_largest_come_first():
    size, _ = _leading(np.diag([1.0, 4.0]), np.eye(2), np.zeros(2, dtype=bool))
    assert size[0] == pytest.approx(4 * size[1])


def test_what_varies_over_the_image_is_asked_for_beside_all_groups():
    """A flicker and a field hide one another: the unit without the flicker says that the field is nothing."""
    random = np.random.default_rng(31)
    design = 100 * np.hstack([np.eye(60), random.standard_normal((60, 3))])
    data = design[:, :60] @ random.standard_normal(60)
    form = Quadratic(float(data @ data - 60), -design.T @ data, design.T @ design)
    sets = Sets(form, [Group(np.arange(60)), *(Group(np.array([k])) for k in (60, 61, 62))], Noise(True, 20.0, 22.0))
    state = likely_set(sets)
    posterior = Some(samples=Some(best=state), sets=sets)
    assert state.unit > 1000
    assert WholeBench._least_unit(Some(whole=Some(noise_known=True)), posterior) < 10
    assert WholeBench._least_unit(Some(whole=Some(noise_known=False)), posterior) == state.unit


def test_what_is_found_and_not_used_is_uncertain_as_a_whole():
    """A path that was found and is not applied: the correction of the drift changes M by less than the path does."""
    drift, path = (
        Candidate(type("E", (), {"kind": k})(), "", (Parameter("p", "1", -9.0, 9.0, 1.0),)) for k in ("drift", "path")
    )
    space = Space((drift, path))
    direction = (np.array([0, 1]), np.eye(2))
    errors = MuellerErrors(space, np.array([1.0, 4.0]), np.diag([0.01, 0.09]), np.zeros((16, 2, 2)), (direction,))
    used = Some(space=Space((drift,)), fit=Some(values=np.array([1.0])))
    assert errors.corrected_values(used).tolist() == [1.0, 0.0]
    change = errors._change(*direction[:1], errors.corrected_values(used), direction[1])
    assert change.before == pytest.approx(np.sqrt(17.1))
    assert change.after == pytest.approx(np.sqrt(16.1))
