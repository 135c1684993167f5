"""The figure of docs/studies/measured-instruments.md: `diagnose` on ../shared/data, before and after.

    OPENBLAS_NUM_THREADS=1 python benchmarks/closing_loop_measured.py --figure docs/images/closing_loop_measured.png

Wollaston polarimeter (1600 nm), mirror frames (630 nm), closure of two pictures of a polarization camera, PTFE
(532 nm). About a minute of processor time. Results only; no data are copied.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from measured_points import FOLDS, ReflectanceProblem

from processing.diagnosis.captured.read_capture import read_capture
from processing.diagnosis.instrument.answer import closure
from processing.diagnosis.instrument.diagnose import Judged, diagnose_captures
from processing.diagnosis.instrument.problem import InstrumentProblem
from processing.diagnosis.instrument_file import extended
from processing.diagnosis.search.fit import held_out, minimize
from processing.diagnosis.search.space import Space
from processing.geometry.frames import ScatteringGeometry, change_frames
from processing.instrument.model import InstrumentModel
from processing.polarization import mueller
from processing.storage.captures.capture import Capture
from processing.storage.formats.importing import ImportRequest, import_capture, read_sample

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared/data"
EXACT_DEG = {23: 22.5, 68: 67.5, 113: 112.5, 158: 157.5}
#: Where the noise is not known, residuals are in thousandths of the mean signal.
PERCENT = 0.1


def imported(folder: Path, lines: list[str], instrument: str, nm: float, sample: str) -> tuple[Path, InstrumentModel]:
    """A capture of a table of states, and the instrument model."""
    folder.mkdir(parents=True)
    file, states, out = ROOT / f"configs/instruments/{instrument}.yaml", folder / "states.csv", folder / "capture.h5"
    states.write_text("\n".join(lines) + "\n", encoding="utf-8")
    import_capture(ImportRequest(states=states, out=out, wavelength_nm=nm, instrument=file, sample=read_sample(sample)))
    return out, InstrumentModel.load(file)


def wollaston(folder: Path) -> Judged:
    """Air at 1600 nm, both channels."""
    data = json.loads((SHARED / "drr-wollaston-nir/cal_results.json").read_text())
    theta, left, right = (np.array(data[k]) for k in ("Cal_theta1600", "Cal_Il_1600", "Cal_Ir_1600"))
    lines = ["state,psg_deg,channel_left,channel_right"]
    lines += [f"{k},{np.rad2deg(theta[n]):.6f},{left[n]},{right[n]}" for k, n in enumerate(np.argsort(theta))]
    path, model = imported(folder, lines, "drr_wollaston", 1600, "air")
    return diagnose_captures([path], model)[0]


def mirror(folder: Path) -> Judged:
    """Region means of 512 frames of a mirror."""
    lines = ["state,psg_deg,psa_deg,analyzer_deg,channel_camera"]
    with (SHARED / "drr-imaging-630nm/roi_stats_630nm.csv").open() as file:
        for k, row in enumerate(csv.DictReader(file)):
            rounded = (int(row[f"{r}_retarder_deg_nominal_rounded"]) for r in ("psg", "psa"))
            psg, psa = (EXACT_DEG.get(n, float(n)) for n in rounded)
            lines.append(f"{k},{psg},{psa},{row['psa_polarizer_deg']},{row['roi_mean_dn']}")
    path, model = imported(folder, lines, "drr_imaging_630nm", 630, "mirror")
    return diagnose_captures([path], model)[0]


def closures(folder: Path) -> list[tuple[str, float]]:
    """Closure of both pictures in percent, before and with what `camera` alone teaches."""
    paths, out = [], []
    for name in ("camera", "fruits"):
        file = SHARED / f"dofp-imx250mzr/polanalyser_{name}_IMX250MZR.png"
        path, model = imported(folder / name, ["state,file", f"0,{file}"], "linear_stokes", 550, "unknown")
        paths.append(path)
    learnt = diagnose_captures(paths[:1], model)[0].diagnosis
    better = extended(model, learnt)
    for name, path in zip(("camera", "fruits"), paths, strict=True):
        for when, used in (("before", model.at(550)), ("after", better.at(550))):
            with Capture(path) as capture:
                problem = InstrumentProblem(used, [read_capture(capture, used)])
            percent = closure(problem, 0, Space(()), np.zeros(0)) or 0.0
            sums = problem.sums(Space(()), np.zeros(0), derivatives=False)
            rms, chi2 = np.sqrt(sums.square.sum() / sums.count.sum()), 1 + sums.excess.sum() / sums.freedom.sum()
            print(f"{name} {when}: closure {percent:.3f} %, {100 * rms:.2f} % left, chi2/dof {chi2:.2f}", flush=True)
            out.append((f"{name}\n{when}", percent))
    return out


def ptfe(um: float = 0.532) -> tuple[Any, Any, Any]:
    """theta_d in degrees, and rms residual over m00 in percent of each geometry, before and after volume scattering."""
    rows = np.genfromtxt(SHARED / "ptfe-mueller-brdf/PTFE.data.csv", delimiter=",", skip_header=1)
    s = rows[rows[:, 0] == um]
    # Axes of the file: docs/reflectance.md.
    flip = np.diag([1.0, 1.0, 1.0, -1.0])
    m = np.concatenate([np.ones((len(s), 1)), s[:, 6:]], axis=1).reshape(-1, 4, 4)
    m = mueller.rotation(-np.deg2rad(s[:, 4])) @ (flip @ m @ flip)
    normal = np.tile([0.0, 0.0, 1.0], (len(s), 1))
    surface = ScatteringGeometry(normal, _direction(s[:, 1:3]), _direction(s[:, 3:5]), normal)
    geometry, m = surface.with_up(surface.s_axis), change_frames(m, surface, surface.s_axis)
    _, incidence = np.unique(np.round(s[:, 1] / 5).astype(int), return_inverse=True)
    fold = incidence % FOLDS
    problem = ReflectanceProblem(geometry, m.reshape(-1, 16), np.eye(16), 1.35 + 0j, folds=fold)
    (volume,) = (c for c in problem.pool() if c.kind == "volume_scattering")
    left = []
    for space in (Space(()), Space((volume,))):
        fit = minimize(problem, space, np.zeros(space.size))
        square = np.empty(len(s))
        for k in range(FOLDS):
            # Every direction of incidence from a fit to the others.
            values = minimize(problem, space, fit.values, [f for f in range(FOLDS) if f != k]).values
            square[fold == k] = problem.residual_squares(space, values)[fold == k]
        print(f"PTFE {um} um: {100 * held_out(problem, space, fit).rms:.2f} % held out")
        left.append(100 * np.sqrt(square / 14))
    return np.rad2deg(geometry.angles.theta_d), *left


def _direction(theta_phi_deg: Any) -> Any:
    t, p = np.deg2rad(theta_phi_deg).T
    return np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], axis=-1)


def source_panel(axis: Any, judged: Judged, title: str) -> None:
    """The source's factor in each state, as found, about its mean."""
    d = judged.diagnosis
    (found,) = (e.parameters["states"] for e in d.effects if e.kind == "source_flicker")
    # The errors are common to all states (a throughput) and would say nothing about the differences.
    axis.plot(100 * (np.array(found.value) - np.mean(found.value)), "o", ms=3)
    axis.axhline(0, color="0.5", lw=0.8)
    axis.set_ylabel("source_flicker, %")
    axis.set_xlabel("state")
    before, after = d.error_before.rms_percent, d.error_after.rms_percent
    axis.set_title(f"{title}: {before:.2f} to {after:.2f} % held out", fontsize=9)


def states_panel(axis: Any, judged: Judged, title: str) -> None:
    """Residual of each intensity before and after."""
    d = judged.diagnosis
    for left, error, name in ((judged.before[0], d.error_before, "before"), (judged.after[0], d.error_after, "after")):
        axis.plot(PERCENT * left.mean, ".", ms=4, label=f"{name}: {error.rms_percent:.2f} % held out")
    axis.set_title(f"{title}: {d.verdict.replace('_', ' ')}", fontsize=9)
    axis.set_ylabel("residual, % of the mean signal")
    axis.set_xlabel("frame")
    axis.legend(fontsize=8)


def main() -> None:
    from matplotlib.figure import Figure

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, required=True)
    given = parser.parse_args()
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for axis, title, run, panel in (
            (axes[0, 0], "Wollaston polarimeter, air, 1600 nm", wollaston, source_panel),
            (axes[0, 1], "mirror, 512 frames, 630 nm", mirror, states_panel),
        ):
            judged = run(folder / run.__name__)
            named = ", ".join(e.kind for e in judged.diagnosis.effects)
            print(f"{title}: {named}, {judged.diagnosis.error_after.rms_percent:.3f} %", flush=True)
            panel(axis, judged, title)
        bars = closures(folder / "mosaic")
    axes[1, 0].bar([b[0] for b in bars], [b[1] for b in bars], color=["C0", "C1"] * 2)
    axes[1, 0].axhline(0, color="0.5", lw=0.8)
    for k, (_, value) in enumerate(bars):
        axes[1, 0].annotate(f"{value:.3f}", (k, value), ha="center", va="bottom", fontsize=8)
    axes[1, 0].set_ylabel("I0 + I90 - I45 - I135, % of S0")
    axes[1, 0].set_title("polarization camera: learnt on `camera` alone", fontsize=9)
    theta, *left = ptfe()
    edges = np.arange(0, 91, 7.5)
    for errors, label in zip(left, ("before: first surface, n = 1.35", "after: volume_scattering"), strict=True):
        part = np.digitize(theta, edges)
        mean = [np.sqrt(np.mean(errors[part == k] ** 2)) if np.any(part == k) else np.nan for k in range(1, len(edges))]
        axes[1, 1].plot((edges[1:] + edges[:-1]) / 2, mean, "o-", ms=4, label=label)
    axes[1, 1].set_ylim(bottom=0)
    axes[1, 1].set_xlabel("theta_d / degree")
    axes[1, 1].set_ylabel("rms residual of M / m00, %")
    axes[1, 1].set_title("PTFE, 532 nm, held-out directions of incidence", fontsize=9)
    axes[1, 1].legend(fontsize=8)
    figure.savefig(given.figure, dpi=80)


if __name__ == "__main__":
    main()
