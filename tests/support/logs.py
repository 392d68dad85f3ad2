"""Writes one small log as every kind of file, and says what must come out when it is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoscope.core.arrays import FloatArray
from servoscope.core.errors import ServoscopeError
from servoscope.models.loop import Loop
from servoscope.signals import Recording
from servoscope.signals.readers import read


def signals(samples: int = 300) -> dict[str, FloatArray]:
    t = np.round(np.arange(samples) * 0.01, 4)
    r = np.round(0.05 * np.sin(3.0 * t), 6)
    y = np.round(0.05 * np.sin(3.0 * (t - 0.02)), 6)
    return {"t": t, "r": r, "u": np.round(20.0 * (r - y) + 0.1 * np.cos(t), 6), "y": y}


def lines(delimiter: str = ",", decimal: str = ".", header: bool = True, **change: Any) -> list[str]:
    data = signals() | change
    rows = [delimiter.join(str(cell) for cell in row) for row in zip(*data.values(), strict=True)]
    rows = [row.replace(".", decimal) for row in rows]
    return [delimiter.join(data), *rows] if header else rows


def written(folder: Path, rows: list[str], name: str = "x.csv", encoding: str = "utf-8") -> Path:
    path = folder / name
    path.write_text("\n".join(rows) + "\n", encoding=encoding)
    return path


def as_expected(recording: Recording) -> None:
    for key, x in signals().items():
        np.testing.assert_allclose(getattr(recording, key), x, atol=1e-9)
    assert recording.defects == ()


def refusal(path: Path, loop: Loop | None = None, **settings: Any) -> str:
    with pytest.raises(ServoscopeError) as caught:
        read(path, loop, **settings)
    text = str(caught.value)
    assert path.name in text
    assert "\n" not in text
    return text


def parquet(folder: Path, data: dict[str, Any]) -> Path:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table(data), folder / "x.parquet")
    return folder / "x.parquet"


def mat5(folder: Path, data: dict[str, Any]) -> Path:
    import scipy.io

    scipy.io.savemat(folder / "x.mat", data)
    return folder / "x.mat"


def mat73(folder: Path, data: dict[str, Any]) -> Path:
    import h5py

    with h5py.File(folder / "x.mat", "w", userblock_size=512) as file:
        for name, x in data.items():
            file[name] = np.asarray(x).reshape(1, -1)
        file["note"] = np.frombuffer("ok".encode("utf-16-le"), dtype=np.uint16).reshape(-1, 1)
        file["note"].attrs["MATLAB_class"] = np.bytes_("char")
    content = (folder / "x.mat").read_bytes()
    (folder / "x.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + content[512:])
    return folder / "x.mat"


GERMAN_RATE = 200.0


def german_axis(path: Path) -> Path:
    """Write a log of a mass of 2 with viscous and dry friction, moved along four sines; names in German, ms and mm."""
    t = np.arange(0.0, 60.0, 1.0 / GERMAN_RATE)
    rng = np.random.default_rng(3)
    w = 2.0 * np.pi * np.array([0.2, 0.7, 1.9, 3.7])
    a = np.array([0.05, 0.02, 0.008, 0.003])
    y = (a[:, None] * np.sin(w[:, None] * t)).sum(axis=0)
    v = ((a * w)[:, None] * np.cos(w[:, None] * t)).sum(axis=0)
    acceleration = -((a * w**2)[:, None] * np.sin(w[:, None] * t)).sum(axis=0)
    u = 2.0 * acceleration + 3.0 * v + 0.4 * np.sign(v) + 0.1 + 0.01 * rng.standard_normal(t.size)
    r = y + 1e-3 * v
    rows = np.column_stack([1e3 * t, 1e3 * r, u, 1e3 * (y + 2e-6 * rng.standard_normal(t.size))])
    lines = ["Achse 7, nach der Wartung", "Zeit;Sollposition;Drehmoment;Istposition", "ms;mm;Nm;mm"]
    lines += [";".join(f"{cell:.6f}".replace(".", ",") for cell in row) for row in rows]
    path.write_text("\n".join(lines), encoding="utf-8")
    return path
