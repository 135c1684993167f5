"""The loop by the product's own steps: take, reduce, diagnose, write the corrected instrument, reduce again."""

import hashlib
import shlex
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from acquisition.capture.plan import MeasurementPlan
from acquisition.demo.truth import DrawnFault, TrueError, draw_faults, true_error
from acquisition.rig.config import RigConfig
from acquisition.screen.observer import Observer
from acquisition.taking import take_capture
from processing.diagnosis.instrument.diagnose import Judged, diagnose_captures
from processing.diagnosis.instrument.figures import write_report
from processing.diagnosis.instrument_file import write_instrument
from processing.diagnosis.search.result import FoundEffect
from processing.instrument.model import InstrumentModel
from processing.steps.maps import Xi0
from processing.steps.reduction import Reduction
from processing.storage.captures.schema import Sample
from processing.whole_file import write_new_text
from processing.yaml_file import ConfigError, dump_yaml
from simulators.bench.scene import Scene
from simulators.bench.typical_faults import FAULTS

#: Called with a step's command line as a user would type it, or with the present step of the diagnosis.
Say = Callable[[str], None]
SAMPLE = "red_sphere"


@dataclass(frozen=True)
class Demo:
    """Result of a run of the demo, and the truth.

    Attributes
    ----------
    judged : the diagnosis, with the residuals of the sphere and of air.
    before, after : errors of the sphere's Mueller image and xi0, with the declared and the corrected instrument.
    seconds : duration of the whole run.
    """

    seed: int
    faults: tuple[DrawnFault, ...]
    judged: Judged
    before: TrueError
    after: TrueError
    folder: Path
    seconds: float

    def effects_for(self, fault: DrawnFault) -> tuple[FoundEffect, ...]:
        """Effects found for a drawn fault: by its name, or else with its name among the equal alternatives."""
        effects = self.judged.diagnosis.effects
        by_name = tuple(e for e in effects if e.kind in (fault.kind, *FAULTS[fault.kind].implies))
        return by_name or tuple(e for e in effects if fault.kind in _kinds(e.indistinguishable_from))


def _kinds(names: Sequence[str]) -> set[str]:
    return {name.partition("[")[0] for name in names}


def run_demo(
    rig: RigConfig,
    plan: MeasurementPlan,
    folder: Path,
    seed: int,
    *,
    count: int = 2,
    only: Sequence[str] = (),
    say: Say = lambda line: None,
    progress: Callable[[], AbstractContextManager[Say]] = lambda: nullcontext(lambda step: None),
    observers: Sequence[Observer] = (),
) -> Demo:
    """Run the loop into a new folder.

    Parameters
    ----------
    rig, plan : the simulated rig and the plan of the sphere; air is taken at 180 degrees with the same states.
    seed : of the faults and of the noise.
    count, only : see `draw_faults`.
    say : is given each command line; progress : opened around the diagnosis, for its steps.

    Raises
    ------
    ConfigError
        The rig has no simulator, or the faults cannot be drawn.
    """
    if rig.simulator is None:
        raise ConfigError(f"rig {rig.name!r} is real: `demo` builds faults into the simulated rig. Leave --rig out.")
    begin = time.monotonic()
    faults = draw_faults(seed, count, only, plan.states.states + plan.darks)
    folder.mkdir(parents=True)
    truth = dump_yaml(_with_faults(rig, faults, seed))
    sealed = hashlib.sha256(truth.encode()).hexdigest()[:16]
    say(f"{count} undeclared faults are built into the rig. The truth is sealed, SHA-256 {sealed}")
    true_rig = folder / "rig.yaml"

    def take(number: int, plan: MeasurementPlan) -> Path:
        name = plan.sample.name or plan.sample.kind
        say(f"./lab acquire --omega {plan.omega_deg:g} --sample {name} --rig {true_rig} --out {folder}")
        return take_capture(plan, _with_faults(rig, faults, seed + number), folder, observers=observers)

    sphere = take(0, plan)
    air = take(1, plan.with_changes(omega_deg=180, sample=Sample(kind="air", name="air")))
    declared = Path(rig.modes[plan.mode].instrument).resolve()
    scene = Scene.load(rig.simulator.samples[SAMPLE])

    def reduce(instrument: Path | None = None) -> TrueError:
        step = Reduction(sphere, instrument)
        options = [] if instrument is None else ["--instrument", instrument, "--out", folder / "corrected.mueller.h5"]
        say(shlex.join(map(str, ["./lab", "process", "reduce", sphere, *options])))
        mueller = step.make(None if instrument is None else folder / "corrected.mueller.h5")
        say(f"./lab process xi0 {mueller}")
        return true_error(mueller, Xi0(mueller).make(), scene)

    before = reduce()
    corrected, report = folder / "corrected.yaml", folder / "report.html"
    say(f"./lab diagnose {sphere} {air} --instrument {declared} --write {corrected} --report {report}")
    model = InstrumentModel.load(declared)
    with progress() as step:
        judgement, problem = diagnose_captures([sphere, air], model, step)
    write_report(report, judgement, problem)
    write_instrument(corrected, model, judgement.diagnosis)
    after = reduce(corrected)
    write_new_text(true_rig, truth)
    return Demo(seed, faults, judgement, before, after, folder, time.monotonic() - begin)


def _with_faults(rig: RigConfig, faults: Sequence[DrawnFault], seed: int) -> RigConfig:
    assert rig.simulator is not None
    effects = (*rig.simulator.effects, *(fault.effect for fault in faults))
    return rig.model_copy(update={"simulator": rig.simulator.model_copy(update={"effects": effects, "seed": seed})})
