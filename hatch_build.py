"""Puts the site of docs/ into wheels; an editable installation has none: make docs."""

import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class PackageHook(BuildHookInterface):
    """Builds the pages, strictly, into a folder of their own."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Build, unless the wheel only points to this folder."""
        self.folder = tempfile.TemporaryDirectory()
        if version == "editable":
            return
        made = Path(self.folder.name)
        site = made / "site"
        # not parallel, and nothing from an earlier build: the same bytes for everybody
        argv = [sys.executable, "-m", "sphinx", "-q", "-W", "-E", "-d", str(made / "read"), "docs", str(site)]
        subprocess.run(argv, cwd=self.root, check=True)
        for name in (".buildinfo", "objects.inv"):
            (site / name).unlink(missing_ok=True)
        build_data["force_include"][str(site)] = "servoscope/site"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was built; the wheel has it."""
        self.folder.cleanup()
