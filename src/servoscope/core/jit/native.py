"""Machine code of LLVM's assembly, through the public interface of llvmlite; kept as object files under a hash of it.

The hash counts the version of llvmlite and the processor as well. An object file begins with a hash of itself: a
damaged one is made anew. Python calls such a function as it calls its own built-in ones: beside it stands one that
takes objects, by the stable interface of CPython (`_entry`).
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, ClassVar

from servoscope.core.cache_folders import warn_of_missing_cache

DIGEST_BYTES = 32
METH_FASTCALL = 0x80  # a built-in function that takes an array of objects, and their number
CONVERSIONS = {"ptr": "PyLong_AsVoidPtr", "i64": "PyLong_AsLongLong", "double": "PyFloat_AsDouble"}
RESULTS = {"i1": "PyBool_FromLong", "i64": "PyLong_FromLongLong", "double": "PyFloat_FromDouble"}
OTHER_CALLS = ("PyErr_Occurred", "PyErr_BadArgument", "PyEval_SaveThread", "PyEval_RestoreThread")
LOCK = threading.Lock()


class MethodDefinition(ctypes.Structure):
    """A built-in function, as CPython's stable interface describes it (``PyMethodDef``)."""

    _fields_: ClassVar[Any] = [
        ("name", ctypes.c_char_p),
        ("place", ctypes.c_void_p),
        ("flags", ctypes.c_int),
        ("doc", ctypes.c_char_p),
    ]


_DEFINITIONS: list[MethodDefinition] = []  # they must outlive their functions


def object_folder() -> Path:
    """Return the folder of the object files: below `NUMBA_CACHE_DIR`, or in the user's folder for caches."""
    named = os.environ.get("NUMBA_CACHE_DIR")
    if named:
        return Path(named) / "objects"
    if sys.platform == "win32":
        caches = Path(os.environ.get("LOCALAPPDATA", "~"))
    else:
        caches = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache")
    return caches.expanduser() / "servoscope"


def _machine(level: int = 2) -> Any:
    """Return what makes machine code, at one of the `level`s of optimisation 0 to 3."""
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    features = llvm.get_host_cpu_features().flatten()
    target = llvm.Target.from_default_triple()
    return target.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, opt=level, jit=True)


@functools.cache
def _engine() -> Any:
    """Return what holds the machine code of this process."""
    import llvmlite.binding as llvm

    for name in (*CONVERSIONS.values(), *RESULTS.values(), *OTHER_CALLS):
        llvm.add_symbol(name, ctypes.cast(getattr(ctypes.pythonapi, name), ctypes.c_void_p).value)
    return llvm.create_mcjit_compiler(llvm.parse_assembly(""), _machine())


@functools.cache
def _toolchain() -> str:
    """Return what decides, beside the text, which machine code is made."""
    import llvmlite
    import llvmlite.binding as llvm

    return repr((llvmlite.__version__, llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()))


def _entry(arguments: Sequence[tuple[str, str]], result: str, *, brief: bool) -> str:
    """Return the text of a function ``@call`` that takes objects, converts them and calls ``@run``.

    A `brief` one keeps other threads waiting, which is faster.
    """
    kinds = [kind for _, kind in arguments]
    converted = "".join(
        f"""
  %p{i} = getelementptr ptr, ptr %objects, i64 {i}
  %o{i} = load ptr, ptr %p{i}
  %a{i} = call {kind} @{CONVERSIONS[kind]}(ptr %o{i})"""
        for i, kind in enumerate(kinds)
    )
    call = f"call {result} @run({', '.join(f'{kind} %a{i}' for i, kind in enumerate(kinds))})"
    let_go, take_back = "%thread = call ptr @PyEval_SaveThread()", "call void @PyEval_RestoreThread(ptr %thread)"
    value = {"void": "i64 0", "i1": "i64 %wide"}.get(result, f"{result} %result")
    return f"""
declare ptr @PyLong_AsVoidPtr(ptr)
declare i64 @PyLong_AsLongLong(ptr)
declare double @PyFloat_AsDouble(ptr)
declare ptr @PyBool_FromLong(i64)
declare ptr @PyLong_FromLongLong(i64)
declare ptr @PyFloat_FromDouble(double)
declare i32 @PyErr_BadArgument()
declare ptr @PyErr_Occurred()
declare ptr @PyEval_SaveThread()
declare void @PyEval_RestoreThread(ptr)
define ptr @call(ptr %self, ptr %objects, i64 %count) {{
  %enough = icmp eq i64 %count, {len(kinds)}
  br i1 %enough, label %convert, label %refuse
refuse:
  call i32 @PyErr_BadArgument()
  ret ptr null
convert:{converted}
  %error = call ptr @PyErr_Occurred()
  %clean = icmp eq ptr %error, null
  br i1 %clean, label %go, label %fail
fail:
  ret ptr null
go:
  {"" if brief else let_go}
  {call if result == "void" else f"%result = {call}"}
  {"" if brief else take_back}
  {"%wide = zext i1 %result to i64" if result == "i1" else ""}
  %object = call ptr @{RESULTS.get(result, "PyBool_FromLong")}({value})
  ret ptr %object
}}
"""


def _compile(text: str, straight: bool = False) -> bytes:
    import llvmlite.binding as llvm

    machine, module = _machine(1 if straight else 2), llvm.parse_assembly(text)
    module.triple, module.data_layout = machine.triple, str(machine.target_data)
    # Level 1 of 3: traced text has no calls and few loops, and what the others add made a log a third slower.
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(1))
    passes = builder.getModulePassManager()
    if straight:  # the others found nothing, and took half of the time
        passes = llvm.create_new_module_pass_manager()
        passes.add_sroa_pass()
        passes.add_instruction_combine_pass()
        passes.add_simplify_cfg_pass()
    passes.run(module, builder)
    return bytes(machine.emit_object(module))


def object_code(name: str, text: str, straight: bool = False) -> bytes:
    """Return the machine code of a module, from the cache if it is there under a name."""
    try:
        folder = object_folder()
    except RuntimeError:  # there is no home
        warn_of_missing_cache()
        return _compile(text, straight)
    path = folder / f"{name}.o"
    try:
        kept = path.read_bytes()
        if hashlib.sha256(kept[DIGEST_BYTES:]).digest() == kept[:DIGEST_BYTES]:
            return kept[DIGEST_BYTES:]
    except OSError:
        pass  # not there yet, or not readable
    code = _compile(text, straight)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        part = folder / f"{name}.{os.getpid()}"
        part.write_bytes(hashlib.sha256(code).digest() + code)
        part.replace(path)
    except OSError:
        warn_of_missing_cache()
    return code


def native_function(
    text: str,
    arguments: Sequence[tuple[str, str]],
    result: str = "void",
    *,
    brief: bool = False,
    straight: bool = False,
) -> Callable[..., Any]:
    """Return the function `@run` of a module; a `brief` one keeps other threads waiting, which is faster.

    Pointers are given as addresses (`address`). A `straight` one is mostly straight-line text, which needs little
    optimisation.
    """
    import llvmlite.binding as llvm

    text += _entry(arguments, result, brief=brief)
    name = hashlib.sha256((_toolchain() + "straight" * straight + text).encode()).hexdigest()[:32]
    with LOCK:
        engine = _engine()
        if not engine.get_function_address(f"call_{name}"):
            code = object_code(name, text.replace("@call(", f"@call_{name}("), straight)
            engine.add_object_file(llvm.ObjectFileRef.from_data(code))
            engine.finalize_object()
        place = engine.get_function_address(f"call_{name}")
    _DEFINITIONS.append(MethodDefinition(b"native", place, METH_FASTCALL, None))
    make = ctypes.pythonapi.PyCFunction_NewEx
    make.restype, make.argtypes = ctypes.py_object, (ctypes.c_void_p, ctypes.c_void_p, ctypes.c_void_p)
    function: Callable[..., Any] = make(ctypes.addressof(_DEFINITIONS[-1]), None, None)
    return function


def address(array: Any) -> int:
    """Return where the numbers of an array begin."""
    return int(array.__array_interface__["data"][0])
