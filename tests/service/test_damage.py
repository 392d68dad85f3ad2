"""Stores that were damaged or may not be written: refused in one line, and the way on that the line names works."""

from __future__ import annotations

import os
import shutil
import sqlite3
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import halls
import pytest
from commands import one_line, run
from halls import asked
from test_store import batch, residual

from servoscope.core.errors import StoreError
from servoscope.service.store import Store
from servoscope.service.store.queries import query_history


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


@pytest.mark.parametrize("status", ["{}", "[]", "3", '{"verdict": "fault", "residual": 5}'])
def test_a_status_that_is_none_is_refused_in_one_line(sound: Path, tmp_path: Path, status: str) -> None:
    config = damaged(sound, tmp_path, f"UPDATE checkpoints SET status = '{status}' WHERE asset = 'press'")
    one_line(run("watch", config, "--once"), "holds a damaged status", "restore a backup")


@pytest.mark.parametrize("name", ["press", "hall"])
def test_a_torn_state_is_replaced_for_good(sound: Path, tmp_path: Path, name: str) -> None:
    config = damaged(sound, tmp_path, f"UPDATE checkpoints SET state = x'00' WHERE asset = '{name}'")
    if name == "hall":  # an asset's is left out
        one_line(run("run", config), f"{name}: its saved state is torn", f"--anew {name}")
    assert run("run", config, "--anew", name).code == 0  # all recordings have ended: not a block comes
    assert run("run", config).code == 0
    assert asked(config, "SELECT asset FROM audit WHERE what = 'began anew'") == [(name,)]


def said_by_nobody(action: Callable[[], object]) -> str:
    """Return what an action comes to, or its error, in a process that is not the administrator's."""
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        try:
            os.seteuid(os.geteuid() or 65534)
            os.write(writing, str(action()).encode())
        except StoreError as error:
            os.write(writing, str(error).encode())
        finally:
            os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as answer:
        said = answer.read()
    os.waitpid(child, 0)
    return said


@pytest.fixture
def protected() -> Iterator[Path]:
    """The folder of a store in which nobody may make a file."""
    folder = Path(tempfile.mkdtemp())
    made = Store.open("history.sqlite", folder, write=True)
    made.write(batch(residual(1, 0.0)), "hall", 1)
    made.close()
    folder.chmod(0o555)
    yield folder
    folder.chmod(0o755)
    shutil.rmtree(folder)


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")  # the child starts nothing
def test_a_copy_that_nobody_may_write_is_read_all_the_same(protected: Path) -> None:
    def numbers() -> list[int]:
        return [row["number"] for row in query_history(Store.open("history.sqlite", protected), "residuals")]

    def command() -> int:
        return Store.open("history.sqlite", protected).add_command("me", "press", "fault", "acknowledge")

    assert said_by_nobody(numbers) == "[1]"
    refused = said_by_nobody(command), said_by_nobody(lambda: Store.open("history.sqlite", protected, write=True))
    assert all("must be ones that servoscope may write to" in said for said in refused)


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_copy_without_its_log_is_not_taken_for_whole(protected: Path) -> None:
    """What is in the log of SQLite alone would be missing, and nobody would know."""
    protected.chmod(0o755)
    (protected / "history.sqlite-wal").write_bytes(bytes(32))
    protected.chmod(0o555)
    said = said_by_nobody(lambda: Store.open("history.sqlite", protected))
    assert "its folder must be one that servoscope may write to" in said
