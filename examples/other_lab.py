"""Write data as another lab keeps them: folders of TIFF files, and one table of angles.

The polarimeter has two plates at a ratio of 5 to 1. Its plates have 88.5 and 91.2 degrees of retardance; its owner
believes that both have 90. `docs/tutorial-your-own-polarimeter.md` reads these data.
"""

from pathlib import Path

import cv2
import numpy as np

from processing.polarization.mueller import polarizer, retarder

DARK_COUNTS, ELECTRONS_PER_COUNT = 100, 2.0
SAMPLE = np.array(
    [[1.0, 0.1, -0.05, 0.02], [0.08, 0.6, 0.03, 0], [-0.04, 0.02, 0.5, 0.05], [0.01, 0, -0.06, 0.4]]
)  # fmt: skip


def write_folders(folder: Path, retardances_deg: tuple[float, float] = (88.5, 91.2), side: int = 40) -> None:
    """Write `sample`, `air`, `dark` and `log.csv` into a folder."""
    rng = np.random.default_rng(17)
    angles = np.arange(36) * 6.0
    level = 8000 * np.linspace(0.7, 1.0, side)[:, None] * np.ones(side)
    plates = np.deg2rad(retardances_deg)
    for name, mueller in {"sample": SAMPLE, "air": np.eye(4), "dark": np.zeros((4, 4))}.items():
        (folder / name).mkdir(parents=True, exist_ok=True)
        for k, angle in enumerate(angles[:5] if name == "dark" else angles):
            generator = retarder(np.deg2rad(angle), plates[0]) @ polarizer(0)
            analyzer = polarizer(0) @ retarder(np.deg2rad(5 * angle), plates[1])
            electrons = rng.poisson(ELECTRONS_PER_COUNT * level * (analyzer @ mueller @ generator)[0, 0])
            counts = DARK_COUNTS + electrons / ELECTRONS_PER_COUNT + rng.normal(0, 1.5, level.shape)
            cv2.imwrite(str(folder / name / f"img_{k}.tif"), counts.round().astype(np.uint16))
    rows = [f"{k},{angle},{5 * angle % 360},ok" for k, angle in enumerate(angles)]
    (folder / "log.csv").write_text("\n".join(["frame,angle (deg),analyzer,remark", *rows]) + "\n")


if __name__ == "__main__":
    write_folders(Path("other_lab"))
