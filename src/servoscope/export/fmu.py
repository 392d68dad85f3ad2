"""The exported monitor as a co-simulation unit (FMU) of FMI 3.0: description, sources, a binary for this platform."""

from __future__ import annotations

import io
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

from servoscope import __version__
from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write
from servoscope.export.c_monitor import NAME, RESPONSE, export_c
from servoscope.export.constants import refuse_covariates
from servoscope.export.texts import fill_template

FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fPIC", "-shared")
LIBRARY = {"linux": ("linux", ".so"), "darwin": ("darwin", ".dylib"), "win32": ("windows", ".dll")}
PROCESSORS = {"amd64": "x86_64", "x86_64": "x86_64", "arm64": "aarch64", "aarch64": "aarch64"}
EPOCH = (1980, 1, 1, 0, 0, 0)  # of all files in the archive: the same baseline gives the same bytes
FIRST_NUMBER = 10  # value reference of the first number of an evaluation; fmi3.c calls it NUMBERS


def export_fmu(baseline: Baseline, path: str | Path, name: str = NAME, *, only_coefficients: bool = False) -> bool:
    """Write the monitor of a baseline as a co-simulation unit of FMI 3.0.

    Parameters
    ----------
    baseline
        Of one operating point.
    path
        Of the unit, a ZIP archive; its name ends in ``.fmu`` as a rule.
    name
        Identifier of the model, and what the names in the sources begin with.
    only_coefficients
        As for `export_c`.

    Returns
    -------
    bool
        Whether there is a binary for this platform inside; without a C compiler there are the sources alone.

    Raises
    ------
    BaselineError
        If the baseline has something that cannot be exported; the message names it.
    OutputError
        If the compiler refuses the sources, or the file cannot be written.
    """
    refuse_covariates(baseline, "co-simulation unit")
    made = export_c(baseline, name, only_coefficients=only_coefficients)
    loop, outputs = baseline.loop, list(_outputs(baseline))
    y_unit, u_unit = (unit or "1" for unit in loop.plant.units)
    values = {
        "prefix": name,
        "upper": name.upper(),
        "version": __version__,
        "token": f"{{servoscope-{__version__}-{made.mark.hex()}}}",
        "servo": loop,
        "y_unit": y_unit,
        "u_unit": u_unit,
        "units": sorted({"s", y_unit, u_unit, *(unit for _, unit, _ in outputs if unit)}),
        "limit": baseline.thresholds.statistic,
        "outputs": outputs,
        "numbers": list(range(FIRST_NUMBER, FIRST_NUMBER + len(outputs))),
    }
    source = fill_template("fmi3.c", **values)
    sources = {file: made.files[file] for file in (f"{name}.c", f"{name}.h")} | {"fmi3.c": source}
    contents = {f"sources/{file}": text.encode() for file, text in sources.items()}
    contents["modelDescription.xml"] = fill_template("modelDescription.xml", **values).encode()
    contents["sources/buildDescription.xml"] = fill_template("buildDescription.xml", **values).encode()
    binary = _compile(sources, name)
    if binary is not None:
        contents[_binary_path(name)] = binary
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as unit:
        for file, content in contents.items():
            unit.writestr(zipfile.ZipInfo(file, EPOCH), content, zipfile.ZIP_DEFLATED)
    atomic_write(path, archive.getvalue())
    return binary is not None


def _binary_path(name: str) -> str:
    system, suffix = LIBRARY.get(sys.platform, LIBRARY["linux"])
    machine = platform.machine().lower()
    return f"binaries/{PROCESSORS.get(machine, machine)}-{system}/{name}{suffix}"


def _compile(sources: dict[str, str], name: str) -> bytes | None:
    """Return the library that this platform's compiler makes, None where there is no compiler."""
    compiler = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
    if compiler is None:
        return None
    with tempfile.TemporaryDirectory() as scratch:
        for file, text in sources.items():
            Path(scratch, file).write_text(text, encoding="utf-8")
        command = [compiler, *FLAGS, "-o", "unit", "fmi3.c", f"{name}.c", "-lm"]
        done = subprocess.run(command, cwd=scratch, capture_output=True, text=True, check=False)
        if done.returncode:
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise OutputError(f"{compiler} cannot compile the co-simulation unit: {last}; give another compiler as cc")
        return Path(scratch, "unit").read_bytes()


def _outputs(baseline: Baseline) -> Iterator[tuple[str, str, str]]:
    """Yield name, unit and description of the numbers of an evaluation, in the order of its struct."""
    plant, n = baseline.loop.plant, len(baseline.names)
    yield "updates", "", "samples that the estimate has taken so far"
    yield "statistic", "", "T^2"
    yield "level", "", "of the sequential test, largest since the evaluation before; its limit is 1"
    yield "crossed_s", "s", "first sample at which the level passed its limit; NaN: it has not"
    for name, unit in zip(baseline.names, plant.coefficient_units, strict=True):
        yield f"theta.{name}", unit, "estimated coefficient"
    for k in range(n * n):
        yield f"covariance[{k // n + 1},{k % n + 1}]", "", "of theta"
    for f, frequency in enumerate(baseline.loop.monitor.frequencies, 1):
        for part in RESPONSE:
            yield f"response[{f}].{part}", "", f"inverse frequency response at {frequency:g} Hz, u over y"
    for f, frequency in enumerate(baseline.loop.monitor.frequencies, 1):
        for part in ("real", "imag"):
            yield f"gamma[{f}].{part}", "", f"estimated minus healthy response at {frequency:g} Hz"
