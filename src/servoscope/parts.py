"""Parts of kernels as text for LLVM only: Numba would make machine code of each, which nobody calls."""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class Library(JITCodeLibrary):  # type: ignore[misc]  # numba has no complete types
    """The code of a part. It is optimised where it is linked in, together with what is around it."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return that there is none."""
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> Any:
        """Who is told of objects that the code needs at run time: it is not run by itself."""
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Ignore them."""


class Parts(Compiler):  # type: ignore[misc]
    """Numba's compiler, with such a library."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *rest: Any) -> None:
        super().__init__(typingctx, targetctx, library or Library(targetctx.codegen(), "part"), *rest)
