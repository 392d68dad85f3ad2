"""Files that claim more values than files of their size hold are refused before these are read, whatever the format."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.feather as pf
import pyarrow.parquet as pq
import pytest
import scipy.io

from servoscope.core.errors import RecordingError
from servoscope.signals.readers import list_channels, reader_process, table

ROWS = 60_000
ZEROS = dict.fromkeys("truy", np.zeros(ROWS))


def write_hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        for name in ZEROS:  # nothing is written: a file of a few kilobytes
            file.create_dataset(name, (ROWS,), "f8", chunks=(1000,), compression="gzip")


def write_sheet(path: Path) -> None:
    xlsxwriter = pytest.importorskip("xlsxwriter")
    with xlsxwriter.Workbook(path) as book:
        sheet = book.add_worksheet()
        sheet.write_row(0, 0, list("truy"))
        for row in range(1, 4000):
            sheet.write_row(row, 0, (0, 0, 0, 0))


def write_mdf(path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF() as file:
        t = np.arange(ROWS) / 100.0
        file.append([asammdf.Signal(np.zeros(ROWS), t, name=name) for name in "ruy"])
        file.save(path, overwrite=True, compression=2)


WRITERS: dict[str, Callable[[Path], None]] = {
    "a.h5": write_hdf5,
    "a73.mat": write_hdf5,
    "a5.mat": lambda path: scipy.io.savemat(path, ZEROS, do_compression=True),
    "a.npz": lambda path: np.savez_compressed(path, **ZEROS),
    "a.npy": lambda path: path.write_bytes(
        b"\x93NUMPY\x01\x00v\x00" + b"{'descr': '<f8', 'fortran_order': False, 'shape': (60000, 4)}".ljust(117) + b"\n"
    ),
    "a.feather": lambda path: pf.write_feather(pa.table(ZEROS), path, compression="zstd"),
    "a.parquet": lambda path: pq.write_table(pa.table(ZEROS), path),
    "a.xlsx": write_sheet,
    "a.mf4": write_mdf,
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_claims_too_much_is_refused(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / name
    WRITERS[name](path)
    monkeypatch.setattr(reader_process, "_is_inside", True)  # the limits below are of this process
    if name != "a.npy":  # which is damaged besides
        assert len(list_channels(path)) >= 4
    monkeypatch.setattr(table, "MIN_UNPACKED_LIMIT_BYTES", 10_000)
    monkeypatch.setattr(table, "MAX_UNPACKED_RATIO", 2)
    with pytest.raises(RecordingError, match=rf"{name}: claims .* MB, and a file of its size has at most"):
        list_channels(path)
