"""The programs behind the figures: each is a module of a folder here, and says what it measures.

python benchmarks                      what there is
python benchmarks FOLDER               what a folder has
python benchmarks FOLDER/NAME [...]    run one; --help lists its options, --json prints its figures

`chaos.py` and `soak.py`, which take hours, are run by themselves.
"""

from __future__ import annotations

import ast
import importlib
import sys
from pathlib import Path

BENCHMARKS = Path(__file__).resolve().parent
sys.path.insert(1, str(BENCHMARKS.parent / "tests" / "support"))  # where `reliability` is a package


def main() -> None:
    """Run the program that the first word names, or list those whose names begin with it."""
    programs = {
        f"{path.parent.name}/{path.stem}": path
        for path in sorted(BENCHMARKS.glob("*/[a-z]*.py"))
        if "\ndef main(" in path.read_text(encoding="utf-8")
    }
    word = sys.argv[1].removesuffix(".py") if len(sys.argv) > 1 and sys.argv[1][0] != "-" else ""
    if word not in programs:
        listed = [name for name in programs if name.startswith(word)]
        for name in listed or programs:
            doc = ast.get_docstring(ast.parse(programs[name].read_text(encoding="utf-8"))) or ""
            print(f"{name:26} {doc.splitlines()[0]}")
        raise SystemExit(not listed)
    sys.argv[:2] = [f"{BENCHMARKS.name} {word}"]  # what usage lines call it
    raise SystemExit(importlib.import_module(word.replace("/", ".")).main())


if __name__ == "__main__":
    main()
