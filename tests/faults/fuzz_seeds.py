"""The doors that are fuzzed: sound files to begin with, and how each is read to the end."""

import json
import random
import shutil
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import fuzz_descriptions as descriptions
import fuzz_mutators as spoil
import h5py
import numpy as np

from acquisition.campaign.log import read_index
from acquisition.campaign.plan import Campaign, captures
from acquisition.capture.plan import MeasurementPlan
from acquisition.rig.config import load_rig
from processing.geometry.mesh import Mesh
from processing.geometry.viewing import ViewingGeometry
from processing.instrument.model import InstrumentModel
from processing.reduction.instrument_of_capture import choose_model
from processing.reduction.mueller import reduce_mueller
from processing.reflectance.base import load_reflectance
from processing.reflectance.pbsdf import load as load_pbsdf
from processing.reflectance.tables import ScatteringTable
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader, create_layout, write_closing
from processing.storage.formats.axostep import read_mueller_file, read_rmmd
from processing.storage.formats.import_request import ImportRequest, read_sample
from processing.storage.formats.importing import import_capture
from processing.storage.formats.tensor_file import create_tensor_file, read_tensor_file
from processing.storage.products.product import Product, Step
from simulators.bench.scene import Scene

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
INSTRUMENT = CONFIGS / "instruments" / "rgb950.yaml"


@dataclass(frozen=True)
class Door:
    """One kind of file.

    Attributes
    ----------
    make : writes sound files into a folder and returns them.
    spoil : spoils a copy in place.
    read : reads a file to the end as a command would; returns what must not be, or None.
    """

    make: Callable[[Path], Sequence[Path]]
    spoil: Callable[[random.Random, Path], None]
    read: Callable[[Path], str | None]


def _spoil_bytes(rng: random.Random, path: Path) -> None:
    path.write_bytes(spoil.spoil_bytes(rng, path.read_bytes()))


def _spoil_text(rng: random.Random, path: Path) -> None:
    if path.suffix == ".zip" or rng.random() < 0.3:
        _spoil_bytes(rng, path)
    else:
        path.write_text(spoil.spoil_text(rng, path.read_text()))


def _spoil_yaml(rng: random.Random, path: Path) -> None:
    if rng.random() < 0.4:
        _spoil_text(rng, path)
    else:
        path.write_text(spoil.spoil_yaml(rng, path.read_text()))


def _spoil_h5(rng: random.Random, path: Path) -> None:
    if rng.random() < 0.4:
        _spoil_bytes(rng, path)
    else:
        spoil.spoil_h5(rng, path)


def _yaml_door(*folders: str, read: Callable[[Path], str | None]) -> Door:
    def make(folder: Path) -> Sequence[Path]:
        paths = []
        for name in folders:
            for path in sorted((CONFIGS / name).glob("*.yaml")):
                paths.append(folder / path.name)
                # Paths in them are relative to the file.
                text = path.read_text().replace("../", f"{CONFIGS}/")
                paths[-1].write_text(text.replace("file: ", f"file: {CONFIGS}/{name}/"))
        return paths

    return Door(make, _spoil_yaml, read)


def _rig(path: Path) -> str | None:
    """Looked at here once more in the plainest words, apart from the program's own checks."""
    rig = load_rig(path)
    for name, axis in rig.axes.items():
        low, high = axis.limits_deg or (None, None)
        ends = [end for end in (low, high) if end is not None]
        if not np.all(np.isfinite(ends)) or (len(ends) == 2 and ends[0] >= ends[1]):
            return f"limits of {name}: {axis.limits_deg}"
        if not 0 < axis.tolerance_deg < 360 or not 0 < axis.poll_s < 60:
            return f"tolerance or poll of {name}"
        park = rig.park_deg.get(name)
        if park is not None and not (low is None or low <= park) & (high is None or park <= high):
            return f"park of {name}: {park}"
    named = {*rig.park_deg, *rig.backlash_deg, *rig.home_order, *rig.endless, *rig.homing}
    named |= {axis for box in rig.forbidden for axis in box.ranges_deg}
    if not named <= set(rig.axes):
        return f"unknown axes {named - set(rig.axes)}"
    for box in rig.forbidden:
        for low, high in box.ranges_deg.values():
            if not (np.isfinite(low) and np.isfinite(high) and low <= high):
                return f"forbidden range {low} to {high}"
    places = [(axis.kind, axis.port, axis.place()) for axis in rig.axes.values()]
    if len(set(places)) < len(places):
        return "two axes at one address"
    return None if 0 <= rig.settle_s < 3600 and 0 < rig.exposure_s[0] <= rig.exposure_s[1] else "settling or exposure"


def _plan(path: Path) -> str | None:
    plan = MeasurementPlan.load(path)
    table = plan.state_table({"arm": plan.omega_deg}, 0.01)
    angles = np.concatenate(list(table.angles_deg.values()))
    return None if np.all(np.isfinite(angles)) and plan.wavelength_nm > 0 else "angles that are no numbers"


def _campaign(path: Path) -> str | None:
    campaign = Campaign.load(path)
    count = sum(1 for _ in captures(campaign))
    return None if count else "a campaign of nothing"


def _instrument(path: Path) -> str | None:
    model = InstrumentModel.load(path)
    model = model.at(model.wavelengths_nm[0] if model.wavelengths_nm else 662)
    rows = model.rows({axis: np.arange(3.0) for axis in model.axes})
    return None if np.all(np.isfinite(rows)) else "a measurement matrix that is no numbers"


def _scene_files(path: Path) -> str | None:
    if "one_inch" in path.name:
        ViewingGeometry.load(path)
    elif "print" in path.name:
        load_reflectance(path)
    else:
        Scene.load(path)
    return None


# --- HDF5 -------------------------------------------------------------------------------------------------


def _capture_files(folder: Path) -> Sequence[Path]:
    rng = np.random.default_rng(1)
    path = folder / "capture.h5"
    n = 24
    psg = 15.0 * np.arange(n)
    header = CaptureHeader.model_validate(
        {"title": "fuzz", "simulated": True, "mode": "drr", "wavelength_nm": 662, "omega_deg": 35,
         "detector": {"bits": 12, "black_level_counts": 64}, "instrument_yaml": INSTRUMENT.read_text()}
    )  # fmt: skip
    with h5py.File(path, "w") as h5:
        create_layout(
            h5,
            header,
            {"psg": psg, "psa": 4.91 * psg},
            ("sample",) * n,
            frame_shape=(12, 10),
            dtype=np.uint16,
            start_time="2026-01-01",
        )
        h5["entry/instrument/detector/data"][...] = rng.integers(64, 4000, (n, 1, 12, 10))
        for axis, values in (("psg", psg), ("psa", 4.91 * psg)):
            h5[f"entry/instrument/{axis}/value"][...] = values
        h5["entry/states/exposure_s"][...] = 0.01
        h5["entry/states/done"][...] = 1
        write_closing(h5, "complete", {})
    return [path]


def _capture(path: Path) -> str | None:
    with Capture(path) as capture:
        for name in ("exposure_s", "frame_id", "saturated_fraction"):
            assert capture.column(name).shape == capture.done.shape
        capture.planned_targets_deg()
        frames = [capture.frames(k) for k in range(min(len(capture.done), 50))]
        closing, model = capture.closing, capture.instrument
        assert isinstance(closing, dict)
        if any(frame.shape[1:] != capture.frame_shape for frame in frames):
            return "frames of several sizes"
    return None if model is None or capture.header.detector.bits in (None, *range(1, 33)) else "bits"


def _reduced(path: Path) -> str | None:
    out = path.with_name("out.mueller.h5")
    with Capture(path) as capture:
        reduce_mueller(capture, choose_model(capture, None), out, (Step("fuzz", {}),), overwrite=True)
    with Product(out) as product:
        image = product.get("mueller")
    return None if np.isfinite(image).any() else "an image without a number"


def _product_files(folder: Path) -> Sequence[Path]:
    (capture,) = _capture_files(folder)
    out = folder / "image.mueller.h5"
    with Capture(capture) as opened:
        reduce_mueller(opened, choose_model(opened, None), out, (Step("fuzz", {}),))
    return [out]


def _product(path: Path) -> str | None:
    with Product(path) as product:
        for name in product.names:
            assert product.get(name).shape[-2:] == product.shape
            product.units(name), product.long_name(name)
        assert all(isinstance(step.name, str) for step in product.steps)
    return None


def _table_files(folder: Path) -> Sequence[Path]:
    from processing.geometry.rusinkiewicz import Angles

    table = ScatteringTable(("xi0",), 662, has_noise=True, inputs=("analyzer.azimuth_deg",))
    table.add(Angles(*(np.linspace(0.1, 1.0, 50) for _ in range(3))), np.ones((3, 50)))
    table.save(folder / "xi0.table.h5")
    return [folder / "xi0.table.h5"]


def _table(path: Path) -> str | None:
    table = ScatteringTable.load(path)
    return None if table.mean.shape[1] == table.bins.size else "bins without values"


# --- what is imported -------------------------------------------------------------------------------------


def _import_files(folder: Path) -> Sequence[Path]:
    rng = np.random.default_rng(2)
    lines = ["state,psg_deg,psa_deg,exposure_s,role,file"]
    for k in range(18):
        cv2.imwrite(str(folder / f"f{k}.png"), rng.integers(0, 4000, (8, 10)).astype(np.uint16))
        lines.append(f"{k},{20 * k},{98.2 * k},0.01,sample,f{k}.png")
    (folder / "states.csv").write_text("\n".join(lines) + "\n")
    return [folder / "states.csv"]


def _import(path: Path, stack: str | None = None) -> str | None:
    out = path.with_name("imported.h5")
    try:
        import_capture(ImportRequest(path, out, 662, stack=stack, instrument=INSTRUMENT, overwrite=True))
        with Capture(out) as capture:
            names = set(capture.angles_deg)
            if not {"psg", "psa"} <= names or names & {"detector", "beam", ""}:
                return f"axes {names}"
            if not all(np.all(np.isfinite(column)) for column in capture.angles_deg.values()):
                return "an angle that is no number"
    finally:
        out.unlink(missing_ok=True)
    return None


def _picture_files(folder: Path) -> Sequence[Path]:
    _import_files(folder)
    cv2.imwrite(str(folder / "f0.tif"), np.full((8, 10), 7, np.uint16))
    return [folder / "f0.png", folder / "f0.tif"]


def _picture(path: Path) -> str | None:
    # The spoilt picture takes the place of the first frame.
    states = path.with_name("states.csv")
    text = states.read_text()
    states.write_text(text.replace("f0.png", path.name))
    try:
        return _import(states)
    finally:
        states.write_text(text)


def _write_rmmd(path: Path, frames: np.ndarray) -> None:
    header = np.array([0, *frames.shape, 0], dtype=">i4")
    path.write_bytes(header.tobytes() + np.ascontiguousarray(frames[:, ::-1], dtype=">i4").tobytes())


def _stack_files(folder: Path) -> Sequence[Path]:
    _import_files(folder)
    frames = np.random.default_rng(3).integers(0, 4000, (18, 8, 10)).astype(np.uint16)
    np.save(folder / "stack.npy", frames)
    with h5py.File(folder / "stack.h5", "w") as h5:
        h5["group/frames"] = frames
    _write_rmmd(folder / "stack.rmmd", frames)
    states = (folder / "states.csv").read_text().splitlines()
    (folder / "stack.csv").write_text("\n".join(line.rsplit(",", 1)[0] for line in states) + "\n")
    return [folder / name for name in ("stack.npy", "stack.h5", "stack.rmmd")]


def _stack(path: Path) -> str | None:
    return _import(path.with_name("stack.csv"), str(path))


def _sample_files(folder: Path) -> Sequence[Path]:
    np.save(folder / "m.npy", np.eye(4))
    (folder / "m.txt").write_text("1 0 0 0, 0 1 0 0, 0 0 1 0, 0 0 0 1")
    return [folder / "m.npy", folder / "m.txt"]


def _sample(path: Path) -> str | None:
    sample = read_sample(str(path))
    sound = sample.mueller is not None and len(sample.mueller) == 16 and np.all(np.isfinite(sample.mueller))
    return None if sound else f"a Mueller matrix {sample.mueller}"


def _tensor_files(folder: Path) -> Sequence[Path]:
    path = folder / "t.pbsdf"
    fields = {"theta_h": ((1, 91), np.float32), "wvls": ((5,), np.uint16), "M": ((3, 9, 9, 5, 4, 4), np.float32)}
    for values in create_tensor_file(path, fields).values():
        values[...] = 1
    return [path]


def _tensor(path: Path) -> str | None:
    for values in read_tensor_file(path).values():
        np.asarray(values).sum(dtype=float)
    load_pbsdf(path)
    return None


def _axostep_files(folder: Path) -> Sequence[Path]:
    _write_rmmd(folder / "a.rmmd", np.ones((4, 5, 6)))
    words = struct.pack(">4f", 3, 2, 4, 4) + struct.pack(">96f", *range(96)) + struct.pack(">f", 0)
    (folder / "a.cmmi").write_bytes(words)
    return [folder / "a.rmmd", folder / "a.cmmi"]


def _axostep(path: Path) -> str | None:
    (read_rmmd if path.suffix == ".rmmd" else read_mueller_file)(path)
    return None


def _mesh_files(folder: Path) -> Sequence[Path]:
    import trimesh

    box = trimesh.creation.box((10, 10, 10))
    for ending in ("stl", "obj", "ply"):
        box.export(folder / f"box.{ending}")
    return [folder / f"box.{ending}" for ending in ("stl", "obj", "ply")]


def _mesh(path: Path) -> str | None:
    rays = np.zeros((4, 3)) - (0, 0, 1.0)
    _, points, normals = Mesh(file=str(path)).intersect(np.array([0.0, 0.0, 100.0]), rays, 0.0)
    return None if np.all(np.isfinite(points)) and np.all(np.isfinite(normals)) else "points that are no numbers"


def _index_files(folder: Path) -> Sequence[Path]:
    entry = {"status": "complete", "states": 44, "omega_deg": 35.0, "saturated_fraction": 0.0, "error": None}
    sound = folder / "sound.json"
    sound.write_text(json.dumps({f"00{k}_red_sphere.h5": entry for k in range(4)}, indent=1))
    return [sound]


def _index(path: Path) -> str | None:
    index = path.with_name("index.json")
    # What was spoilt itself, which may be a link or a pipe; the sound one is read again.
    shutil.copy(path, index) if path.name == "sound.json" else path.rename(index)
    entries = read_index(path.parent)
    return None if all(isinstance(entry, dict) for entry in entries.values()) else "an entry that is none"


DOORS: dict[str, Door] = {
    "rig": _yaml_door("rigs", read=_rig),
    "plan": _yaml_door("plans", read=_plan),
    "campaign": _yaml_door("campaigns", read=_campaign),
    "instrument": _yaml_door("instruments", read=_instrument),
    "scene": _yaml_door("scenes", "geometries", "materials", read=_scene_files),
    "index": Door(_index_files, _spoil_text, _index),
    "capture": Door(_capture_files, _spoil_h5, _capture),
    "reduce": Door(_capture_files, _spoil_h5, _reduced),
    "product": Door(_product_files, _spoil_h5, _product),
    "table": Door(_table_files, _spoil_h5, _table),
    "states": Door(_import_files, _spoil_text, _import),
    "picture": Door(_picture_files, _spoil_bytes, _picture),
    "stack": Door(_stack_files, _spoil_bytes, _stack),
    "sample": Door(_sample_files, _spoil_bytes, _sample),
    "tensor": Door(_tensor_files, _spoil_bytes, _tensor),
    "axostep": Door(_axostep_files, _spoil_bytes, _axostep),
    "mesh": Door(_mesh_files, _spoil_bytes, _mesh),
    "description": Door(descriptions.sound_files, _spoil_text, descriptions.read),
}


def fresh(source: Path, folder: Path) -> Path:
    """A copy of a sound file to be spoilt, beside the files that belong to it."""
    target = folder / f"spoilt_{source.name}"
    target.unlink(missing_ok=True)
    shutil.copy(source, target)
    return target
