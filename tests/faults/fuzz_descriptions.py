"""GenICam descriptions to be spoilt, and how one is read to the end: a camera that is about to play it."""

import shutil
import zipfile
from pathlib import Path

import numpy as np

from simulators.camera.gige_camera import GigeCamera
from simulators.camera.gige_features import description
from simulators.camera.node_map import node_map

ROOT = Path(__file__).resolve().parents[2]
STYLE = ROOT / "tests" / "conformance" / "descriptions" / "in_the_style_of_makers.xml"
SIZE = (64, 48)


def sound_files(folder: Path) -> list[Path]:
    """One in the style of makers, plain and packed, and two that are written from tables."""
    files = [Path(shutil.copy(STYLE, folder))]
    for name in ("flir_bfs_pge_51s5p", "basler_aca2440_20gm"):
        files.append(folder / f"{name}.xml")
        files[-1].write_text(description(node_map(name), *SIZE))
    files.append(folder / "packed.zip")
    with zipfile.ZipFile(files[-1], "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(STYLE, STYLE.name)
    return files


def read(path: Path) -> None:
    """Everything that is done before the camera answers. Raises ConfigError."""
    GigeCamera("FUZZ-1", *SIZE, lambda info: np.zeros((info.height, info.width), np.uint16), description=path)
