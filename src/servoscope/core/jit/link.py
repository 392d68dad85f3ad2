"""Subroutines as text for LLVM only: Numba would make machine code of each one, and nothing calls it."""

from __future__ import annotations

from typing import Any

from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler


class LinkOnlyLibrary(JITCodeLibrary):  # type: ignore[misc]  # numba has no complete types
    """The code of a subroutine. It is optimised where it is linked in, together with what surrounds it."""

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """Return the null pointer: there is no machine code."""
        self._ensure_finalized()
        return 0

    @property
    def codegen(self) -> Any:
        """The receiver of `set_env`."""
        return self

    def set_env(self, name: str, env: Any) -> None:
        """Ignore an object that the code needs at run time: this code is not run by itself."""


class LinkOnlyCompiler(Compiler):  # type: ignore[misc]
    """Numba's compiler with such a library."""

    def __init__(self, typingctx: Any, targetctx: Any, library: Any, *rest: Any) -> None:
        super().__init__(typingctx, targetctx, library or LinkOnlyLibrary(targetctx.codegen(), "subroutine"), *rest)
