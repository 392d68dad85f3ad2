"""The kinds of machines: built-in ones, and those that installed packages offer."""

from __future__ import annotations

import re
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeAlias

from servoscope.baseline.baseline import Baseline
from servoscope.core.errors import BaselineError, LoopError
from servoscope.core.settings import parse_toml
from servoscope.machines.protocol import Machine

ENTRY_POINTS = "servoscope.machines"  # group
LOOP = "loop"  # the kind of files that name none
BUILT_IN = tuple(  # written like the entry points of other packages, and loaded like them: when a kind is used
    EntryPoint(name, value, ENTRY_POINTS)
    for name, value in (
        (LOOP, "servoscope.machines.servo_loop:LoopMachine"),
        ("arm", "servoscope.arm.machine:ArmMachine"),
    )
)
MachineSource: TypeAlias = Baseline | Machine  # of which `to_machine` makes a machine
FORMAT = re.compile(r'"format":\s*"servoscope-(\w+)-baseline"')
HEAD_LENGTH = 200  # characters, in which a baseline says what it is


def machine_kinds() -> dict[str, EntryPoint]:
    """Return the entry points of all kinds by name; a package cannot replace a built-in one."""
    return {point.name: point for point in (*entry_points(group=ENTRY_POINTS), *BUILT_IN)}


def machine_class(kind: str) -> type[Machine]:
    """Return the class of a kind; raises BaselineError if none is installed."""
    point = machine_kinds().get(kind)
    if point is None:
        known = ", ".join(sorted(machine_kinds()))
        raise BaselineError(f"machine of kind {kind!r} is unknown, install the package that adds it; known: {known}")
    machine: type[Machine] = point.load()
    return machine


def kind_of_baseline(head: str) -> str:
    """Return the kind of a baseline by the beginning of its file."""
    named = FORMAT.search(head[:HEAD_LENGTH])
    return named[1] if named else LOOP


def kind_of_loop_file(path: str | Path) -> str:
    """Return the kind that a loop file names and that is installed, else that of loops, which say what is wrong."""
    try:
        kind = parse_toml(Path(path).read_text(encoding="utf-8-sig"), path, LoopError).get("kind")
    except (OSError, ValueError, LoopError):
        return LOOP
    return str(kind) if kind in machine_kinds() else LOOP


def kind_of_file(path: str | Path) -> str:
    """Return the kind of a baseline in a file; that of loops where it cannot be read."""
    try:
        with Path(path).open(encoding="utf-8") as file:
            return kind_of_baseline(file.read(HEAD_LENGTH))
    except (OSError, ValueError):
        return LOOP


def load_machine(path: str | Path) -> Machine:
    """Read the baseline of a machine of any kind; raises BaselineError if it cannot be used."""
    try:
        kind = machine_class(kind_of_file(path))
    except BaselineError as error:
        raise BaselineError(f"{path}: {error}") from None
    return kind.load(path)


def load_cached(path: Path) -> Machine:
    """Return the machine of a file, which is read again when it has changed."""
    try:
        stamp = path.stat().st_mtime_ns
    except OSError:
        stamp = 0  # loading has the better message
    return _load_version(path, stamp)


@lru_cache(maxsize=64)
def _load_version(path: Path, _: int) -> Machine:
    return load_machine(path)


def parse_machine(text: str) -> Machine:
    """Return the machine whose `to_json` this is."""
    return machine_class(kind_of_baseline(text)).parse(text)


def to_machine(source: MachineSource) -> Machine:
    """Return a machine; of the baseline of a loop, its loop."""
    if isinstance(source, Baseline):
        from servoscope.machines.servo_loop import LoopMachine

        return LoopMachine(source)
    return source
