"""Readers and plants of other packages: the recipes of CONTRIBUTING.md, followed to the letter."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browsing import Served
from commands import run
from dirty import signals

from servoscope.core import messages
from servoscope.core.errors import LoopError, RecordingError
from servoscope.core.messages import catalogue, translate
from servoscope.learning.learn import nominal_baseline
from servoscope.models.loop import Loop
from servoscope.models.plants import parse_plant, plant_kinds
from servoscope.signals import readers, writers
from servoscope.signals.cleanup import clean
from servoscope.simulation import FaultEvent, reference, simulate

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
    faults = property(
        lambda self: (
            Fault("friction", "b", (0.5, 20.0), "the bearing is dry", "bearing: grease, noise"),
            Fault("added_disc", "J", (0.2, 5.0), "the wheel is heavier", "screws of the disc"),
        )
    )
    translations = {
        "de": {
            "the bearing is dry": "das Lager ist trocken",
            "bearing: grease, noise": "Lager: Fett, Laufgeräusch",
            "added_disc": "Zusatzscheibe",
            "the wheel is heavier": "das Rad ist schwerer",
            "screws of the disc": "Schrauben der Scheibe",
        }
    }

    def theta(self):
        return np.array([self.b, self.J])

    def scaled(self, factors):
        return self.model_copy(update={name: getattr(self, name) * factor for name, factor in factors.items()})

    def state_space(self):
        A = np.array([[0.0, 1.0], [0.0, -self.b / self.J]])
        return A, np.array([[0.0], [1.0 / self.J]]), np.array([[1.0, 0.0]])
'''
WHEEL = {"name": "wheel", "sample_rate": 100.0, "plant": {"kind": "motor", "J": 2.0, "b": 3.0}}
CONTROL = {"kind": "pi", "k_p": 40.0, "k_i": 20.0}


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


@pytest.fixture
def motors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path with the package of a plant."""
    install(tmp_path, "my_plants", PLANT, "[servoscope.plants]\nmotor = my_plants:Motor\n", monkeypatch)
    catalogue.cache_clear()
    yield tmp_path
    monkeypatch.undo()
    catalogue.cache_clear()


def test_a_plant_of_another_package_is_the_plant_of_a_loop(motors: Path) -> None:
    assert "motor" in plant_kinds()
    loop = Loop.from_dict(WHEEL)
    assert loop.plant.theta().tolist() == [3.0, 2.0]
    assert loop.plant.with_ratios({"b": 2.0}).theta().tolist() == [6.0, 2.0]
    A, B, C = loop.plant.state_space()
    s = 2.0j
    assert (C @ np.linalg.solve(s * np.eye(2) - A, B)).item() == pytest.approx(1.0 / (3.0 * s + 2.0 * s**2))
    with pytest.raises(LoopError, match="J"):
        Loop.from_dict({**WHEEL, "plant": {"kind": "motor", "b": 3.0}})


def test_a_plant_of_no_package_is_refused_and_a_broken_package_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(LoopError, match="unknown, choose from"):
        parse_plant(WHEEL["plant"])
    install(tmp_path, "no_plants", "import nothing_like_it", "[servoscope.plants]\nmotor = no_plants:M\n", monkeypatch)
    with pytest.raises(LoopError, match="its package is broken, repair or remove it"):
        parse_plant(WHEEL["plant"])
    catalogue.cache_clear()
    assert translate("leakage", "de") == "innere Leckage"


@pytest.fixture
def turned(motors: Path) -> Path:
    """The folder with a baseline of a wheel, and a recording whose bearing runs dry."""
    loop = Loop.from_dict({**WHEEL, "controller": CONTROL})
    nominal_baseline(loop).save(motors / "wheel.json")
    r = 10.0 * reference("multisine", 60.0, loop.sample_rate)
    fault = FaultEvent.parse("friction=1.5@30")
    recording, _ = simulate(loop, r, faults=[fault], seed=1)
    writers.write_recording(motors / "dry.csv", recording)
    return motors


@pytest.mark.parametrize(
    ("language", "name", "meaning", "checks", "other"),
    [
        ("en", "friction", "the bearing is dry", "bearing: grease, noise", "the wheel is heavier"),
        ("de", "Reibung", "das Lager ist trocken", "Lager: Fett, Laufgeräusch", "das Rad ist schwerer"),
    ],
)
def test_the_words_of_a_plant_of_another_package_reach_the_reader(
    turned: Path,
    monkeypatch: pytest.MonkeyPatch,
    language: str, name: str, meaning: str, checks: str, other: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(messages, "LANGUAGE", language)
    shown = run("diagnose", turned / "wheel.json", turned / "dry.csv", "--report", turned / "dry.html")
    assert shown.code == 3
    text = " ".join(shown.out.split())
    first = checks[:1].upper() + checks[1:]
    assert name in text and first in text and "rod seal" not in text and "Stangendichtung" not in text
    page = " ".join((turned / "dry.html").read_text(encoding="utf-8").split())
    assert meaning.capitalize() in page.replace(meaning, meaning.capitalize()) and first in page
    said = run("diagnose", turned / "wheel.json", turned / "dry.csv", "--json")
    assert any(checks in words for words in json.loads(said.out)["checks"])
    assert translate("the wheel is heavier", language) == other


def test_the_pages_know_the_words_of_a_plant_of_another_package(turned: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (turned / "hall.toml").write_text(
        'name = "hall"\n[service]\nlisten = ""\nlog = "error"\n[store]\nurl = "hall.sqlite"\n'
        '[web]\nlisten = "127.0.0.1:0"\n[diagnosis]\nwindow_s = 40.0\nevery_s = 30.0\n'
        '[sources.line]\nkind = "replay"\nspeed = 0.0\n'
        '[assets.wheel]\nbaseline = "wheel.json"\nsource = "line"\nfiles = ["dry.csv"]\n',
        encoding="utf-8",
    )
    monkeypatch.setenv("PYTHONPATH", str(turned))  # of the processes that diagnose and serve
    # in a process of its own, whose reading process knows the package: that of these tests may be older than it
    subprocess.run([sys.executable, "-m", "servoscope", "run", "hall.toml"], cwd=turned, check=True)
    with Served(turned, "serve", "hall.toml") as served, served.client(headers={"Accept-Language": "de"}) as client:
        asset = client.get("/assets/wheel").raise_for_status().json()
        words = client.get(f"{served.url}/static/language.js").raise_for_status().text
    assert "the bearing is dry" in json.dumps(asset)
    assert '"the bearing is dry": "das Lager ist trocken"' in words and '"added_disc": "Zusatzscheibe"' in words
