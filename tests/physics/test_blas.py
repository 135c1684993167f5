"""BLAS keeps to one thread where the program computes, whoever calls it."""

import os
import subprocess
import sys

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from processing import InstrumentModel, diagnose_captures
from processing.computing.blas import one_blas_thread
from processing.storage.captures.capture import CaptureError


def _blas_threads():
    return {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}


def test_one_thread_within_and_as_before_after():
    with threadpool_limits(limits=2, user_api="blas"):
        with one_blas_thread():
            assert _blas_threads() == {1}
        assert _blas_threads() == {2}


def test_whoever_leaves_first_does_not_take_the_limit_from_others():
    """Two tasks of a cluster in one process: the first to end left the other with the threads of the machine."""
    with threadpool_limits(limits=2, user_api="blas"):
        first, second = one_blas_thread(), one_blas_thread()
        first.__enter__()
        second.__enter__()
        first.__exit__(None, None, None)
        assert _blas_threads() == {1}
        second.__exit__(None, None, None)
        assert _blas_threads() == {2}


def test_scipy_s_own_blas_is_not_loaded_for_it_and_is_held_too_where_it_comes():
    """To load SciPy took a fifth of a second of every command, needed or not."""
    code = """
import os, sys
from threadpoolctl import threadpool_info, threadpool_limits
import numpy
from processing.computing.blas import one_blas_thread
threads = lambda: {pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "blas"}
threadpool_limits(limits=2, user_api="blas")
with one_blas_thread():
    print("scipy.linalg" in sys.modules, threads())
    import scipy.linalg
    print(threads())
print(threads(), os.environ["OPENBLAS_NUM_THREADS"])
"""
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "2"}
    process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert process.stdout.splitlines() == ["False {1}", "{1}", "{2} 2"]


def test_a_diagnosis_called_from_python_holds_blas_to_one_thread(configs, tmp_path):
    threads = []
    model = InstrumentModel.load(configs / "instruments/rgb950.yaml")
    with threadpool_limits(limits=2, user_api="blas"), pytest.raises(CaptureError):
        diagnose_captures([tmp_path / "missing.h5"], model, lambda line: threads.append(_blas_threads()))
    assert threads == [{1}]
