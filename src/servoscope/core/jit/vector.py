"""Lanes of arrays as traced arithmetic reads and stores them."""

from __future__ import annotations

from typing import Any

from servoscope.core.jit.symbolic import Float, Int


class SimdRows:
    """One lane, or several neighbours, of an array (rows, lanes); a `shared` one has one lane for all.

    A row is read once, and `flush` stores what was written. Rows whose number is itself computed are read and stored
    at once; they must not be among the others.
    """

    def __init__(self, context: Any, builder: Any, kind: Any, array: Any, lane: Any, width: int, shared: bool) -> None:
        self._context, self._builder, self._kind, self._array, self._lane = context, builder, kind, array, lane
        self._width, self._shared = width, shared
        self._values: dict[int, Float] = {}
        self._written: set[int] = set()

    def _pointer(self, row: int | Int) -> Any:
        from llvmlite import ir
        from numba.core import cgutils, types

        number = row.value if isinstance(row, Int) else self._context.get_constant(types.intp, row)
        pointer = cgutils.get_item_pointer(self._context, self._builder, self._kind, self._array, (number, self._lane))
        if self._width == 1 or self._shared:
            return pointer
        element = self._context.get_data_type(self._kind.dtype)
        return self._builder.bitcast(pointer, ir.VectorType(element, self._width).as_pointer())

    def _load(self, row: int | Int) -> Float:
        width = self._context.get_abi_sizeof(self._context.get_data_type(self._kind.dtype))
        one = self._builder.load(self._pointer(row), align=width)
        if self._width > 1 and self._shared:
            one = broadcast_lanes(self._builder, one, self._width)
        return Float(self._builder, one)

    def _store(self, number: Float, row: int | Int) -> None:
        width = self._context.get_abi_sizeof(self._context.get_data_type(self._kind.dtype))
        self._builder.store(number.value, self._pointer(row), align=width)

    def __getitem__(self, row: int | Int) -> Float:
        if isinstance(row, Int):
            return self._load(row)
        if row not in self._values:
            self._values[row] = self._load(row)
        return self._values[row]

    def __setitem__(self, row: int | Int, number: Any) -> None:
        from llvmlite import ir

        element = self._context.get_data_type(self._kind.dtype)
        kind = element if self._width == 1 else ir.VectorType(element, self._width)
        as_stored = Float(self._builder, Float(self._builder, ir.Constant(kind, ir.Undefined)).to_operand(number))
        if isinstance(row, Int):
            self._store(as_stored, row)
            return
        self._values[row] = as_stored
        self._written.add(row)

    def flush(self) -> None:
        """Store what was written."""
        for row in sorted(self._written):
            self._store(self._values[row], row)


class RegisterRows(SimdRows):
    """Rows that a loop keeps in registers: read once before it, stored once behind it.

    `before` is the block of code from which the loop is entered.
    """

    def __init__(self, rows: SimdRows, before: Any) -> None:
        self.__dict__.update(rows.__dict__)
        self._before = before
        self._slots: dict[int, Any] = {}

    def _slot(self, row: int) -> Any:
        from numba.core import cgutils

        if row not in self._slots:
            with self._builder.goto_block(self._before):
                first = self._load(row).value
            self._slots[row] = cgutils.alloca_once(self._builder, first.type)  # the compiler makes it a register
            with self._builder.goto_block(self._before):
                self._builder.store(first, self._slots[row])
        return self._slots[row]

    def __getitem__(self, row: int | Int) -> Float:
        assert isinstance(row, int)
        return Float(self._builder, self._builder.load(self._slot(row)))

    def __setitem__(self, row: int | Int, number: Any) -> None:
        assert isinstance(row, int)
        slot = self._slot(row)
        self._builder.store(Float(self._builder, self._builder.load(slot)).to_operand(number), slot)
        self._written.add(row)

    def flush(self) -> None:
        """Store what was written."""
        for row in sorted(self._written):
            self._store(self[row], row)


def broadcast_lanes(builder: Any, one: Any, width: int) -> Any:
    """Return a vector of copies of a value."""
    from llvmlite import ir

    if width == 1:
        return one
    vector, index = ir.Constant(ir.VectorType(one.type, width), ir.Undefined), ir.IntType(32)
    first = builder.insert_element(vector, one, index(0))
    return builder.shuffle_vector(first, vector, ir.Constant(ir.VectorType(index, width), [index(0)] * width))


def transpose_vectors(builder: Any, rows: list[Any]) -> list[Any]:
    """Return the columns of a square matrix that is given by its rows, all as vectors (Eklundh, 1972)."""
    from llvmlite import ir

    width, index = len(rows), ir.IntType(32)
    rows, apart = list(rows), 1
    while apart < width:
        first = [j + (width - apart if j & apart else 0) for j in range(width)]
        masks = [ir.Constant(ir.VectorType(index, width), [index(j + shift) for j in first]) for shift in (0, apart)]
        for i in range(width):
            if not i & apart:
                pair = rows[i], rows[i + apart]
                rows[i], rows[i + apart] = (builder.shuffle_vector(*pair, mask) for mask in masks)
        apart *= 2
    return rows
