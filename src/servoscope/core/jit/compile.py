"""The backend that compiles kernels with Numba: strict arithmetic, cached on disk where a folder can be written."""

from __future__ import annotations

import contextlib
import inspect
import sys
from typing import TYPE_CHECKING, Any, TypeVar

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.event import Event, Listener, install_listener
from numba.extending import intrinsic
from numba.np.arrayobj import make_array, populate_array

from servoscope.core.jit.cache import KernelCache
from servoscope.core.jit.link import LinkOnlyCompiler
from servoscope.core.jit.symbolic import Bool, Float, Int
from servoscope.core.jit.vector import RegisterRows, SimdRows, broadcast_lanes, transpose_vectors

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

F = TypeVar("F", bound="Callable[..., object]")

CACHE_LINE = 64  # bytes: a vector must not straddle two cache lines
ALIGNMENT = 4  # bytes: all that is known of the address of a number


def kernel(function: F, heap: bool = True) -> F:
    """Compile a function on its first call; without a folder for the cache, for this process only.

    `heap` says whether it, or what it calls, allocates arrays; without, there is no counting of references either.
    """
    compiled = numba.njit(error_model="numpy", nogil=True, _nrt=heap, no_cfunc_wrapper=True)(function)
    compiled._cache = KernelCache(compiled)
    return compiled  # type: ignore[no-any-return]


def subroutine(function: F, heap: bool = False, always: bool = False) -> F:
    """Compile a part of kernels, never called from Python; `always` inlines it, else LLVM decides."""
    options = {"error_model": "numpy", "_nrt": heap, "forceinline": always, "pipeline_class": LinkOnlyCompiler}
    return numba.njit(no_cpython_wrapper=True, no_cfunc_wrapper=True, **options)(function)  # type: ignore[no-any-return]


def inline(function: F, heap: bool = False) -> F:
    """Compile a part of other kernels that is always inlined."""
    return subroutine(function, heap, always=True)


def trace_function(
    function: Callable[..., Bool | None], width: int = 1, shared: str = "", kept: Sequence[str] = ()
) -> Callable[..., bool]:
    """Return what kernels call as ``part(lane, ...)`` for a function of traced arithmetic.

    Arrays (rows, lanes) arrive as `width` lanes of them from `lane` on, integers as numbers of rows, booleans as
    conditions; `shared` names an argument that has one lane for all. The function runs once, with symbols, and leaves
    straight-line code of vectors. The part returns whether the function's condition holds in all lanes.

    With `kept`, names of arguments, that code is a loop: the part takes two numbers in the place of the function's
    last argument, which runs from one up to the other, and these arrays stay in registers meanwhile.
    """
    arguments = tuple(inspect.signature(function).parameters)

    def part(typing: Any, lane: Any, *kinds: Any) -> Any:
        def to_symbols(context: Any, builder: Any, signature: Any, values: Any) -> list[Any]:
            symbols: list[Any] = []
            for kind, value in zip(signature.args[1], cgutils.unpack_tuple(builder, values[1]), strict=True):
                if isinstance(kind, types.Array):
                    array = make_array(kind)(context, builder, value)
                    one = arguments[len(symbols)] == shared
                    symbols.append(SimdRows(context, builder, kind, array, values[0], width, one))
                elif isinstance(kind, types.Boolean):
                    condition = broadcast_lanes(builder, builder.trunc(value, ir.IntType(1)), width)
                    symbols.append(Bool(builder, condition))
                else:
                    symbols.append(Int(builder, value))
            return symbols

        def flush(symbols: Sequence[Any], kind: type[SimdRows]) -> None:
            for symbol in symbols:
                if type(symbol) is kind:
                    symbol.flush()

        def once(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            symbols = to_symbols(context, builder, signature, values)
            condition = function(*symbols)
            flush(symbols, SimdRows)
            return ir.IntType(1)(1) if condition is None else condition.all_lanes

        def looped(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            *symbols, begin, end = to_symbols(context, builder, signature, values)
            before = builder.block
            symbols = [
                RegisterRows(symbol, before) if name in kept else symbol
                for name, symbol in zip(arguments, symbols, strict=False)
            ]
            with cgutils.for_range_slice(builder, begin.value, end.value, begin.value.type(1)) as (index, _):
                function(*symbols, Int(builder, index))
                flush(symbols, SimdRows)
            flush(symbols, RegisterRows)
            return ir.IntType(1)(1)

        return types.boolean(lane, types.StarArgTuple(kinds)), looped if kept else once  # type: ignore[attr-defined]

    made: Callable[..., bool] = intrinsic(part)
    return made


def _make_array(context: Any, builder: Any, kind: Any, data: Any, shape: Any, strides: Any) -> Any:
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
def stack_array(typing: Any, like: Any, rows: Any, columns: Any) -> Any:
    """Return an array (rows, columns) on the stack, not filled, of the precision of another; sizes are literals.

    With constant indices the compiler keeps it in registers, as it would an array of C.
    """
    shape = (rows.literal_value, columns.literal_value)
    kind = types.Array(like.dtype, 2, "C")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        number = context.get_data_type(kind.dtype)
        block = cgutils.alloca_once(builder, ir.ArrayType(number, max(shape[0] * shape[1], 1)))
        block.align = CACHE_LINE
        width = context.get_abi_sizeof(number)
        data = builder.bitcast(block, number.as_pointer())
        return _make_array(context, builder, kind, data, shape, (shape[1] * width, width))

    return kind(like, rows, columns), code


@intrinsic(prefer_literal=True)
def lane_view(typing: Any, flat: Any, lanes: Any, own: Any) -> Any:
    """Return a view (rows, lanes) of a contiguous array; with own = 0 all lanes share one column."""
    count, apart = lanes.literal_value, own.literal_value
    kind = types.Array(flat.dtype, 2, "A")

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        source = make_array(signature.args[0])(context, builder, values[0])
        width = context.get_abi_sizeof(context.get_data_type(kind.dtype))
        columns = count if apart else 1
        rows = builder.udiv(source.nitems, context.get_constant(types.intp, columns))
        return _make_array(context, builder, kind, source.data, (rows, count), (columns * width, apart * width))

    return kind(flat, lanes, own), code


def make_transpose(width: int) -> Callable[..., None]:
    """Return ``transpose(x, i, j, y, k, l)``, which copies a square block of a matrix, transposed, into another one.

    Rows i, i + 1, ... of x from column j on, `width` of both, become columns l, l + 1, ... of y from row k on, rounded
    to its precision. The numbers of a row are neighbours in memory, and no bounds are checked.
    """

    def transpose(typing: Any, x: Any, i: Any, j: Any, y: Any, k: Any, l: Any) -> Any:
        def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            arguments: list[Any] = []
            for which in (0, 3):
                kind = signature.args[which]
                array = make_array(kind)(context, builder, values[which])
                first = cgutils.get_item_pointer(context, builder, kind, array, values[which + 1 : which + 3])
                byte = ir.IntType(8).as_pointer()
                arguments += [builder.bitcast(first, byte), cgutils.unpack_tuple(builder, array.strides)[0]]
            kinds = [context.get_data_type(each.dtype) for each in (x, y)]
            function = _transpose_function(builder.module, width, kinds, [value.type for value in arguments])
            builder.call(function, arguments)
            return context.get_dummy_value()

        return types.void(x, types.intp, types.intp, y, types.intp, types.intp), code

    made: Callable[..., None] = intrinsic(transpose)
    return made


def _transpose_function(module: Any, width: int, kinds: Sequence[Any], arguments: Sequence[Any]) -> Any:
    """Return the function that transposes, called and never inlined: loops around it would be unrolled otherwise."""
    name = f"servoscope_transpose_{width}_" + "_".join(kind.intrinsic_name for kind in kinds)
    if name in module.globals:
        return module.globals[name]
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), arguments), name)
    function.linkage = "internal"
    function.attributes.add("noinline")
    builder = ir.IRBuilder(function.append_basic_block())
    pointers: list[list[Any]] = []
    for which, kind in enumerate(kinds):
        first, stride = function.args[2 * which : 2 * which + 2]
        rows = [builder.gep(first, [builder.mul(stride, stride.type(n))]) for n in range(width)]
        pointers.append([builder.bitcast(row, ir.VectorType(kind, width).as_pointer()) for row in rows])
    columns = transpose_vectors(builder, [builder.load(pointer, align=ALIGNMENT) for pointer in pointers[0]])
    for column, pointer in zip(columns, pointers[1], strict=True):
        target = Float(builder, ir.Constant(ir.VectorType(kinds[1], width), ir.Undefined))
        builder.store(target.to_operand(Float(builder, column)), pointer, align=ALIGNMENT)
    builder.ret_void()
    return function


@intrinsic
def prefetch(typing: Any, x: Any, i: Any, j: Any) -> Any:
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


@intrinsic
def load_word(typing: Any, data: Any, i: Any) -> Any:
    """Return bytes i to i + 7 of an array of bytes as a word, the first of them lowest."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        array = make_array(signature.args[0])(context, builder, values[0])
        place = builder.bitcast(builder.gep(array.data, [values[1]]), ir.IntType(64).as_pointer())
        word = builder.load(place, align=1)
        return word if sys.byteorder == "little" else builder.bswap(word)

    return types.uint64(data, types.intp), code


@intrinsic
def as_float(typing: Any, word: Any) -> Any:
    """Return the number whose bits a word is: binary64, or binary32 of one of 32 bits."""
    kind = types.float64 if word.bitwidth == 64 else types.float32

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.bitcast(values[0], context.get_data_type(kind))

    return kind(word), code


@intrinsic
def multiply_high(typing: Any, a: Any, b: Any) -> Any:
    """Return the upper 64 bits of the product of two words."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        wide = ir.IntType(128)
        product = builder.mul(*(builder.zext(value, wide) for value in values))
        return builder.trunc(builder.lshr(product, wide(64)), ir.IntType(64))

    return types.uint64(types.uint64, types.uint64), code


@intrinsic
def leading_zeros(typing: Any, word: Any) -> Any:
    """Return how many bits of a word are zero above its highest one; 64: all."""
    return types.uint64(types.uint64), lambda context, builder, signature, values: builder.ctlz(
        values[0], ir.IntType(1)(0)
    )


@intrinsic
def trailing_zeros(typing: Any, word: Any) -> Any:
    """Return how many bits of a word are zero below its lowest one; 64: all."""
    return types.uint64(types.uint64), lambda context, builder, signature, values: builder.cttz(
        values[0], ir.IntType(1)(0)
    )


@contextlib.contextmanager
def on_compilation(call: Callable[[], None]) -> Iterator[None]:
    """Call a function whenever machine code is made that is not in the cache yet."""

    class CompilationListener(Listener):  # type: ignore[misc]
        def on_start(self, event: Event) -> None:
            call()

        def on_end(self, event: Event) -> None:
            pass  # it has to be there

    with install_listener("numba:compile", CompilationListener()):
        yield
