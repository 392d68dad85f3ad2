"""Arrays of joints: each that moves has columns of its own, those at rest are told, and no two are mixed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from commands import run

from servoscope.core.arrays import FloatArray
from servoscope.learning.proposal import propose_columns
from servoscope.models.loop import Loop
from servoscope.signals.readers import list_channels
from servoscope.signals.readers.axes import find_axes, moving_axes
from servoscope.simulation import simulate, tutorial

# r, u and y as logs of arms have them
NAMES = [
    ("q_cmd", "tau_measured", "q"),
    ("target_q", "target_current", "actual_q"),
    ("desired_position", "effort", "position"),
    ("goal_pos", "present_current", "present_pos"),
]


def joint(rows: int, seed: int) -> dict[str, FloatArray]:
    recording, _ = simulate(Loop.from_dict(tutorial.AXIS), tutorial.motion(seed), noise_u_std=0.02, noise_y_std=5e-6)
    return {name: getattr(recording, name)[:rows] for name in "ruy"}


def written(path: Path, names: tuple[str, str, str], moving: set[int], noise: float, joints: int, rows: int) -> Path:
    """Write an array per signal, of joints of which some move and the others hold their place."""
    rng = np.random.default_rng(5)
    arrays = {name: np.full((rows, joints), 0.1) for name in names}
    for k in range(joints):
        for name, x in zip(names, joint(rows, 1 + k).values(), strict=True):
            arrays[name][:, k] = x if k in moving else 0.1
            if k not in moving and name != names[0]:
                arrays[name][:, k] += noise * rng.standard_normal(rows)
    np.savez(path, time=np.arange(rows) / tutorial.SAMPLE_RATE, temperature=np.full((rows, joints), 25.0), **arrays)
    return path


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("noise", [0.0, 1e-5])
@pytest.mark.parametrize(("joints", "moving"), [(3, {0}), (3, {2}), (6, {1, 4}), (7, set(range(7)))])
def test_columns_are_those_of_one_joint_that_moves(
    names: tuple[str, str, str], noise: float, joints: int, moving: set[int], tmp_path: Path
) -> None:
    channels = list_channels(written(tmp_path / "arm.npz", names, moving, noise, joints, 200))
    assert set(moving_axes(channels)) == {str(k) for k in moving}
    for k in [None, *map(str, sorted(moving))]:
        columns = propose_columns(tmp_path / "arm.npz", channels, k)
        wanted = min(moving) if k is None else k
        found = (columns.reference, columns.input, columns.output)
        assert found == tuple(f"{name}[{wanted}]" for name in names)
    given = propose_columns(tmp_path / "arm.npz", channels, given=f"u={names[1]}[{max(moving)}]")
    assert given.output == f"{names[2]}[{max(moving)}]"


def test_a_loop_file_for_each_joint_that_moves(tmp_path: Path) -> None:
    log = written(tmp_path / "arm.npz", NAMES[0], {0, 2}, 1e-5, 3, 6000)
    made = run("init", log, "-o", tmp_path / "loop.toml", "--yes")
    assert made.code == 0 and "at rest, without a loop file: 1" in made.out
    assert sorted(path.name for path in tmp_path.glob("*.toml")) == ["loop-0.toml", "loop-2.toml"]
    listed = run("inspect", log).out
    assert "axes that move: 0, 2" in listed
    assert len({k for k in re.findall(r"(?:q_cmd|tau_measured|q)\[(\d)\]", listed.split("--columns")[1])}) == 1


def test_many_numbers_are_no_axes() -> None:
    assert len(find_axes([f"{name}[{k}]" for k in range(32) for name in NAMES[0]])) == 32
    assert find_axes([f"{name}[{k}]" for k in range(33) for name in NAMES[0]]) == {}
