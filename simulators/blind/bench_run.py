"""Diagnose one bench of `real_bench`, apply the correction to captures that no fit has used, and judge it."""

import json
import time
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from processing.diagnosis.instrument.diagnose import diagnose_captures
from processing.diagnosis.instrument_file import write_instrument
from processing.instrument.model import InstrumentModel
from simulators.blind.bench_judge import GIVEN, BenchJudgement, matters_of, names_of, wiring_of
from simulators.blind.mueller_error import coverage_of, error_of
from simulators.blind.real_bench import VALIDATION, RealBench


def judge_bench(
    folder: Path, truth: RealBench, configs: Path, capture_set: str = "joint"
) -> tuple[BenchJudgement, dict[str, Any]]:
    """Diagnose the captures of one bench and judge the answer; also the result as `diagnose` writes it.

    Parameters
    ----------
    folder : as given to `make_bench`.
    capture_set : one of `GIVEN`.
    """
    declared = InstrumentModel.load(configs / "instruments" / truth.instrument)
    captures = [folder / truth.name / f"{name}.h5" for name in GIVEN[capture_set]]
    begin = time.perf_counter()
    result, corrected, corrects = _diagnosed(captures, declared)
    seconds = time.perf_counter() - begin
    base = folder / "truth" / truth.name
    coverage = coverage_of(base / f"{VALIDATION}_noisy.h5", corrected, _truth(base, VALIDATION))
    judgement = BenchJudgement(
        name=truth.name,
        group=truth.group,
        given=capture_set,
        verdict=result["verdict"],
        seconds=round(seconds, 2),
        declared=_error(base, VALIDATION, declared),
        corrected=_error(base, VALIDATION, corrected),
        oracle=float("nan"),
        own={name: (_error(base, name, declared), _error(base, name, corrected)) for name in GIVEN[capture_set]},
        coverage_pixels=coverage.pixels,
        coverage_patches=coverage.patches,
        written=corrects,
        causes=names_of(result, truth, GIVEN[capture_set]),
        matters=matters_of(result, truth, GIVEN[capture_set]),
        wiring=wiring_of(result, truth),
        noise=str((result.get("noise") or {}).get("verdict", "")),
        left_out=tuple(result.get("left_out") or ()),
    )
    return judgement, result


def _diagnosed(captures: Sequence[Path], declared: InstrumentModel) -> tuple[dict[str, Any], InstrumentModel, bool]:
    """The result as JSON has it, the instrument as it is written and read again, and whether it is another one."""
    try:
        judgement, _ = diagnose_captures(captures, declared)
    except Exception as error:  # noqa: BLE001 - a crash is a wrong answer of this bench, not the end of the suite
        return {"verdict": f"crashed: {type(error).__name__}: {error}", "effects": []}, declared, False
    diagnosis = judgement.diagnosis
    corrected = declared
    if diagnosis.corrects or diagnosis.systematic():
        with TemporaryDirectory() as folder:
            write_instrument(Path(folder) / "new.yaml", declared, diagnosis)
            corrected = InstrumentModel.load(Path(folder) / "new.yaml")
    return json.loads(diagnosis.model_dump_json()), corrected, diagnosis.corrects


def _truth(away: Path, capture: str) -> Any:
    return np.load(away / f"{capture}.npy").astype(float)


def _error(away: Path, capture: str, model: InstrumentModel) -> float:
    return error_of(away / f"{capture}.h5", model, _truth(away, capture))
