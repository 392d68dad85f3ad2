"""How fast it runs: one case after the other, each a module in `cases` that says what it measures.

python benchmarks/speed.py                   what the cases are
python benchmarks/speed.py CASE [OPTIONS]    run one; --help lists its options, --json prints its figures
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

sys.path.insert(1, str(Path(__file__).resolve().parents[1] / "tests" / "support"))  # where `reliability` is a package
CASES = sorted(path.stem for path in (Path(__file__).parent / "cases").glob("[a-z]*.py"))


def main() -> None:
    """Run the case that the first word names, or list them."""
    if len(sys.argv) < 2 or sys.argv[1] not in CASES:
        for name in CASES:
            doc = importlib.import_module(f"cases.{name}").__doc__ or ""
            print(f"{name:15} {doc.splitlines()[0]}")
        raise SystemExit(len(sys.argv) > 1 and sys.argv[1] not in ("-h", "--help"))
    name = sys.argv.pop(1)
    raise SystemExit(importlib.import_module(f"cases.{name}").main())


if __name__ == "__main__":
    main()
