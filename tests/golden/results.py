"""What servoscope makes of the files in this folder, by its public names and its command line alone."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import shutil
import sqlite3
import struct
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.linalg

import servoscope as ss
from servoscope.cli.exit import RAN

FOLDER = Path(__file__).parent
THIN = 60  # every so many evaluations are kept as numbers, all of them in the digest
ESTIMATORS = ("akf", "iv-akf", "kf", "rls", "dfrls", "rls-reset", "nlms", "sliding-window")
COMMANDS = {
    "inspect": ("inspect", "suspect.parquet", "--loop", "rig.toml", "--json"),
    "inspect-axis": ("inspect", "axis.parquet", "--loop", "axis.toml", "--json"),
    "learn": ("learn", "OUT/rig.toml", "healthy.parquet", "-o", "OUT/rig.json", "--json"),
    "diagnose": ("diagnose", "rig.json", "healthy.parquet", "suspect.parquet", "--json"),
    "diagnose-axis": ("diagnose", "axis.json", "axis-suspect.parquet", "--json"),
    "diagnose-points": ("diagnose", "points.json", "worn.parquet", "--point", "cold", "--json"),
}
TABLES = {
    "residuals": "SELECT * FROM residuals ORDER BY asset, number",
    "diagnoses": "SELECT * FROM diagnoses ORDER BY asset, number",
    "transitions": "SELECT * FROM transitions WHERE asset <> 'hall' ORDER BY asset, number",
    "checkpoints": "SELECT asset, sequence, status FROM checkpoints WHERE asset <> 'hall' ORDER BY asset",
}
STATES = "SELECT asset, state FROM checkpoints WHERE asset <> 'hall' ORDER BY asset"
SERVICE = """
name = "hall"
[service]
listen = ""
commit_every_s = 0.01
log = "error"
[store]
residual_every_s = 2.0
[diagnosis]
window_s = 20.0
every_s = 30.0
[sources.line]
kind = "replay"
speed = 0.0
block = 0.5
start = 2026-01-01T00:00:00Z
[assets.press]
baseline = "rig.json"
source = "line"
files = ["suspect.parquet"]
[assets.lift]
baseline = "rig.json"
source = "line"
files = ["healthy.parquet"]
"""


def command(folder: Path, *words: str, told: str = "") -> str:
    """Run ``servoscope`` in a folder, with some lines on its standard input; return what it prints."""
    sources = str(Path(ss.__file__).parents[1])
    environment = os.environ | {"PYTHONPATH": sources, "COLUMNS": "80"}
    done = subprocess.run(
        [sys.executable, "-m", "servoscope", *words],
        cwd=folder,
        env=environment,
        input=told,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode in RAN, f"{' '.join(words)}: {done.stderr}"
    return done.stdout


def documents(name: str, output: Path) -> list[Any]:
    """Return the JSON that a command of `COMMANDS` prints; files that it writes go to a folder."""
    step = '[monitor]\nsequential_step = "update"\n'  # the only one that version 0.1.0 knew
    (output / "rig.toml").write_text(f"{(FOLDER / 'rig.toml').read_text(encoding='utf-8')}{step}", encoding="utf-8")
    words = [word.replace("OUT", str(output)) for word in COMMANDS[name]]
    text = command(FOLDER, *words)
    try:
        found = [json.loads(text)]
    except json.JSONDecodeError:
        found = [json.loads(line) for line in text.splitlines()]
    for document in found:
        document.pop("baseline", None)  # the path
    return found


def arithmetic() -> str:
    """Return a digest of what this machine's libm, BLAS and LAPACK make of some numbers.

    A monitor's constants (filters, discrete models, expected coefficients) are computed with them, and their last
    bits may differ from CPU to CPU. The recursion that follows is IEEE arithmetic in a fixed order: from the same
    constants it gives the same bits everywhere.
    """
    x = np.linspace(0.1, 7.3, 49)
    A = np.cos(np.outer(np.arange(1.0, 8.0), np.arange(1.0, 8.0))) + 4.0 * np.eye(7)
    S = A @ A.T
    made = [np.exp(x), np.log(x), np.sin(x), np.tan(x), x**2.7, np.exp(1j * x), S, A @ x[:7]]
    made += [np.linalg.solve(A, S), np.linalg.cholesky(S), *np.linalg.eigh(S), np.linalg.eigvals(A)]
    made += [np.linalg.lstsq(A[:, :4], x[:7], rcond=None)[0], *np.linalg.svd(A), scipy.linalg.expm(-A)]
    made += [scipy.linalg.solve_discrete_lyapunov(0.1 * A, S), *scipy.linalg.qr(A)]
    return hashlib.sha256(b"".join(np.ascontiguousarray(each).tobytes() for each in made)).hexdigest()


def _arrays(state: Any, trace: ss.Trace) -> dict[str, Any]:
    named = ("t", "theta", "covariance", "expected", "statistic", "threshold", "level", "crossed", "ready", "exceeded")
    found = {name: np.asarray(getattr(trace, name)) for name in named}
    for name, response in (("ifrf", trace.ifrf), ("ifrf_expected", trace.ifrf_expected)):
        found |= {f"{name}.frequencies": response.frequencies, f"{name}.H": response.H}
        found[f"{name}.covariance"] = response.covariance
    return found | {"state": state}


def digest(array: Any) -> str:
    """Return a digest of kind, shape and values; every NaN is the same, and so are both zeros."""
    plain = np.ascontiguousarray(array)
    if plain.dtype.kind in "fc":
        parts = plain.view(plain.real.dtype)
        plain = np.where(np.isnan(parts), np.nan, parts + 0.0).astype(parts.dtype)
    head = f"{np.asarray(array).dtype.str} {np.shape(array)} ".encode()
    return hashlib.sha256(head + plain.tobytes()).hexdigest()


def thin(name: str, array: Any, fleet: bool) -> Any:
    """Return every `THIN`-th evaluation of an array, the first numbers of a state, anything else as it is."""
    if name == "state":
        return array[..., :THIN]
    if name == "threshold" or name.endswith("frequencies"):
        return array
    return array[:, ::THIN] if fleet and name != "t" else array[::THIN]


def _with(name: str, folder: Path, **monitor: Any) -> ss.Baseline:
    """Return a baseline of this folder with other settings of the monitor, by way of its file."""
    document = json.loads((FOLDER / name).read_text(encoding="utf-8"))
    document["loop"]["monitor"] |= monitor
    path = folder / name
    path.write_text(json.dumps(document), encoding="utf-8")
    return ss.Baseline.load(path)


def traces(folder: Path) -> Iterator[tuple[str, bool, dict[str, Any]]]:
    """Yield a name, whether it is of a fleet, and all arrays of `Monitor.run`; needs a folder of its own."""
    for file, log in (("rig.json", "suspect.parquet"), ("axis.json", "axis-suspect.parquet")):
        instrument = () if file == "rig.json" else ("iv-akf",)
        for estimator in ESTIMATORS:
            if estimator in instrument:
                continue
            baseline = _with(file, folder, estimator=estimator)
            recording = ss.read(FOLDER / log, baseline.loop)
            monitor = ss.Monitor(baseline)
            signals = recording.r, recording.u, recording.y, recording.restart
            state, trace = monitor.run(monitor.init(), *signals)
            yield f"{file[:-5]} {estimator}", False, _arrays(state, trace)
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    recording = ss.read(FOLDER / "suspect.parquet", baseline.loop)
    y, restart = recording.y.copy(), np.zeros(recording.samples, dtype=bool)
    y[1500:1520], restart[2500] = np.nan, True
    monitor = ss.Monitor(baseline)
    state, trace = monitor.run(monitor.init(), recording.r, recording.u, y, restart)
    yield "rig gaps", False, _arrays(state, trace)
    points = ss.Baseline.load(FOLDER / "points.json")
    for point in points.points:
        monitor = ss.Monitor(points.at(point))
        state, trace = monitor.run(monitor.init(), recording.r, recording.u, recording.y)
        yield f"points {point}", False, _arrays(state, trace)
    parts = ss.read_parts(FOLDER / "fleet.parquet", baseline.loop, by="asset")
    block = [np.array([getattr(part, name) for part in parts]) for name in "ruy"]
    for precision in ("double", "single"):
        monitor = ss.Monitor([baseline] * len(parts), share_budget=True, precision=precision)  # type: ignore[arg-type]
        state, trace = monitor.run(monitor.init(), *block)
        yield f"fleet {precision}", True, _arrays(state, trace)


def hall(folder: Path, store: Path | None = None) -> Path:
    """Put a service of two assets into a folder, with a store that is already there; return the service file."""
    for name in ("rig.json", "healthy.parquet", "suspect.parquet"):
        shutil.copy(FOLDER / name, folder / name)
    if store is not None:
        (folder / "history.sqlite").write_bytes(gzip.decompress(store.read_bytes()))
    path = folder / "hall.toml"
    path.write_text(SERVICE, encoding="utf-8")
    return path


def history(folder: Path) -> dict[str, Any]:
    """Return the rows of a store by table, with documents as what they mean, and the saved states."""
    connection = sqlite3.connect(folder / "history.sqlite")
    connection.row_factory = sqlite3.Row
    try:
        found = {name: [_row(row) for row in connection.execute(query)] for name, query in TABLES.items()}
        found["states"] = {asset: saved(state) for asset, state in connection.execute(STATES)}
    finally:
        connection.close()
    return found


def _row(row: sqlite3.Row) -> dict[str, Any]:
    packed = ("document", "residual", "status")
    return {key: json.loads(row[key]) if key in packed and row[key] else row[key] for key in row.keys()}  # noqa: SIM118


def saved(state: bytes) -> dict[str, Any]:
    """Return what stands in a saved state: version, the JSON text, and a digest of its numbers."""
    magic, version, length, monitor, quality = struct.unpack_from("<16sHIII", state)
    begin = struct.calcsize("<16sHIII")
    numbers = state[begin + length : begin + length + 8 * (monitor + quality)]
    document = json.loads(state[begin : begin + length])
    return {
        "magic": magic.decode(),
        "version": version,
        "document": document,
        "numbers": np.frombuffer(numbers, "<f8").tolist(),
    }


def quantised(recording: ss.Recording, u: int, y: int) -> ss.Recording:
    """Return a recording whose u and y are multiples of powers of two, as of converters; it takes less room."""
    return replace(recording, u=_rounded(recording.u, u), y=_rounded(recording.y, y))


def _rounded(x: Any, bits: int) -> Any:
    return np.ldexp(np.rint(np.ldexp(x, bits)), -bits)
