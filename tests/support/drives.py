"""Exported monitors, compiled by the system's compiler and called from Python."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from servoscope.baseline.baseline import Baseline
from servoscope.export import NAME, export_c

Array = npt.NDArray[np.float64]
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Werror")


def compiler(name: str = "gcc") -> str:
    """Return a compiler; skip the test without it."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(f"{name} is not on this machine: scripts/install-test-servers installs it")
    return found


@dataclass
class Drive:
    """A compiled monitor with its state."""

    library: Any
    row: int  # numbers at the head of an evaluation
    size: int  # numbers of the monitor's state
    evaluation: np.dtype[Any]
    image_bytes: int
    state: Array

    @classmethod
    def built(
        cls, baseline: Baseline, folder: Path, *options: str, only_coefficients: bool = False, single: bool = False
    ) -> Drive:
        """Export a baseline, compile it with gcc and the options, and set up its state."""
        export_c(baseline, only_coefficients=only_coefficients, single=single).save(folder)
        library = folder / f"monitor{''.join(options)}.so"
        flags = (*STRICT, *(options or ("-O2", "-ffp-contract=off")), "-shared", "-fPIC")
        made = subprocess.run(
            [compiler(), *flags, "-o", library, folder / f"{NAME}.c", "-lm"], capture_output=True, text=True
        )
        assert made.returncode == 0, made.stderr
        header = (folder / f"{NAME}.h").read_text(encoding="utf-8")
        number = {key: int(x) for key, x in re.findall(r"#define SERVO_MONITOR_(\w+) (\d+)u?\b", header)}
        row, size = number["ROW"], number["STATE_NUMBERS"]
        kind = "f4" if single else "f8"
        evaluation = np.dtype([("row", kind, row), ("gamma", kind, (number["FREQUENCIES"], 2)), ("verdict", "i4")])
        if not single:  # the verdict is an int, filled up to the next double
            evaluation = np.dtype([*((name, evaluation[name]) for name in evaluation.names or ()), ("padding", "i4")])
        drive = cls(ctypes.CDLL(str(library)), row, size, evaluation, number["IMAGE_BYTES"], np.zeros(size + 2))
        drive.function("block").restype = ctypes.c_size_t
        drive.function("init")(drive.pointer())
        return drive

    def function(self, name: str) -> Any:
        """Return a function of the library."""
        return getattr(self.library, f"{NAME}_{name}")

    def pointer(self) -> Any:
        """Return where the state stands."""
        return self.state.ctypes.data_as(ctypes.c_void_p)

    def run(self, r: Array, u: Array, y: Array, restart: npt.NDArray[np.bool_] | None = None) -> Any:
        """Take a block of samples; return its evaluations."""
        flags = None if restart is None else np.ascontiguousarray(restart, dtype=np.uint8)
        out = np.zeros(len(r) + 1, dtype=self.evaluation)
        signals = [np.ascontiguousarray(x, dtype=self.evaluation["row"].base) for x in (r, u, y)]
        found = self.function("block")(
            self.pointer(),
            ctypes.c_size_t(len(r)),
            *(x.ctypes.data_as(ctypes.c_void_p) for x in signals),
            None if flags is None else flags.ctypes.data_as(ctypes.c_void_p),
            out.ctypes.data_as(ctypes.c_void_p),
            ctypes.c_size_t(len(out)),
        )
        return out[:found]

    def save(self) -> bytes:
        """Return an image of the state."""
        image = ctypes.create_string_buffer(self.image_bytes)
        self.function("save")(self.pointer(), image)
        return image.raw

    def load(self, image: bytes) -> bool:
        """Read an image; return whether it was taken."""
        return bool(self.function("load")(self.pointer(), image))
