"""Run a command with the arithmetic of another processor: NumPy without the features found here, other BLAS kernels.

python scripts/other_processor.py .venv/bin/python -m pytest tests/isolation
"""

from __future__ import annotations

import os
import sys

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__


def environment() -> dict[str, str]:
    """Return the variables that switch off what this build of NumPy would use here; others it would warn of."""
    found = [name for name in __cpu_dispatch__ if __cpu_features__[name]]
    variables = {"NPY_DISABLE_CPU_FEATURES": " ".join(found)} if found else {}
    if "X86_V3" in __cpu_dispatch__:  # an Intel or AMD processor: kernels of one that is older, which all of them run
        variables["OPENBLAS_CORETYPE"] = "Haswell" if __cpu_features__.get("X86_V4") else "Nehalem"
    return variables


def main() -> None:
    """Run the command line of this process."""
    if not sys.argv[1:]:
        sys.exit(__doc__)
    variables = environment()
    print(" ".join(f"{name}='{value}'" for name, value in variables.items()) or "nothing to switch off", flush=True)
    os.execvpe(sys.argv[1], sys.argv[1:], os.environ | variables)


if __name__ == "__main__":
    main()
