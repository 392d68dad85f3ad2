"""The public names of the package: each is there, imported when first used, and nothing else is."""

from __future__ import annotations

import ast
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
