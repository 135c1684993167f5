"""A campaign under random faults, unattended: complete at the end, every state intact, no wrong angle.

`UMOV_FAULTS=500` runs the promise in full: 500 faults over 2 wavelengths x 2 modes x 15 angles and the references.
"""

import json
import os
import random
import threading
from collections import Counter

import pytest

from acquisition.campaign import run as campaign_run
from acquisition.campaign.log import CampaignFolder
from acquisition.campaign.plan import Campaign
from acquisition.campaign.run import CampaignRun
from acquisition.capture.operator import Operator
from acquisition.rig.config import load_rig
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from processing.instrument.model import InstrumentModel
from simulators.serial.reply_faults import Fault
from tests.rig_files import with_values

FAULTS = int(os.environ.get("UMOV_FAULTS", "8"))
FULL = FAULTS >= 100

SERIAL = ("silent", "stuck", "slow", "garbled", "late", "foreign", "not_homed")


class Weather(Observer):
    """Draws faults at random exposures: device, kind and duration."""

    def __init__(self, faults, exposures, seed):
        self._random = random.Random(seed)
        self._due = sorted(self._random.randrange(exposures) for _ in range(faults))
        self._exposures = 0
        self.injected = Counter()
        self.run = None

    def exposing(self, state, retake):
        self._exposures += 1
        rig = self.run.rig
        rig.simulation.camera.lost_ratio = 0.0
        while self._due and self._due[0] <= self._exposures:
            self._due.pop(0)
            self._strike(rig.simulation)

    def _strike(self, simulation):
        device = self._random.choice(("rotators", "rotators", "arm", "shutter", "camera", "camera", "door"))
        if device == "camera":
            kind = self._random.choice(("packets", "vanish"))
            if kind == "packets":
                simulation.camera.lost_ratio = self._random.choice((0.2, 1.0))
            else:
                simulation.camera.vanish()
        elif device == "door":
            kind = "open"
            simulation.emulators["shutter"].trip(True)
            threading.Timer(self._random.uniform(0.05, 0.5), simulation.emulators["shutter"].trip, (False,)).start()
        else:
            kind = self._random.choice(SERIAL)
            commands = None if kind in ("stuck", "slow") else self._random.choice((1, 1, 2, 5, None))
            fault = Fault(kind, from_command=self._random.randint(1, 12), commands=commands, amount=None)
            simulation.emulators[device].faults.add(fault)
        self.injected[f"{device} {kind}"] += 1


def _campaign(tmp_path, configs, full=FULL):
    plans = {}
    for mode in ("drr", "stokes"):
        text = (configs / "plans" / f"{mode}.yaml").read_text().replace("exposure_s: 0.02", "exposure_s: 0.002")
        if not full:
            text = text.replace("states: 40, step_deg: 9", "states: 18, step_deg: 20").replace("darks: 4", "darks: 1")
        plans[mode] = tmp_path / f"{mode}.yaml"
        plans[mode].write_text(text)
    file = tmp_path / "campaign.yaml"
    omega = "{start: 20, stop: 90, step: 5}" if full else "[40, 60]"
    file.write_text(
        f"kind: campaign\nname: night\nplans: {{drr: {plans['drr']}, stokes: {plans['stokes']}}}\n"
        f"samples: [{{name: red_sphere}}]\nwavelengths_nm: {'[451, 662]' if full else '[662]'}\nomega_deg: {omega}\n"
        "references: [{sample: {kind: air, name: air}, omega_deg: 180, modes: [drr], every: 8}]\n"
        "retries: 50\nretry_wait_s: 0.05\ncontinue_after_interlock: true\n"
    )
    return Campaign.load(file)


def _night(tmp_path, campaign, config, jobs, observer):
    """Run the jobs unattended, `observer` at work; it knows the run as `run`. Returns the folder."""
    stop = StopRequest()
    folder = CampaignFolder(tmp_path / "night", campaign)
    operator = Operator(lambda text: None, stop, True, True)
    observer.run = CampaignRun(campaign, config, folder, operator, stop=stop, observers=[observer], home=True)
    try:
        assert observer.run.run(jobs)
    finally:
        folder.close()
    return tmp_path / "night"


class PowerCut(Observer):
    """Takes the rotators their reference when a capture has ended, many turns away from where they began."""

    def __init__(self):
        self.run = None
        self.turned_deg = []

    def run_ended(self, status, details):
        emulator = self.run.rig.simulation.emulators["rotators"]
        self.turned_deg.append(max(axis.true_deg() for axis in emulator.axes))
        for axis in emulator.axes:
            axis.lose_reference()


def test_rotators_homed_again_between_captures_count_their_turns_anew(quick_rig, intact, configs, tmp_path):
    config = load_rig(quick_rig(flux_e_per_s=8e6))
    campaign = _campaign(tmp_path, configs, full=False)
    jobs = [entry for entry in campaign_run.prepare(campaign, config) if entry[1].plan.mode == "drr"]
    cut = PowerCut()
    night = _night(tmp_path, campaign, config, jobs, cut)
    assert min(cut.turned_deg) > 360.0
    for capture, job in jobs:
        assert intact(night / capture.name) == len(job.table)


def test_a_night_of_captures_reads_an_instrument_s_file_once(configs, tmp_path, monkeypatch):
    """Each reading takes 15 ms: a night of 300 captures began with five seconds of it."""
    read, read_file = [], InstrumentModel.load
    monkeypatch.setattr(InstrumentModel, "load", lambda path: read.append(path) or read_file(path))
    jobs = campaign_run.prepare(_campaign(tmp_path, configs), load_rig(configs / "rigs" / "simulated.yaml"))
    assert len(jobs) > len(read) == len({job.plan.mode for _, job in jobs})


@pytest.mark.long
def test_unattended_campaign_survives_random_faults(quick_rig, intact, configs, tmp_path):
    # Short waits, so that a stalled axis does not cost the test its minutes.
    rig_file = quick_rig(flux_e_per_s=8e6)
    short = {"stall_s": 0.4, "margin_s": 0.5, "reply_s": 0.2}
    values = {f"axes.{axis}.{wait}": s for axis in ("psg", "psa", "arm") for wait, s in short.items()}
    with_values(rig_file, values, rig_file)
    config = load_rig(rig_file)
    campaign = _campaign(tmp_path, configs)
    jobs = campaign_run.prepare(campaign, config)
    weather = Weather(FAULTS, sum(len(job.table) for _, job in jobs), seed=FAULTS)
    night = _night(tmp_path, campaign, config, jobs, weather)
    assert sum(weather.injected.values()) == FAULTS
    states = 0
    for capture, job in jobs:
        done = intact(night / capture.name)
        assert done == len(job.table)
        states += done
    events = Counter(json.loads(line)["event"] for line in (night / "log.jsonl").read_text().splitlines())
    index = json.loads((night / "index.json").read_text())
    assert {entry["status"] for entry in index.values()} == {"complete"}
    print(f"{FAULTS} faults, {len(jobs)} captures, {states} states intact, {events['capture failed']} runs resumed")
    print(dict(sorted(weather.injected.items())))
