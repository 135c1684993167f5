"""Coverage of every quoted error bar for samples and instruments that are drawn at random, not chosen.

    python benchmarks/error_bars_drawn.py [--instruments 40] [--pixels 100] [--seed 1]

Each instrument is two turning plates of drawn retardances and angles (18 to 44 states, condition number below 90), with
0, 1 or 4 dark frames and 20 to 20,000 electrons a state. It measures ten samples: retarders, diattenuators, mirrors and
random Jones matrices, alone or mixed with up to three other processes.
"""

from __future__ import annotations

import argparse
from collections import defaultdict

import numpy as np
from error_bars import cells_of
from noisy_images import random_processes, two_plates

from processing.maps.quantities import EXTRA
from processing.polarization import mueller

SAMPLES, WORST_CONDITION, GOOD_CONDITION = 10, 90.0, 20.0


def instrument(random: np.random.Generator) -> np.ndarray:
    """W (N, 16) of drawn plates and angles."""
    while True:
        count = int(random.integers(18, 45))
        retardances = (float(random.uniform(60, 160)), float(random.uniform(60, 160)))
        if random.random() < 0.6:
            steps = np.deg2rad(random.uniform(3, 12)) * np.arange(count)
            angles = steps, random.uniform(2, 9) * steps
        else:
            angles = random.uniform(0, np.pi, count), random.uniform(0, np.pi, count)
        w = two_plates(retardances, angles)
        if np.linalg.cond(w) < WORST_CONDITION:
            return w


def sample(random: np.random.Generator) -> np.ndarray:
    """Matrix (4, 4) with m00 = 1."""
    degrees = random.choice([random.uniform(0, 180), random.uniform(0, 5), random.uniform(175, 180)])
    retarder = mueller.retarder(random.uniform(0, np.pi), np.deg2rad(degrees))
    kinds = (
        retarder @ mueller.rotation(random.uniform(-0.5, 0.5)),
        mueller.diattenuator(random.uniform(0, np.pi), 1.0, 10 ** random.uniform(-4, 0)),
        retarder @ mueller.diattenuator(random.uniform(0, np.pi), 1.0, random.uniform(0.1, 1)),
        mueller.IDEAL_MIRROR @ retarder,
        random_processes(1, int(random.integers(1 << 30)))[0],
    )
    process = kinds[min(int(random.integers(8)), 4)]
    process = process / process[0, 0]
    if random.random() < 0.25:
        return np.asarray(process)
    shares = np.sort(random.dirichlet(np.full(4, random.choice([0.3, 1.0, 5.0]))))[::-1]
    if random.random() < 0.4:
        shares[1:] = (1 - shares[0]) / 3
    first = np.linalg.eigh(mueller.coherency(process[None]))[1][0][:, -1]
    others = random.normal(size=(4, 3)) + 1j * random.normal(size=(4, 3))
    vectors = np.linalg.qr(np.column_stack([first, others]))[0]
    parts = mueller.coherency_to_mueller(np.einsum("ik,jk->kij", vectors, vectors.conj()))
    mixed = np.tensordot(shares, parts, axes=1)
    return np.asarray(mixed / mixed[0, 0])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instruments", type=int, default=40)
    parser.add_argument("--pixels", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    random, found = np.random.default_rng(arguments.seed), defaultdict(list)
    for number in range(arguments.instruments):
        w, samples = instrument(random), {f"sample {k}": sample(random) for k in range(SAMPLES)}
        electrons, darks = float(np.exp(random.uniform(np.log(20), np.log(20_000)))), int(random.choice([0, 1, 4]))
        seed = [1000 * arguments.seed + number, darks, int(electrons), 0]
        for cell in cells_of(samples, {"drawn": w}, darks, electrons, pixels=arguments.pixels, extra=EXTRA, seed=seed):
            found[cell.quantity].append((cell.in_68, cell.in_95, np.linalg.cond(w) < GOOD_CONDITION))
    print("| quantity | cells | 68 % | 95 % | condition below 20 | 20 to 90 |\n|---|---|---|---|---|---|")
    for name, cells in found.items():
        in_68, in_95, good = 100 * np.array(cells).T
        parts = [f"{in_68[some].mean():.0f}, {in_95[some].mean():.1f}" for some in (good > 0, good == 0)]
        print(f"| {name} | {len(cells)} | {in_68.mean():.1f} | {in_95.mean():.1f} | {' | '.join(parts)} |")
