"""What is said must not hang on the last bits of u and y, nor on the processor that computes with them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from studies.last_bits import MACHINES, judged


@pytest.mark.parametrize("name", ["rig, multisine", "axis, fed forward", "cylinder"])
def test_a_billionth_of_u_and_y_changes_nothing_that_is_said(name: str) -> None:
    found = judged(MACHINES[name](), recordings=2, seed=2, moves=1)
    assert len(found) == 2
    assert {words: said for words, said in found if said} == {}


def test_another_processor_computes_with_other_paths(project: Path) -> None:
    """A feature that this build of NumPy does not know would be a warning, which is an error in tests."""
    found = "__cpu_dispatch__ as d, __cpu_features__ as f"
    shown = f"from numpy._core._multiarray_umath import {found}; print(*(f[x] for x in d))"
    command = [
        sys.executable,
        str(project / "scripts" / "other_processor.py"),
        sys.executable,
        "-W",
        "error",
        "-c",
        shown,
    ]
    ran = subprocess.run(command, capture_output=True, text=True, check=True, env=dict(os.environ))
    assert "True" not in ran.stdout.splitlines()[-1]
