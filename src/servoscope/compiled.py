"""How kernels are compiled: strict arithmetic, cached on disk where a folder can be written."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import inspect
from pathlib import Path
from types import FunctionType
from typing import TYPE_CHECKING, Any, TypeVar

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from servoscope.arithmetic import Index, Rows, Truth, lanes_of

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

F = TypeVar("F", bound="Callable[..., object]")

LINE = 64  # bytes: a vector must not straddle two cache lines


@functools.cache
def sources() -> str:
    """Return a hash of the sources of all kernels.

    Numba's cache sees only the file of the kernel itself, not those of what it inlines. So this is part of every
    kernel's name, and a change of any of them compiles anew.
    """
    package = Path(__file__).parent
    texts = [path.read_bytes() for path in sorted(package.rglob("*.py"))]
    words = (b"servoscope.compiled", b"servoscope.arithmetic")
    return hashlib.sha256(b"".join(text for text in texts if any(word in text for word in words))).hexdigest()[:12]


def kernel(function: F, heap: bool = True) -> F:
    """Compile a function on its first call; without a folder for the cache, for this process only.

    `heap` says whether it, or what it calls, allocates arrays; without, there is no counting of references either.
    """
    function.__qualname__ = f"{function.__qualname__}_{sources()}"
    compiled = numba.njit(error_model="numpy", nogil=True, _nrt=heap)(function)
    with contextlib.suppress(RuntimeError):  # Numba found no folder that it can write
        compiled._cache = Cache(function)
    return compiled  # type: ignore[no-any-return]


class Cache(FunctionCache):  # type: ignore[misc]  # numba has no complete types
    """Numba's cache without what only compiling needs: importing that takes a third of a second at every start."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what is cached for a signature, None if nothing is."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def inlined(function: F, heap: bool = False) -> F:
    """Compile a part of other kernels: always inlined, never called from Python."""
    return numba.njit(error_model="numpy", forceinline=True, _nrt=heap)(function)  # type: ignore[no-any-return]


def filled(template: Callable[..., Any], names: Mapping[str, object], what: str = "") -> Callable[..., Any]:
    """Return a template, a plain function, with other objects in the place of some names of its module.

    Sizes become literals that way, and an estimator's `update` a direct call.

    Parameters
    ----------
    template
        Function.
    names
        What it finds under these names instead of its module's.
    what
        Tells the copies of one template apart; part of its name, and so of the cache's.

    Raises
    ------
    TypeError
        If the template is compiled already or no function.
    """
    if not isinstance(template, FunctionType):
        raise TypeError(f"a template is a plain function, not {type(template).__name__}")
    digest = hashlib.sha256(what.encode()).hexdigest()[:12] if what else ""
    name = "_".join(filter(None, (template.__name__.lstrip("_"), digest)))
    function = FunctionType(template.__code__, {**template.__globals__, **names}, name)
    function.__qualname__, function.__module__ = name, template.__module__
    return function


def traced(function: Callable[..., Truth | None], width: int = 1, shared: str = "") -> Callable[..., bool]:
    """Return what kernels call as ``part(lane, ...)`` for a function of `servoscope.arithmetic`.

    Arrays (rows, lanes) arrive as `width` lanes of them from `lane` on, integers as numbers of rows, booleans as
    conditions; `shared` is the argument whose lanes are all one. The function runs once, with symbols, and
    leaves straight-line code of vectors. What it returns holds in all lanes, or does not.
    """
    arguments = tuple(inspect.signature(function).parameters)

    def part(typing: Any, lane: Any, *kinds: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            given: list[Any] = []
            passed = cgutils.unpack_tuple(builder, values[1])
            for name, kind, value in zip(arguments, signature.args[1], passed, strict=True):
                if isinstance(kind, types.Array):
                    array = make_array(kind)(context, builder, value)
                    given.append(Rows(context, builder, kind, array, values[0], width, name == shared))
                elif isinstance(kind, types.Boolean):
                    given.append(Truth(builder, lanes_of(builder, builder.trunc(value, ir.IntType(1)), width)))
                else:
                    given.append(Index(builder, value))
            said = function(*given)
            for each in given:
                if isinstance(each, Rows):
                    each.flush()
            holds = ir.IntType(1)(1) if said is None else said.everywhere
            return holds

        return types.boolean(lane, types.StarArgTuple(kinds)), emit  # type: ignore[attr-defined]  # it has

    made: Callable[..., bool] = intrinsic(part)
    return made


def _fixed(context: Any, builder: Any, kind: Any, data: Any, shape: Any, strides: Any) -> Any:
    constant = context.get_constant
    array = make_array(kind)(context, builder)
    populate_array(
        array,
        data=data,
        shape=[constant(types.intp, size) if isinstance(size, int) else size for size in shape],
        strides=[constant(types.intp, size) for size in strides],
        itemsize=constant(types.intp, context.get_abi_sizeof(context.get_data_type(kind.dtype))),
        meminfo=None,
    )
    return array._getvalue()


@intrinsic(prefer_literal=True)
def local(typing: Any, like: Any, rows: Any, columns: Any) -> Any:
    """Return an array (rows, columns) on the stack, not filled, of the precision of another; sizes are literals.

    With constant indices the compiler keeps it in registers, as it would an array of C.
    """
    shape = (rows.literal_value, columns.literal_value)
    kind = types.Array(like.dtype, 2, "C")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        number = context.get_data_type(kind.dtype)
        block = cgutils.alloca_once(builder, ir.ArrayType(number, max(shape[0] * shape[1], 1)))
        block.align = LINE
        width = context.get_abi_sizeof(number)
        data = builder.bitcast(block, number.as_pointer())
        return _fixed(context, builder, kind, data, shape, (shape[1] * width, width))

    return kind(like, rows, columns), code


@intrinsic(prefer_literal=True)
def laid(typing: Any, flat: Any, lanes: Any, own: Any) -> Any:
    """Return a view (rows, lanes) of a contiguous array; with own = 0 all lanes share one column."""
    count, apart = lanes.literal_value, own.literal_value
    kind = types.Array(flat.dtype, 2, "A")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        source = make_array(signature.args[0])(context, builder, values[0])
        width = context.get_abi_sizeof(context.get_data_type(kind.dtype))
        columns = count if apart else 1
        rows = builder.udiv(source.nitems, context.get_constant(types.intp, columns))
        return _fixed(context, builder, kind, source.data, (rows, count), (columns * width, apart * width))

    return kind(flat, lanes, own), code
