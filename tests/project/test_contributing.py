"""The recipe "Add an estimator" of CONTRIBUTING.md, followed step by step in a copy of the project."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

# steps 1 and 3: the file, an exception, and its reason
ESTIMATOR = '''"""Adaptive Kalman filter whose P stays at P_d: one gain matrix."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit import sum_products
from servoscope.estimation.update import Matrix, Numbers, Update

NAME = "fixed-gain"
NEEDS_INSTRUMENT = False
EXCEPTIONS = {
    "contracts": "P is not used: it stays what it was at the start, P_d in a recursion",
    "converges": "its gain is small in the directions in which P_d is: they take longer than the check waits",
}


def update(
    theta: Numbers, P: Matrix, P_d: Matrix, R: Any, memory: Any, eta: Any, phi: Numbers, z: Numbers, extra: Any
) -> Update:
    """Take one step K = P_d phi/(R + phi' P_d phi)."""
    g = [sum_products(row, phi) for row in P_d]
    e, denominator = sum_products([-x for x in phi], theta, eta), sum_products(phi, g, R)
    K = [x / denominator for x in g]
    return Update([x + gain * e for x, gain in zip(theta, K, strict=True)], P, K)
'''
# step 4: the obvious version
NAIVE = """

def fixed_gain(theta, P, P_d, R, eta, phi, z, memory, past):
    K = P_d @ phi / (R + phi @ P_d @ phi)
    return theta + K * (eta - phi @ theta), P, K


UPDATES["fixed-gain"] = fixed_gain
"""


@pytest.mark.slow
def test_a_new_estimator_is_checked_like_its_siblings(project: Path, tmp_path: Path) -> None:
    for folder in ("src", "tests", "benchmarks"):
        ignored = shutil.ignore_patterns("__pycache__", "golden")
        shutil.copytree(project / folder, tmp_path / folder, ignore=ignored)
    shutil.copy(project / "pyproject.toml", tmp_path)
    (tmp_path / "src/servoscope/estimation/estimators/fixed_gain.py").write_text(ESTIMATOR)
    with (tmp_path / "tests/support/naive.py").open("a") as file:
        file.write(NAIVE)

    def check(which: str) -> str:
        environment = {**os.environ, "PYTHONPATH": str(tmp_path / "src"), "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
        files = "tests/estimation/test_estimators.py", "tests/estimation/test_estimator_peers.py::TestInTheRecursion"
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *files, "-k", which]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        return done.stdout + done.stderr

    output = check("fixed-gain or names")
    assert "15 passed" in output.splitlines()[-1], output  # ten checks, four in the recursion, and the names
    # an exception that is missing fails, and one that is not needed
    wrong = ESTIMATOR.replace('"contracts":', '"textbook":')
    (tmp_path / "src/servoscope/estimation/estimators/fixed_gain.py").write_text(wrong)
    output = check("fixed-gain and (contracts or textbook)")
    assert "2 failed" in output.splitlines()[-1], output
