"""The public names of the package: each is there, imported when first used, and nothing else is."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import servoscope


@pytest.mark.parametrize("name", servoscope.__all__)
def test_a_public_name_is_there(name: str) -> None:
    assert getattr(servoscope, name) is not None
    assert name in dir(servoscope)


def test_type_checkers_see_the_same_names_in_the_same_places(project: Path) -> None:
    tree = ast.parse((project / "src" / "servoscope" / "__init__.py").read_text(encoding="utf-8"))
    seen = {
        alias.asname or alias.name: (node.module or "").removeprefix("servoscope.")
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("servoscope.") and node.col_offset
        for alias in node.names
    }
    assert seen == servoscope._HOMES
    assert {*seen, "__version__"} == {*servoscope.__all__, "NoveltyDetector"}  # needs scikit-learn: not for import *


def test_a_name_that_is_not_there_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'diagnosse'"):
        _ = servoscope.diagnosse


UNIX_ONLY = ("fcntl", "grp", "pwd", "pty", "resource", "termios")
COMMANDS = """
import sys
from importlib.abc import MetaPathFinder

class Hidden(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name in {unix}:
            raise ImportError(name)

for name in {unix}:
    sys.modules.pop(name, None)
sys.meta_path.insert(0, Hidden())
from servoscope.cli import app
from servoscope.cli.exit import RAN

for words in {commands}:
    try:
        app(words)
    except SystemExit as end:
        assert (end.code or 0) in RAN, words
"""


def test_files_are_judged_without_what_only_unix_has(project: Path, tmp_path: Path) -> None:
    """Windows has none of these modules: init, learn, diagnose and reports do without."""
    golden, report = project / "tests" / "golden", str(tmp_path / "report.html")
    commands = [
        ["init", str(golden / "axis.parquet"), "-o", str(tmp_path / "axis.toml"), "--yes"],
        ["learn", str(golden / "axis.toml"), str(golden / "axis.parquet"), "-o", str(tmp_path / "axis.json")],
        ["diagnose", str(golden / "axis.json"), str(golden / "axis-suspect.parquet"), "--report", report],
    ]
    program = COMMANDS.format(unix=UNIX_ONLY, commands=commands)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "report.html").stat().st_size > 10_000
