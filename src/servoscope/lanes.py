"""Lanes of arrays, as the code that `servoscope.arithmetic` writes reads and stores them."""

from __future__ import annotations

from typing import Any

from servoscope.arithmetic import Index, Number

__all__ = ["Kept", "Rows", "lanes_of"]


class Rows:
    """One lane, or several neighbours, of an array (rows, lanes); where `shared`, all lanes are one.

    A row is read once, and what was written is stored by `flush`. Rows whose number is itself
    computed are read and stored at once; they must not be among the others.
    """

    def __init__(self, context: Any, builder: Any, kind: Any, array: Any, lane: Any, width: int, shared: bool) -> None:
        self._context, self._builder, self._kind, self._array, self._lane = context, builder, kind, array, lane
        self._width, self._shared = width, shared
        self._known: dict[int, Number] = {}
        self._written: set[int] = set()

    def _place(self, row: int | Index) -> Any:
        from llvmlite import ir
        from numba.core import cgutils, types

        number = row.value if isinstance(row, Index) else self._context.get_constant(types.intp, row)
        place = cgutils.get_item_pointer(self._context, self._builder, self._kind, self._array, (number, self._lane))
        if self._width == 1 or self._shared:
            return place
        element = self._context.get_data_type(self._kind.dtype)
        return self._builder.bitcast(place, ir.VectorType(element, self._width).as_pointer())

    def _load(self, row: int | Index) -> Number:
        width = self._context.get_abi_sizeof(self._context.get_data_type(self._kind.dtype))
        one = self._builder.load(self._place(row), align=width)
        if self._width > 1 and self._shared:
            one = lanes_of(self._builder, one, self._width)
        return Number(self._builder, one)

    def _store(self, number: Number, row: int | Index) -> None:
        width = self._context.get_abi_sizeof(self._context.get_data_type(self._kind.dtype))
        self._builder.store(number.value, self._place(row), align=width)

    def __getitem__(self, row: int | Index) -> Number:
        if isinstance(row, Index):
            return self._load(row)
        if row not in self._known:
            self._known[row] = self._load(row)
        return self._known[row]

    def __setitem__(self, row: int | Index, number: Any) -> None:
        from llvmlite import ir

        element = self._context.get_data_type(self._kind.dtype)
        kind = element if self._width == 1 else ir.VectorType(element, self._width)
        as_stored = Number(self._builder, Number(self._builder, ir.Constant(kind, ir.Undefined)).like(number))
        if isinstance(row, Index):
            self._store(as_stored, row)
            return
        self._known[row] = as_stored
        self._written.add(row)

    def flush(self) -> None:
        """Store what was written."""
        for row in sorted(self._written):
            self._store(self._known[row], row)


class Kept(Rows):
    """Rows that a loop keeps in registers: read once before it, stored once behind it.

    Parameters
    ----------
    rows
        The array, and which lanes of it.
    before
        Block of code from which the loop is entered.
    """

    def __init__(self, rows: Rows, before: Any) -> None:
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

    def __getitem__(self, row: int | Index) -> Number:
        assert isinstance(row, int)
        return Number(self._builder, self._builder.load(self._slot(row)))

    def __setitem__(self, row: int | Index, number: Any) -> None:
        assert isinstance(row, int)
        slot = self._slot(row)
        self._builder.store(Number(self._builder, self._builder.load(slot)).like(number), slot)
        self._written.add(row)

    def flush(self) -> None:
        """Store what was written."""
        for row in sorted(self._written):
            self._store(self[row], row)


def lanes_of(builder: Any, one: Any, width: int) -> Any:
    """Return a value as a vector of so many."""
    from llvmlite import ir

    if width == 1:
        return one
    several, index = ir.Constant(ir.VectorType(one.type, width), ir.Undefined), ir.IntType(32)
    alone = builder.insert_element(several, one, index(0))
    return builder.shuffle_vector(alone, several, ir.Constant(ir.VectorType(index, width), [index(0)] * width))


def turned(builder: Any, rows: list[Any]) -> list[Any]:
    """Return a square of numbers, given as the vectors of its rows, as the vectors of its columns (Eklundh, 1972)."""
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
