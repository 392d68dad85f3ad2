"""Files that name another file: nothing of it is in any answer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from commands import run
from hostile.other_files import FORMATS, leaked, other_files

from servoscope.core.errors import RecordingError
from servoscope.signals.readers import formats, mat, mdf_tdms, programs
from servoscope.web.jobs.tasks import preview_file

SUFFIXES = {
    **{
        "CSV": "csv",
        "Parquet": "parquet",
        "MAT 7.3": "mat",
        "MDF": "mf4",
        "TDMS": "tdms",
        "HDF5": "h5",
        "Excel": "xlsx",
    },
    **{"LVM": "lvm", "gzip": "csv.gz", "ZIP": "zip"},
}
# in this process, so that nothing but the reader itself keeps them from the other file
OPENERS: dict[str, Callable[[Path], Any]] = {
    "MAT 7.3": mat.open_mat,
    "HDF5": mat.open_hdf5,
    "MDF": mdf_tdms.open_mdf,
    "TDMS": mdf_tdms.open_tdms,
    "Excel": programs.open_sheet,
    "LVM": programs.open_lvm,
}


def answer(ask: Callable[[], object]) -> str:
    try:
        return str(ask())
    except RecordingError as error:
        return str(error)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.filterwarnings("ignore")  # of libraries, about odd files
def test_nothing_of_another_file_is_in_any_answer(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / f"{kind.replace(' ', '-')}.{SUFFIXES[kind]}"
    touched: list[str] = []
    read_bytes = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda self: touched.append(self.name) or read_bytes(self))  # type: ignore[func-returns-value]

    def cells() -> list[object]:
        opened = OPENERS.get(kind, formats.open_file)(path)
        tables = opened.iter_chunks(opened.columns)
        return [opened, *({name: column.to_pylist() for name, column in one.columns.items()} for one in tables)]

    for content in other_files(kind, tmp_path):
        path.write_bytes(content)
        touched.clear()
        answers = [answer(cells), answer(lambda: preview_file(lambda _: None, path.name))]
        assert "secret.bin" not in touched
        told = run("inspect", path, "--json")
        answers += [told.out, told.err]
        assert not any(map(leaked, answers)), answers
        if kind in ("HDF5", "MAT 7.3"):
            assert "lies in another file, which is not read" in answers[0]


def test_the_secret_would_be_seen() -> None:
    assert all(map(leaked, ("... SeCrEt7!", "[83.0, 101.0, 67.0, 114.0]", "y: 1.14642e-148")))
