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

from servoscope.arithmetic import Index, Number, Truth
from servoscope.lanes import Kept, Rows, lanes_of, turned
from servoscope.parts import Parts

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

F = TypeVar("F", bound="Callable[..., object]")

LINE = 64  # bytes: a vector must not straddle two cache lines
ALIGNED = 4  # bytes: all that is known of where a number stands


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
    compiled = numba.njit(error_model="numpy", nogil=True, _nrt=heap, no_cfunc_wrapper=True)(function)
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


def part(function: F, heap: bool = False, always: bool = False) -> F:
    """Compile a part of kernels, never called from Python; `always` inlines it, else LLVM decides."""
    options = {"error_model": "numpy", "_nrt": heap, "forceinline": always, "pipeline_class": Parts}
    return numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)(function)  # type: ignore[no-any-return]


def inlined(function: F, heap: bool = False) -> F:
    """Compile a part of other kernels that is always inlined."""
    return part(function, heap, always=True)


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


def traced(
    function: Callable[..., Truth | None], width: int = 1, shared: str = "", kept: Sequence[str] = ()
) -> Callable[..., bool]:
    """Return what kernels call as ``part(lane, ...)`` for a function of `servoscope.arithmetic`.

    Arrays (rows, lanes) arrive as `width` lanes of them from `lane` on, integers as numbers of rows, booleans as
    conditions; `shared` is the argument whose lanes are all one. The function runs once, with symbols, and
    leaves straight-line code of vectors. What it returns holds in all lanes, or does not.

    With `kept`, names of arguments, that code is in a loop: the last argument runs from one number of two, by which it
    is called, up to the other, and these arrays stay in registers meanwhile.
    """
    arguments = tuple(inspect.signature(function).parameters)

    def part(typing: Any, lane: Any, *kinds: Any) -> Any:
        def given(context: Any, builder: Any, signature: Any, values: Any) -> list[Any]:
            found: list[Any] = []
            for kind, value in zip(signature.args[1], cgutils.unpack_tuple(builder, values[1]), strict=True):
                if isinstance(kind, types.Array):
                    array = make_array(kind)(context, builder, value)
                    one = arguments[len(found)] == shared
                    found.append(Rows(context, builder, kind, array, values[0], width, one))
                elif isinstance(kind, types.Boolean):
                    found.append(Truth(builder, lanes_of(builder, builder.trunc(value, ir.IntType(1)), width)))
                else:
                    found.append(Index(builder, value))
            return found

        def flush(found: Sequence[Any]) -> None:
            for each in found:
                if isinstance(each, Rows):
                    each.flush()

        def once(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            found = given(context, builder, signature, values)
            said = function(*found)
            flush(found)
            return ir.IntType(1)(1) if said is None else said.everywhere

        def looped(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            *found, begin, end = given(context, builder, signature, values)
            before = builder.block
            found = [Kept(each, before) if name in kept else each for name, each in zip(arguments, found, strict=False)]
            with cgutils.for_range_slice(builder, begin.value, end.value, begin.value.type(1)) as (index, _):
                function(*found, Index(builder, index))
                flush([each for each in found if not isinstance(each, Kept)])
            flush([each for each in found if isinstance(each, Kept)])
            return ir.IntType(1)(1)

        return types.boolean(lane, types.StarArgTuple(kinds)), looped if kept else once  # type: ignore[attr-defined]

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


def turning(width: int) -> Callable[..., None]:
    """Return ``turn(x, i, j, y, k, l)``, which copies a square of a matrix, turned, into another matrix.

    Rows i, i + 1, ... of x from column j on, `width` of both, become columns l, l + 1, ... of y from row k on, rounded
    to its precision. The numbers of a row are neighbours, and nothing is checked.
    """

    def turn(typing: Any, x: Any, i: Any, j: Any, y: Any, k: Any, l: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            given: list[Any] = []
            for which in (0, 3):
                kind = signature.args[which]
                array = make_array(kind)(context, builder, values[which])
                first = cgutils.get_item_pointer(context, builder, kind, array, values[which + 1 : which + 3])
                byte = ir.IntType(8).as_pointer()
                given += [builder.bitcast(first, byte), cgutils.unpack_tuple(builder, array.strides)[0]]
            kinds = [context.get_data_type(each.dtype) for each in (x, y)]
            builder.call(_turner(builder.module, width, kinds, [number.type for number in given]), given)
            return context.get_dummy_value()

        return types.void(x, types.intp, types.intp, y, types.intp, types.intp), code

    made: Callable[..., None] = intrinsic(turn)
    return made


def _turner(module: Any, width: int, kinds: Sequence[Any], arguments: Sequence[Any]) -> Any:
    """Return the function that turns a square, called and never inlined: loops around it are unrolled otherwise."""
    name = f"servoscope_turn_{width}_" + "_".join(kind.intrinsic_name for kind in kinds)
    if name in module.globals:
        return module.globals[name]
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), arguments), name)
    function.linkage = "internal"
    function.attributes.add("noinline")
    builder = ir.IRBuilder(function.append_basic_block())
    places: list[list[Any]] = []
    for which, kind in enumerate(kinds):
        first, stride = function.args[2 * which : 2 * which + 2]
        rows = [builder.gep(first, [builder.mul(stride, stride.type(n))]) for n in range(width)]
        places.append([builder.bitcast(row, ir.VectorType(kind, width).as_pointer()) for row in rows])
    found = turned(builder, [builder.load(place, align=ALIGNED) for place in places[0]])
    for column, place in zip(found, places[1], strict=True):
        like = Number(builder, ir.Constant(ir.VectorType(kinds[1], width), ir.Undefined))
        builder.store(like.like(Number(builder, column)), place, align=ALIGNED)
    builder.ret_void()
    return function


@intrinsic
def ahead(typing: Any, x: Any, i: Any, j: Any) -> Any:
    """Fetch element (i, j) of an array, which need not exist, into the cache."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        array = make_array(signature.args[0])(context, builder, values[0])
        place = cgutils.get_item_pointer(context, builder, signature.args[0], array, values[1:])
        byte, number = ir.IntType(8).as_pointer(), ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [byte, number, number, number])
        fetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], kind)
        builder.call(fetch, [builder.bitcast(place, byte), number(0), number(3), number(1)])
        return context.get_dummy_value()

    return types.void(x, types.intp, types.intp), code
