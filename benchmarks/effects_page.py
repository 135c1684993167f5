"""Write docs/effects.md, its pictures and configs/rigs/faulty.yaml from the effects of `diagnose` and the rig's faults.

PYTHONPATH=. python benchmarks/effects_page.py
"""

import inspect
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from ruamel.yaml import YAML

from processing.instrument.applied_effects import instrument_effects
from processing.instrument.model import InstrumentModel
from processing.instrument.states import rotating_retarders
from processing.reflectance.effects.base import reflectance_effects
from simulators.bench.bench import SceneImage, SimulatedBench
from simulators.bench.effects.base import BenchEffect, Shot
from simulators.bench.scene import Scene
from simulators.bench.typical_faults import FAULTS, TypicalFault

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs/effects.md"
PICTURES = ROOT / "docs/images/effects"
CONFIGS = ROOT / "configs"
RIG = CONFIGS / "rigs/faulty.yaml"
#: Faults that the rig file has switched on.
SWITCHED_ON = ("psg_retardance", "source_drift")
WAVELENGTH_NM = 662.0
#: Side of the images in pixels, seconds between exposures, and electrons a second: bright, since no noise is drawn.
SIDE, PERIOD_S, FLUX = 64, 1.0, 8e5
EXPOSURE_S = 0.02
HEAD = """# Effects

*Reference.* Every effect that `diagnose` can find: its cause, its remedy, and its residual. *Rig* is the entry of
`simulator: effects:` that gives the fault to the simulated rig. `configs/rigs/faulty.yaml` has them ready to switch on,
and [the demo](demo.md) draws from them:

```bash
./lab acquire --omega 35 --rig configs/rigs/faulty.yaml
```

A picture shows the residual of the declared model, without noise. The plot gives its mean for each state, in percent of
the mean signal. The maps give its rms over the states in each pixel of the sphere (35 degrees) and of air (180
degrees). If a map is zero, this sample cannot show the fault. `benchmarks/effects_page.py` makes this page.

## Of the instrument
"""
SURFACE = """
## Of the surface

`diagnose --reflectance` finds these. They are not switches of the rig: the scene, its material file and its geometry
file hold them.
"""


@dataclass(frozen=True)
class Described:
    """The sections of the docstring of an effect."""

    kind: str
    title: str
    cause: str
    remedy: str

    @classmethod
    def of(cls, kind: str, module: str) -> "Described":
        """Read the sections of a module's docstring."""
        title, _, body = module.partition("\n\n")
        _, _, body = body.partition("Cause:")
        cause, _, remedy = body.partition("Mend:")
        return cls(kind, *(" ".join(text.split()) for text in (title, cause, remedy)))

    def lines(self, before: "Sequence[Described]") -> str:
        """Heading, title, cause and remedy; a reference where an effect `before` has the same."""
        head = f"\n### {self.kind}\n\n{wrapped(self.title)}\n\n"
        for earlier in before:
            if (earlier.cause, earlier.remedy) == (self.cause, self.remedy):
                return f"{head}Cause and remedy are those of [{earlier.kind}](#{earlier.kind}).\n"
        return f"{head}{wrapped(f'**Cause:** {self.cause}')}\n\n{wrapped(f'**Remedy:** {self.remedy}')}\n"


def wrapped(text: str) -> str:
    """Lines of at most 120 characters."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def described(effects: dict[str, object]) -> list[Described]:
    """All effects of a room, in the order of their kinds."""
    return [
        Described.of(kind, inspect.getmodule(type(effect)).__doc__ or "") for kind, effect in sorted(effects.items())
    ]


def page() -> str:
    """The page as it should be."""
    parts, effects = [HEAD], described(instrument_effects())
    for k, effect in enumerate(effects):
        parts.append(effect.lines(effects[:k]))
        fault = FAULTS.get(effect.kind)
        if fault is None:
            continue
        parts.append(f"\n**Rig:** `{flow(fault.example())}`\n")
        if fault.hidden:
            parts.append(f"\n{wrapped(f'The default plan cannot show it: {fault.hidden}.')}\n")
        if effect.kind in pictured_kinds():
            parts.append(f"\n![residual](images/effects/{effect.kind}.png)\n")
    parts.append(SURFACE)
    parts += [effect.lines(effects) for effect in described(reflectance_effects())]
    return "".join(parts)


def flow(effect: BenchEffect) -> str:
    """An effect as one line of YAML."""
    out = BytesIO()
    yaml = YAML()
    yaml.default_flow_style = True
    yaml.width = 10_000
    values = effect.model_dump()
    yaml.dump({"kind": values["kind"]} | effect.model_dump(exclude_defaults=True), out)
    return out.getvalue().decode().strip()


def faulty_rig() -> str:
    """The simulated rig with every fault as a line to switch on."""
    text = (CONFIGS / "rigs/simulated.yaml").read_text(encoding="utf-8")
    head = "# RGB950's layout on emulators: the default of `acquire`. Every device is opened by its real driver.\n"
    assert head in text
    new_head = (
        "# The simulated rig with faults that its instrument file does not declare: the `effects` at the end.\n"
        "# Made by `python benchmarks/effects_page.py`; docs/effects.md shows each fault and its residual.\n"
    )
    text = text.replace(head, new_head).replace("name: simulated RGB950", "name: faulty simulated RGB950")
    # Small frames: of these `diagnose` takes seconds.
    text = text.replace("rows: 600", "rows: 160").replace("columns: 600", "columns: 160")
    lines = ["  # Remove or add a # to switch a fault off or on. The comment names the effect that `diagnose` finds.\n"]
    lines.append("  effects:\n")
    for kind in (*SWITCHED_ON, *(k for k in sorted(FAULTS) if FAULTS[k].mode == "drr" and k not in SWITCHED_ON)):
        lines.append(f"{'' if kind in SWITCHED_ON else '#'}    - {flow(FAULTS[kind].example())}  # {kind}\n")
    return text + "".join(lines)


def residual(effect: BenchEffect, scene: SceneImage, omega_deg: float) -> NDArray[np.float64]:
    """Residual of the declared model for a capture with the effect (states, rows, columns), over the mean signal.

    The sphere is unknown, of air the Mueller matrix is known; outside the object it is zero.
    """
    model = InstrumentModel.load(CONFIGS / "instruments/rgb950.yaml")
    table = rotating_retarders(EXPOSURE_S)
    angles = {axis: np.asarray(values) for axis, values in table.angles_deg.items()}
    bench = SimulatedBench(
        scene, model, WAVELENGTH_NM, rows=SIDE, columns=SIDE, flux_e_per_s=FLUX, seed=1, effects=(effect,)
    )
    frames = []
    for k in range(len(table)):
        pose = {axis: float(values[k]) for axis, values in angles.items()}
        electrons = bench.expected_electrons(pose, EXPOSURE_S, k, omega_deg=omega_deg)
        frames.append(effect.detector(electrons, Shot(k, EXPOSURE_S, k * PERIOD_S, bench.seed, pose)))
    y = np.stack(frames).astype(float).reshape(len(frames), -1)
    w = model.at(WAVELENGTH_NM).rows(angles).reshape(len(frames), 16)
    columns = w if omega_deg != 180 else (w @ np.eye(4).reshape(16))[:, None]
    residuals = y - columns @ (np.linalg.pinv(columns) @ y)
    bright = y.mean(axis=0) > 0.1 * y.mean()
    return np.asarray(np.where(bright, residuals / y[:, bright].mean(), 0.0).reshape(-1, SIDE, SIDE))


def picture(fault: TypicalFault) -> Figure:
    """Mean residual of each state on the left, rms over the states of each pixel on the right."""
    effect = fault.example()
    residuals = {
        name: 100 * residual(effect, Scene.load(CONFIGS / f"scenes/{file}.yaml"), omega_deg)
        for name, file, omega_deg in (("sphere", "red_sphere", 35.0), ("air", "air", 180.0))
    }
    figure = Figure(figsize=(7, 1.7), layout="constrained", facecolor="white")
    states, *maps = figure.subplots(1, 3, width_ratios=[2.6, 1, 1])
    end = max(float(np.sqrt((r**2).mean(axis=0)).max()) for r in residuals.values()) or 1.0
    for axis, (name, r), colour in zip(maps, residuals.items(), ("#b2182b", "#2166ac"), strict=True):
        lit = np.abs(r).max(axis=0) > 0
        means = r[:, lit].mean(axis=1) if lit.any() else np.zeros(len(r))
        states.plot(means, "o-", ms=2, lw=0.8, color=colour, label=name)
        mappable = axis.imshow(np.sqrt((r**2).mean(axis=0)), vmin=0, vmax=end, cmap="viridis", interpolation="nearest")
        axis.set_title(name, fontsize=7.5, color=colour)
        axis.set_xticks([])
        axis.set_yticks([])
    bar = figure.colorbar(mappable, ax=maps, shrink=0.9)
    bar.ax.tick_params(labelsize=6.5)
    bar.set_label("%", fontsize=7)
    states.set_xlabel("state", fontsize=7.5)
    states.set_ylabel("residual / %", fontsize=7.5)
    states.tick_params(labelsize=6.5)
    states.spines[["top", "right"]].set_visible(False)
    return figure


def pictured_kinds() -> list[str]:
    """Kinds with a picture."""
    return [kind for kind in sorted(FAULTS) if FAULTS[kind].mode == "drr" and not FAULTS[kind].hidden]


def main() -> None:
    """Write the page, the pictures and the rig file."""
    RIG.write_text(faulty_rig(), encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
    PICTURES.mkdir(exist_ok=True)
    for kind in pictured_kinds():
        picture(FAULTS[kind]).savefig(PICTURES / f"{kind}.png", dpi=100)


if __name__ == "__main__":
    main()
