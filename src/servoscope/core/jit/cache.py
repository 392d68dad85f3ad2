"""The cache of compiled kernels, keyed on the code that each of them is made of.

Numba's own key is the date of the file in which a kernel stands: a comment there compiles anew, and a change of what
the kernel calls in other files does not. Here the key is a hash of the byte code of the kernel and of all functions
that it calls, with the constants that they use. Comments, docstrings and other functions of these files do not count.

What is not cached yet may have come with the installation: `SHIPPED` has the kernels of the examples, made for every
processor of the last ten years when the wheel was built (``hatch_build.py``). Arithmetic here is exact about its order
and its multiply-adds, so that their bits are those of kernels made for this processor.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator
from importlib.util import MAGIC_NUMBER
from pathlib import Path
from types import CodeType, FunctionType, MethodType, ModuleType, SimpleNamespace
from typing import Any

import llvmlite
import numba
import numpy as np
from llvmlite.binding import get_host_cpu_features
from numba.core.caching import FunctionCache, IndexDataCacheFile
from numba.core.compiler import CompileResult
from numba.core.runtime import rtsys

from servoscope.core.cache_folders import warn_of_missing_cache

PACKAGE = __name__.partition(".")[0]
SHIPPED = Path(__file__).with_name("kernels")
SHIPPED_PROCESSOR = "x86-64-v3", ""  # its name for LLVM, and what it has beyond that
SHIPPED_NEEDS = "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"  # of those, what a processor may lack
COMPILER = ("compile", "link", "symbolic", "vector")  # modules whose code decides what a traced function becomes


class KernelCache(FunctionCache):  # type: ignore[misc]  # numba has no complete types
    """Numba's cache under `kernel_key`; without what only compiling needs, whose import takes a third of a second."""

    def __init__(self, kernel: Any) -> None:
        self._kernel, self._py_func = kernel, kernel.py_func
        try:
            super().__init__(kernel.py_func)
            del self._cache_file  # made when it is first used: a kernel may call functions that stand below it
        except RuntimeError:  # Numba found no folder that it can write
            self.disable()
            warn_of_missing_cache()

    @functools.cached_property
    def _cache_file(self) -> Any:
        return self._file(self._cache_path)

    def _file(self, folder: object) -> Any:
        function, key = self._py_func, kernel_key(self._kernel)
        name = f"{function.__module__}.{function.__qualname__}".replace("<", "").replace(">", "")
        base = f"{name}-{key}.py{sys.version_info[0]}{sys.version_info[1]}"
        return IndexDataCacheFile(cache_path=str(folder), filename_base=base, source_stamp=key)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is cached, or came with the installation, for a signature; None if nothing is."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context) or self._load_shipped(sig, target_context)

    def _load_shipped(self, sig: Any, target_context: Any) -> Any:
        if not _runs_shipped():
            return None
        triple = target_context.codegen().magic_tuple()[0]
        processor = SimpleNamespace(magic_tuple=lambda: (triple, *SHIPPED_PROCESSOR))
        payload = self._file(SHIPPED).load(self._index_key(sig, processor))
        return None if payload is None else CompileResult._rebuild(target_context, *payload)

    def _save_overload(self, sig: Any, data: Any) -> None:
        # the annotation is a listing for people, with the paths of whoever compiles: a third of the file
        super()._save_overload(sig, data._replace(type_annotation=""))

    @contextlib.contextmanager
    def _guard_against_spurious_io_errors(self) -> Iterator[None]:
        """Do without the cache where its folder has gone, became read-only or is full since it was found."""
        try:
            yield
        except OSError:
            warn_of_missing_cache()


@functools.cache
def _runs_shipped() -> bool:
    """Return whether kernels came with the installation, and this processor can run them."""
    if not SHIPPED.is_dir():
        return False
    features = get_host_cpu_features()
    return all(features.get(name) for name in SHIPPED_NEEDS)


def kernel_key(kernel: Any) -> str:
    """Return the hash of a kernel's code, of the compiler's, and of the versions; Numba adds that of the processor."""
    digest = hashlib.sha256(compiler_key().encode())
    _Walk(digest.update, kernel).visit(kernel)
    return digest.hexdigest()[:20]


@functools.cache
def compiler_key() -> str:
    """Return the hash of this package's code and of the versions of what compiles it."""
    versions = numba.__version__, llvmlite.__version__, MAGIC_NUMBER
    digest = hashlib.sha256(repr(versions).encode())
    walk = _Walk(digest.update)
    for name in COMPILER:
        module = sys.modules[f"{__package__}.{name}"]
        for value in vars(module).values():
            if getattr(value, "__module__", None) == module.__name__:
                walk.visit(value)
    return digest.hexdigest()


class _Walk:
    """Goes through all that a kernel is made of, in an order that depends on nothing else."""

    def __init__(self, update: Callable[[bytes], None], kernel: Any = None) -> None:
        self._update = update
        self._packages = {PACKAGE, str(getattr(kernel, "__module__", "")).partition(".")[0]}
        self._visited: dict[int, tuple[int, object]] = {}  # the object as well: an id may be used again

    def visit(self, value: Any) -> None:
        """Add a value, and what it refers to, to the hash."""
        if value is None or isinstance(value, bool | int | float | complex | str | bytes):
            return self._add(repr(value))
        if getattr(value, "__module__", None) == __name__:
            return None  # where code is looked for is no part of it
        if id(value) in self._visited:
            return self._add("again", self._visited[id(value)][0])
        self._visited[id(value)] = len(self._visited), value
        self._add(type(value).__name__)
        if hasattr(value, "py_func"):  # compiled by Numba
            self._packages.add(value.py_func.__module__.partition(".")[0])
            self._visit_all((sorted(value.targetoptions.items()), value.py_func))
        elif hasattr(value, "__wrapped__"):  # written by an intrinsic function
            self.visit(value.__wrapped__)
        elif isinstance(value, FunctionType) and self._is_own(value):
            self._visit_function(value)
        elif isinstance(value, MethodType):
            self._visit_all((value.__func__, value.__self__))
        elif isinstance(value, CodeType):
            self._visit_code(value)
        elif isinstance(value, type) and self._is_own(value):
            self._visit_all(x for x in vars(value).values() if isinstance(x, FunctionType | property))
        elif isinstance(value, property):
            self.visit(value.fget)
        elif isinstance(value, tuple | list):
            self._visit_all(value)
        elif isinstance(value, set | frozenset):
            self._add(*sorted(map(repr, value)))
        elif isinstance(value, dict):
            self._visit_all(value.items())
        elif isinstance(value, np.ndarray | np.generic):
            self._add(value.dtype, value.shape, value.tobytes())
        elif isinstance(value, SimpleNamespace) or self._is_own(type(value)):
            self._visit_all((type(value), getattr(value, "__dict__", {})))
        else:
            self._add(getattr(value, "__module__", ""), getattr(value, "__qualname__", ""))
        return None

    def _add(self, *words: object) -> None:
        self._update(repr(words).encode())

    def _visit_all(self, values: Iterable[Any]) -> None:
        for value in values:
            self.visit(value)
        self._add("end")

    def _is_own(self, value: Any) -> bool:
        return str(value.__module__).partition(".")[0] in self._packages

    def _visit_function(self, function: FunctionType) -> None:
        self._visit_code(function.__code__)
        names = list(_names(function.__code__))
        for name in names:
            value = function.__globals__.get(name)
            if isinstance(value, ModuleType):
                if value.__name__.startswith(f"{PACKAGE}."):
                    self._visit_all(getattr(value, attribute) for attribute in names if hasattr(value, attribute))
            elif name in function.__globals__:
                self.visit(value)
        self._visit_all(cell.cell_contents for cell in function.__closure__ or ())
        self._visit_all((function.__defaults__, function.__kwdefaults__))

    def _visit_code(self, code: CodeType) -> None:
        consts = code.co_consts
        if consts and isinstance(consts[0], str):
            consts = (None, *consts[1:])  # the docstring
        self._add(code.co_code, code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars, code.co_argcount)
        self._visit_all(consts)


def _names(code: CodeType) -> dict[str, None]:
    """Return the names that code and the functions in it look up, in their order."""
    names = dict.fromkeys(code.co_names)
    for const in code.co_consts:
        if isinstance(const, CodeType):
            names |= _names(const)
    return names
