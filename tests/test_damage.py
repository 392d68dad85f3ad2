"""Stores that were damaged: refused in one line, and the way on that the line names works."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest

import halls
from commands import one_line, run
from halls import asked


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A service file whose service has run to the end of its recordings."""
    folder = tmp_path_factory.mktemp("sound")
    halls.files(folder)
    config = halls.hall(folder, "hall")
    assert run("run", config).code == 0
    return config


def damaged(sound: Path, folder: Path, change: str) -> Path:
    shutil.copytree(sound.parent, folder / "hall")
    with sqlite3.connect(folder / "hall" / "hall.sqlite") as store:
        store.execute(change)
    return folder / "hall" / "hall.toml"


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("DROP TABLE outbox", "its table outbox is missing, restore it from a copy"),
        ("DELETE FROM meta WHERE key = 'schema'", "does not say of which version its tables are"),
        ("UPDATE meta SET value = 0 WHERE key = 'schema'", "does not say of which version its tables are"),
        ("UPDATE meta SET value = 99 WHERE key = 'schema'", "its tables are of version 99"),
        ("UPDATE checkpoints SET status = '{\"a\":'", "a document in it is torn"),
    ],
)
def test_a_store_that_is_not_whole_is_refused(sound: Path, tmp_path: Path, change: str, said: str) -> None:
    config = damaged(sound, tmp_path, change)
    one_line(run("run", config), "hall.sqlite: ", said)
    one_line(run("watch", config, "--once"), "hall.sqlite: ", said)


@pytest.mark.parametrize("name", ["press", "hall"])
def test_a_torn_state_is_replaced_for_good(sound: Path, tmp_path: Path, name: str) -> None:
    config = damaged(sound, tmp_path, f"UPDATE checkpoints SET state = x'00' WHERE asset = '{name}'")
    one_line(run("run", config), f"{name}: its saved state is torn", f"--anew {name}")
    assert run("run", config, "--anew", name).code == 0  # all recordings have ended: not a block comes
    assert run("run", config).code == 0
    assert asked(config, "SELECT asset FROM audit WHERE what = 'began anew'") == [(name,)]
