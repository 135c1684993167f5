"""Every committed rig, plan and campaign loads, keeps its meaning through YAML, and passes its checks."""

import itertools
import json
from pathlib import Path

import pytest

from acquisition.campaign import run as campaign_run
from acquisition.campaign.plan import Campaign, captures
from acquisition.capture.job import prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.commands import schemas
from acquisition.rig.config import RigConfig, load_rig
from processing.yaml_file import dump_yaml, parse_yaml

CONFIGS = Path(__file__).resolve().parents[2] / "configs"


def _files(folder):
    return sorted((CONFIGS / folder).glob("*.yaml"))


@pytest.mark.parametrize("name", list(schemas.MODELS))
def test_committed_schema_is_fresh(name):
    assert schemas.path_of(name).read_text() == schemas.text_of(name), "run: python -m acquisition.commands.schemas"


@pytest.mark.parametrize("name", list(schemas.MODELS))
def test_every_key_of_a_schema_is_described(name):
    schema = json.loads(schemas.text_of(name))
    for section in (schema, *schema.get("$defs", {}).values()):
        for key, entry in section.get("properties", {}).items():
            assert entry["description"], f"{section['title']}.{key}: say what it is, with its unit, at its field"


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*/*.yaml")), ids=lambda p: p.stem)
def test_every_file_names_its_schema(path):
    first = path.read_text().splitlines()[0]
    assert first.startswith("# yaml-language-server: $schema=")
    assert (path.parent / first.split("=")[1]).exists()


@pytest.mark.parametrize("path", _files("rigs"), ids=lambda p: p.stem)
def test_rig_loads_and_round_trips(path):
    rig = load_rig(path)
    text = dump_yaml(rig)
    assert parse_yaml(text, RigConfig) == rig
    # A correction may hold thousands of numbers: not a line for each.
    assert "wavelengths_nm: [451.0, 524.0, 662.0, 947.0]" in text
    for mode in rig.modes.values():
        assert mode.instrument.exists()


@pytest.mark.parametrize("path", _files("plans"), ids=lambda p: p.stem)
def test_plan_loads_round_trips_and_fits_the_simulated_rig(path):
    plan = MeasurementPlan.load(path)
    assert parse_yaml(dump_yaml(plan), MeasurementPlan) == plan
    assert all(check.passed for check in prepare(plan, load_rig(CONFIGS / "rigs" / "simulated.yaml")).checks)


@pytest.mark.parametrize("path", _files("campaigns"), ids=lambda p: p.stem)
def test_campaign_loads_round_trips_and_fits_the_simulated_rig(path):
    campaign = Campaign.load(path)
    assert parse_yaml(dump_yaml(campaign), Campaign) == campaign
    jobs = campaign_run.prepare(campaign, load_rig(CONFIGS / "rigs" / "simulated.yaml"))
    assert len({capture.name for capture, _ in jobs}) == len(jobs)


def test_red_sphere_campaign_is_what_the_issue_asks_for():
    campaign = Campaign.load(CONFIGS / "campaigns" / "red_sphere.yaml")
    planned = [capture for capture in captures(campaign) if not capture.reference]
    assert len(planned) == 2 * 2 * 15
    assert [capture.plan.omega_deg for capture in planned[:15]] == [20 + 5 * k for k in range(15)]
    references = [capture for capture in captures(campaign) if capture.reference]
    flats = [capture for capture in references if capture.plan.role == "flat"]
    assert {capture.plan.mode for capture in flats} == {"drr", "stokes"}
    airs = [capture for capture in references if capture not in flats]
    assert all(capture.plan.sample.kind == "air" and capture.plan.omega_deg == 180 for capture in airs)
    # Before the first and after the eighth of fifteen, for each wavelength.
    assert (len(airs), len(flats)) == (4, 8)
    # What needs a person changes once.
    wavelengths = [capture.plan.wavelength_nm for capture in planned]
    assert sum(a != b for a, b in itertools.pairwise(wavelengths)) == 1
