"""The paper in one command, at one wavelength and one angle: taken on emulators, processed, one page."""

import re
from pathlib import Path

import paper
import pytest
from paper_study.acquire import QUICK

from processing.campaign.executors import executor


def cells(text: str, row: str) -> list[str]:
    """What a table row holds after its first cell."""
    line = next(line for line in re.findall(r"<tr>.*?</tr>", text, re.S) if row in line)
    return [re.sub("<.*?>", "", cell).strip() for cell in re.findall(r"<td>(.*?)</td>", line, re.S)][1:]


@pytest.mark.long
def test_the_page(tmp_path: Path) -> None:
    """One test, so that no second process takes the study anew."""
    with executor(1) as pool:
        paper.run(tmp_path, tmp_path / "paper.html", QUICK, pool, figure=tmp_path / "deviations.png")
    assert (tmp_path / "deviations.png").stat().st_size > 10_000
    text = (tmp_path / "paper.html").read_text(encoding="utf-8")
    every_figure_and_table_of_the_paper_has_its_place(text)
    the_budget_adds_up(text)
    the_fault_is_found_and_psi_is_the_better_for_it(text)
    assert (tmp_path / "results/fault/rgb950_diagnosed.yaml").exists()


def every_figure_and_table_of_the_paper_has_its_place(text: str) -> None:
    assert "SIMULATED" in text
    for title in ("Scattering angles", "two terms", "process of the body", "look-up tables", "between polarizers"):
        assert title in text
    # The paper's Figs. 2, 4 to 12.
    assert {int(number) for number in re.findall(r"paper, Figs?\. (\d+)", text)} == {2, 4, 5, 6, 7, 8, 9, 10, 12}
    assert cells(text, "RMSD of psi")[0] == "14.29"
    assert cells(text, "RMSD of xi0")[0] == "4.24"


def the_budget_adds_up(text: str) -> None:
    total, *parts = (float(cell) for cell in cells(text, "662 nm, xi0"))
    assert sum(abs(part) * part for part in parts) == pytest.approx(total**2, rel=0.03)
    # The bench's small eigenvalues differ, and that alone makes xi0 wrong by more than the noise does.
    assert parts[-1] > parts[0]


def the_fault_is_found_and_psi_is_the_better_for_it(text: str) -> None:
    match = re.search(r"found: psg_azimuth.*?azimuth ([0-9.]+) ± ([0-9.]+)", text, re.S)
    assert match is not None
    assert float(match[1]) == pytest.approx(2.0, abs=5 * float(match[2]))
    before, after = (float(cell) for cell in cells(text.split("Before and after")[1], "662 nm")[1:3])
    assert after < 0.95 * before
