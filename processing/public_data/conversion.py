"""From the files of a public set to captures: the table of states of each, as `process import` reads it."""

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

#: Local name of a file to its path.
Files = Mapping[str, Path]
#: File names of the imaging polarimeter hold rounded degrees; its grid has steps of 22.5.
EXACT_DEG = {0: 0.0, 23: 22.5, 45: 45.0, 68: 67.5, 90: 90.0, 113: 112.5, 135: 135.0, 158: 157.5}


@dataclass(frozen=True)
class PublicStates:
    """States of one capture.

    Attributes
    ----------
    name : of the capture.
    wavelength_nm : of the light.
    sample : "air", "mirror" or "unknown".
    header, rows : of the states file (docs/processing.md, "Data measured elsewhere").
    """

    name: str
    wavelength_nm: float
    sample: str
    header: str
    rows: tuple[str, ...]

    def write(self, folder: Path) -> tuple[Path, bool]:
        """Write NAME.states.csv; returns its path, and whether it existed with the same text."""
        path = folder / f"{self.name}.states.csv"
        text = "\n".join((self.header, *self.rows)) + "\n"
        if path.is_file() and path.read_text(encoding="utf-8") == text:
            return path, True
        path.write_text(text, encoding="utf-8")
        return path, False


def tables_of(name: str, files: Files) -> list[PublicStates]:
    """The captures of a set; empty where it holds no intensities."""
    return CONVERTERS[name](files) if name in CONVERTERS else []


def _mosaics(files: Files) -> list[PublicStates]:
    return [
        PublicStates(name.split("_")[1], 550, "unknown", "state,file", (f"0,{path.resolve()}",))
        for name, path in files.items()
    ]


def _imaging_630(files: Files) -> list[PublicStates]:
    header = "state,analyzer_deg,psg_deg,psa_deg,file"
    folders = {"mirror": "Reflexion", "smileys": "Smileys"}
    states = []
    for name, folder in folders.items():
        frames = sorted((path for local, path in files.items() if f"/{folder}/" in local), key=lambda path: path.name)
        rows = []
        for k, path in enumerate(frames):
            *analyzer, psg, psa = (int(part) for part in path.stem.split("_"))
            angles = f"{analyzer[0] if analyzer else 0},{EXACT_DEG[psg]},{EXACT_DEG[psa]}"
            rows.append(f"{k},{angles},{path.resolve()}")
        states.append(PublicStates(name, 630, "mirror" if name == "mirror" else "unknown", header, tuple(rows)))
    return states


def mirror_means(file: Path) -> PublicStates:
    """The mirror frames of the imaging polarimeter as one mean each, of the table in tests/data."""
    with file.open(encoding="utf-8") as opened:
        rows = list(csv.DictReader(opened))
    lines = []
    for k, row in enumerate(rows):
        psg, psa = (EXACT_DEG[int(row[f"{end}_retarder_deg_nominal_rounded"])] for end in ("psg", "psa"))
        lines.append(f"{k},{psg},{psa},{row['psa_polarizer_deg']},{row['roi_mean_dn']}")
    return PublicStates(
        "mirror_means", 630, "mirror", "state,psg_deg,psa_deg,analyzer_deg,channel_camera", tuple(lines)
    )


def _wollaston(files: Files) -> list[PublicStates]:
    states = []
    for name, local, prefix in (("air", "cal_results.json", "Cal_"), ("plate", "sample_results.json", "")):
        data = json.loads(files[local].read_text(encoding="utf-8"))
        for key in sorted(key for key in data if key.startswith(f"{prefix}theta")):
            nm = key.removeprefix(f"{prefix}theta")
            theta, left, right = (np.asarray(data[f"{prefix}{part}{nm}"]) for part in ("theta", "Il_", "Ir_"))
            rows = [
                f"{k},{float(np.degrees(theta[n]))!r},{float(left[n])!r},{float(right[n])!r}"
                for k, n in enumerate(np.argsort(theta))
            ]
            header = "state,psg_deg,channel_left,channel_right"
            sample = "air" if name == "air" else "unknown"
            states.append(PublicStates(f"{name}_{nm}nm", float(nm), sample, header, tuple(rows)))
    return states


def single_detector(file: Path, wavelength_nm: float, beside: int = 0) -> PublicStates:
    """Air before one detector: the mean over `beside` rows of 2 nm on both sides of a wavelength."""
    lines = file.read_text(encoding="utf-8").replace(",", " ").splitlines()
    table = np.array([line.split() for line in lines if not line.startswith("wavelength")], dtype=float)
    at = int(np.argmin(np.abs(table[:, 0] - wavelength_nm)))
    means = table[at - beside : at + beside + 1, 1:].mean(axis=0)
    rows = tuple(f"{n},{6 * n},{30 * n},{float(v)!r}" for n, v in enumerate(means))
    return PublicStates(f"air_{wavelength_nm:g}nm", wavelength_nm, "air", "state,psg_deg,psa_deg,channel_camera", rows)


def _single_detector(files: Files) -> list[PublicStates]:
    return [single_detector(next(iter(files.values())), nm) for nm in range(450, 901, 50)]


def _charis(files: Files) -> list[PublicStates]:
    by_wavelength: dict[int, list[str]] = {}
    for wavelength, hwp, rotator, left, right, stderr in _charis_rows(files.values()):
        rows = by_wavelength.setdefault(round(float(wavelength)), [])
        # The error is that of a difference of two channels.
        sigma = float(stderr) / np.sqrt(2)
        rows.append(f"{len(rows)},{hwp},{rotator},{left},{right},{sigma}")
    header = "state,hwp_deg,image_rotator_deg,channel_left,channel_right,sigma"
    return [PublicStates(f"air_{nm}nm", nm, "air", header, tuple(rows)) for nm, rows in sorted(by_wavelength.items())]


def _charis_rows(paths: Iterable[Path]) -> list[Sequence[str]]:
    """Wavelength, both angles, both channels and the error, of the source's tables or of the reduced one."""
    names = {
        "fluxes.csv": ("wavelength_nm", "hwp_deg", "image_rotator_deg", "left", "right", "stderr"),
        "": ("wavelength_bin", "RET-ANG1", "D_IMRANG", "LCOUNTS", "RCOUNTS", "diff_std"),
    }
    rows: list[Sequence[str]] = []
    for path in paths:
        columns = names[path.name if path.name in names else ""]
        with path.open(encoding="utf-8") as opened:
            rows += [[row[column] for column in columns] for row in csv.DictReader(opened)]
    return rows


CONVERTERS: dict[str, Callable[[Files], list[PublicStates]]] = {
    "dofp-imx250mzr": _mosaics,
    "drr-imaging-630nm": _imaging_630,
    "drr-wollaston-nir": _wollaston,
    "drr-single-detector-vis": _single_detector,
    "dual-beam-charis-nir": _charis,
}
