"""Readers and plants of other packages: the recipes of CONTRIBUTING.md, followed to the letter."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dirty import signals

from servoscope.core.errors import LoopError, RecordingError
from servoscope.models.loop import Loop
from servoscope.models.plants import parse_plant, plant_kinds
from servoscope.signals import readers, writers
from servoscope.signals.cleanup import clean

READER = '''
"""Reads .rec files: a line of names, then raw doubles, row by row."""

import numpy as np

from servoscope.core.errors import RecordingError
from servoscope.signals.readers.table import Table, TableFile


def open_rec(path):
    import pyarrow as pa

    with path.open("rb") as file:
        names, start = file.readline().decode().split(), file.tell()
    if (path.stat().st_size - start) % (8 * len(names)):
        raise RecordingError(f"{path}: is cut off, record it again")
    rows = np.fromfile(path, offset=start).reshape(-1, len(names))

    def read(wanted, texts):
        for first in range(0, len(rows), 700):
            chunk = rows[first : first + 700]
            columns = {name: pa.chunked_array([chunk[:, names.index(name)]]) for name in wanted}
            yield Table(path.name, columns, first + 1)

    return TableFile(path, tuple(names), read)
'''

PLANT = '''
"""A motor that turns a wheel: u = J y'' + b y'."""

from typing import Literal

import numpy as np

from servoscope.models.plants import Fault, Plant


class Motor(Plant):
    kind: Literal["motor"] = "motor"
    J: float
    b: float

    names = property(lambda self: ("b", "J"))
    powers = property(lambda self: (1, 2))
    has_physics = property(lambda self: True)
    faults = property(lambda self: (Fault("dry bearing", "b", (0.5, 20.0), "the bearing is dry"),))

    def theta(self):
        return np.array([self.b, self.J])

    def scaled(self, factors):
        return self.model_copy(update={name: getattr(self, name) * factor for name, factor in factors.items()})

    def state_space(self):
        A = np.array([[0.0, 1.0], [0.0, -self.b / self.J]])
        return A, np.array([[0.0], [1.0 / self.J]]), np.array([[1.0, 0.0]])
'''


def install(folder: Path, module: str, text: str, entry_point: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a package with one entry point on the path, as an installer leaves it."""
    (folder / f"{module}.py").write_text(text, encoding="utf-8")
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n", encoding="utf-8")
    (info / "entry_points.txt").write_text(entry_point, encoding="utf-8")
    monkeypatch.syspath_prepend(folder)


def test_a_reader_of_another_package_reads_what_a_csv_file_gives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = signals()
    recording = clean(**data, sample_rate=100.0)
    writers.write_recording(tmp_path / "log.csv", recording)
    path = tmp_path / "log.rec"
    path.write_bytes(b"t r u y\n" + np.stack([data[key] for key in "truy"], axis=1).tobytes())
    with pytest.raises(RecordingError, match=r"unknown kind of file '\.rec'"):
        readers.read(path)
    install(tmp_path, "my_reader", READER, "[servoscope.readers]\nrec = my_reader:open_rec\n", monkeypatch)
    assert ".rec" in readers.readable_suffixes()
    found, expected = readers.read(path), readers.read(tmp_path / "log.csv")
    for column, other in zip(found.columns, expected.columns, strict=True):
        np.testing.assert_allclose(column, other, rtol=0.0, atol=1e-12)
    assert [channel.name for channel in readers.list_channels(path)] == ["t", "r", "u", "y"]
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(RecordingError, match="is cut off, record it again") as caught:
        readers.read(path)
    assert "\n" not in str(caught.value)


def test_a_plant_of_another_package_is_the_plant_of_a_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LoopError, match="unknown, choose from"):
        parse_plant({"kind": "motor", "J": 2.0, "b": 3.0})
    install(tmp_path, "my_plants", PLANT, "[servoscope.plants]\nmotor = my_plants:Motor\n", monkeypatch)
    assert "motor" in plant_kinds()
    loop = Loop.from_dict({"name": "wheel", "sample_rate": 100.0, "plant": {"kind": "motor", "J": 2.0, "b": 3.0}})
    assert loop.plant.theta().tolist() == [3.0, 2.0]
    assert loop.plant.with_ratios({"b": 2.0}).theta().tolist() == [6.0, 2.0]
    A, B, C = loop.plant.state_space()
    s = 2.0j
    assert (C @ np.linalg.solve(s * np.eye(2) - A, B)).item() == pytest.approx(1.0 / (3.0 * s + 2.0 * s**2))
    with pytest.raises(LoopError, match="J"):
        Loop.from_dict({"name": "wheel", "sample_rate": 100.0, "plant": {"kind": "motor", "b": 3.0}})
