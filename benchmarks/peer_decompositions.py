"""Write tests/physics/peer_decompositions.json: what public packages answer for the same Mueller matrices.

Run it with a Python that has benchmarks/requirements.txt, not with the project's own environment:
    PEERS/bin/python benchmarks/peer_decompositions.py
Only numbers go into the file; the test states each package's convention.
"""

import json
import sys
import warnings
from importlib.metadata import version
from pathlib import Path

import numpy as np

OUT = Path(__file__).resolve().parents[1] / "tests/physics/peer_decompositions.json"


def matrices() -> np.ndarray:
    """Twelve physical depolarizing matrices with det > 0 and four with det < 0, six digits each."""
    rng = np.random.default_rng(2018)
    pauli = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])
    jones = rng.normal(size=(3000, 4, 2, 2)) + 1j * rng.normal(size=(3000, 4, 2, 2))
    mueller = 0.5 * np.einsum("aij,nkjl,blm,nkim->nkab", pauli, jones, pauli, jones.conj()).real
    m = np.einsum("nkab,nk->nab", mueller, rng.exponential(size=(3000, 4)) ** 2)
    m = np.round(m / m[:, :1, :1], 6)
    det = np.linalg.det(m)
    return np.concatenate([m[det > 1e-3][:12], m[det < -1e-4][:4]])


def by_py_pol(m: np.ndarray) -> dict:
    from py_pol.mueller import Mueller

    rows = []
    for one in m:
        sample = Mueller("sample")
        sample.from_matrix(one.copy())
        retarder, diattenuator, depolarizer = sample.analysis.decompose_polar(decomposition="PRD")
        # Both methods may work in place, so each gets its own object.
        fresh, other = Mueller("sample"), Mueller("sample")
        fresh.from_matrix(one.copy())
        other.from_matrix(one.copy())
        index = fresh.parameters.depolarization_index()
        eigenvalues = np.linalg.eigvalsh(np.squeeze(other.covariance_matrix().M))[::-1]
        rows.append((depolarizer.M, retarder.M, diattenuator.M, eigenvalues, index))
    names = ("depolarizer", "retarder", "diattenuator", "covariance_eigenvalues", "depolarization_index")
    return {n: [np.real(np.squeeze(r[k])).tolist() for r in rows] for k, n in enumerate(names)}


def by_muellerkit(m: np.ndarray) -> dict:
    import muellerkit
    from muellerkit import validity

    depolarizer, retarder, diattenuator = muellerkit.decompose_depolarizer_retarder_diattenuator(m)
    found = muellerkit.extract_parameters(depolarizer, retarder, diattenuator)
    return {
        "depolarizer": depolarizer.tolist(),
        "retarder": retarder.tolist(),
        "diattenuator": diattenuator.tolist(),
        "total_retardance_rad": np.asarray(found.total_retardance).tolist(),
        "depolarization_power": np.asarray(found.total_depolarization).tolist(),
        "coherency_eigenvalues": np.linalg.eigvalsh(np.stack([validity.coherency_matrix(x) for x in m]))[
            :, ::-1
        ].tolist(),
    }


def by_katsu(m: np.ndarray) -> dict:
    from katsu import mueller

    rows = [mueller.decompose_depolarizer(x, return_all=True) for x in m]
    return {"factors": [[np.real(np.asarray(f)).tolist() for f in row] for row in rows]}


def by_pymueller(m: np.ndarray) -> dict:
    import pymueller

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = pymueller.decomposition.lu_chipman(1, len(m), m.copy().reshape(1, len(m), 16))
    return {"answers": [np.real(np.asarray(f)).ravel().tolist() for f in found]}


if __name__ == "__main__":
    samples = matrices()
    report: dict = json.loads(OUT.read_text()) if OUT.exists() else {"packages": {}}
    report["matrices"] = samples.tolist()
    peers = {"py_pol": by_py_pol, "muellerkit": by_muellerkit, "katsu": by_katsu, "pymueller": by_pymueller}
    for name, ask in peers.items():
        # py_pol 1.3 needs numpy 1, pymueller's OpenCV needs numpy 2: two environments, one file.
        try:
            report["packages"][name] = {"version": version(name), "numpy": np.__version__, **ask(samples)}
        except (ImportError, TypeError) as error:
            sys.stdout.write(f"{name} left as it was: {error}\n")
    OUT.write_text(json.dumps(report) + "\n")
    sys.stdout.write(f"{OUT}\n")
