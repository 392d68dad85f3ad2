"""Puts the site of docs/ into wheels, and kernels compiled ahead of time into every installation.

An editable installation has no site: make docs. Its kernels stand in src/servoscope/core/jit/kernels.
"""

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# What the kernels are made of: all that these commands compile. The first two are the demonstration and the tutorial.
EXAMPLES = (
    "demo -o demo",
    "tutorial -o axis",
    "init axis/monday.csv -o axis/loop.toml --yes",
    "learn axis/loop.toml axis/monday.csv axis/tuesday.csv -o axis/baseline.json",
    "diagnose axis/baseline.json axis/friday.csv",
)
# what reads messages is compiled by a service with a broker
STATEMENT = "from servoscope.service.mqtt.block_kernels import parse_regular; list(parse_regular([b'']))"
KERNELS = "servoscope/core/jit/kernels"
PROCESSOR = {"NUMBA_CPU_NAME": "x86-64-v3", "NUMBA_CPU_FEATURES": ""}  # as core/jit/cache.py looks for them


def copy_sources(sources: Path, folder: Path) -> None:
    """Copy the package without kernels of an earlier build, which would be taken instead of being compiled."""
    shutil.copytree(sources, folder, ignore=shutil.ignore_patterns("kernels", "site", "__pycache__"))


def compile_kernels(sources: Path, folder: Path, examples: tuple[str, ...] = EXAMPLES) -> None:
    """Fill a folder with the kernels that examples need: the same bytes wherever the sources stand."""
    with tempfile.TemporaryDirectory() as work:
        cache = Path(work) / "cache"
        copy_sources(sources, Path(work) / "src")
        # pip tells by PYTHONPATH where the packages of its build environment are
        paths = [str(Path(work) / "src"), *filter(None, [os.environ.get("PYTHONPATH")])]
        folders = {"NUMBA_CACHE_DIR": str(cache), "MPLCONFIGDIR": work}
        variables = {"PYTHONPATH": os.pathsep.join(paths), **folders, **PROCESSOR}
        commands = [["-m", "servoscope", *example.split()] for example in examples]
        for command in (*commands, ["-c", STATEMENT]):
            argv = [sys.executable, *command]
            subprocess.run(argv, cwd=work, env=os.environ | variables, check=True, stdout=subprocess.DEVNULL)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for path in cache.glob("*/*.nb?"):  # folders are named after where the sources stand
            shutil.copyfile(path, folder / path.name)


class PackageHook(BuildHookInterface):
    """Builds the pages, strictly, into a folder of their own, and the kernels."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build; if the wheel only points to this folder, the kernels alone."""
        self.folder = tempfile.TemporaryDirectory()
        made, sources = Path(self.folder.name), Path(self.root) / "src"
        if version != "editable":
            site = made / "site"
            # not parallel, and nothing from an earlier build: the same bytes for everybody
            argv = [sys.executable, "-m", "sphinx", "-q", "-W", "-E", "-d", str(made / "read"), "docs", str(site)]
            subprocess.run(argv, cwd=self.root, check=True)
            for name in (".buildinfo", "objects.inv"):
                (site / name).unlink(missing_ok=True)
            build_data["force_include"][str(site)] = "servoscope/site"
        if os.environ.get("SERVOSCOPE_KERNELS") == "none" or platform.machine().lower() not in ("x86_64", "amd64"):
            return  # each is compiled when it is first used
        kernels = sources / KERNELS if version == "editable" else made / "kernels"
        try:
            compile_kernels(sources, kernels)
        except (OSError, subprocess.CalledProcessError) as error:
            print(f"no kernels were compiled ahead of time: {error}", file=sys.stderr)
            return
        if version != "editable":
            build_data["force_include"][str(kernels)] = KERNELS

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was built; the wheel has it."""
        self.folder.cleanup()
