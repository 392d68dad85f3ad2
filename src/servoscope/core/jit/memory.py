"""Memory as traced arithmetic reads and stores it in LLVM's assembly, and steps of it, once or in a loop."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from servoscope.core.jit.llvm_text import LlvmPrinter, TextLoop, vector
from servoscope.core.jit.symbolic import Bool, Float, Int, SymbolRows


@dataclass(frozen=True)
class Memory:
    """Numbers in rows of some lanes; a `shared` memory has one lane for all, masks do not matter to a `scratch` one."""

    printer: LlvmPrinter
    base: str
    element: str
    lanes: int = 1
    shared: bool = False
    scratch: bool = False

    @property
    def kind(self) -> str:
        """The type of a row."""
        return vector(self.element, self.lanes)

    def place(self, row: Int | int) -> str:
        """Return where a row begins."""
        return self.printer.place(self.element, self.base, row if self.shared else row * self.lanes)

    def load(self, row: Int | int) -> str:
        """Read a row."""
        if self.shared:
            return self.printer.broadcast(self.element, self.printer.load(self.element, self.place(row)), self.lanes)
        return self.printer.load(self.kind, self.place(row))

    def store(self, row: Int | int, text: str) -> None:
        """Write a row."""
        self.printer.store(self.kind, text, self.place(row))

    def behind(self, rows: Int | int) -> Memory:
        """Return the memory from a row on."""
        return Memory(self.printer, self.place(rows), self.element, self.lanes, self.shared, self.scratch)

    def regrouped(self, lanes: int, shared: bool = False) -> Memory:
        """Return the same numbers in rows of other lanes."""
        return Memory(self.printer, self.base, self.element, lanes, shared, self.scratch)


class RegisterRows(SymbolRows):
    """SymbolRows that a loop keeps in registers: read once before it, stored once behind it."""

    def __init__(self, memory: Memory, loop: TextLoop) -> None:
        super().__init__(memory)
        self._loop = loop
        self._first: dict[int, str] = {}

    def _load(self, row: int | Int) -> Float:
        assert isinstance(row, int)
        printer, loop = self.memory.printer, self._loop
        with printer.at(loop.entry):
            before = self.memory.load(row)
        printer._count += 1
        name = self._first[row] = f"%v{printer._count}"
        loop.carried.append(
            lambda latch: (
                f"  {name} = phi {self.kind} [ {before}, %{loop.before} ], [ {self.values[row].text}, %{latch} ]"
            )
        )
        return Float(printer, name, self.kind)

    def __setitem__(self, row: int | Int, number: Any) -> None:
        self[row]  # its value before the loop counts where there is no round
        super().__setitem__(row, number)

    def flush(self, mask: Bool | None = None) -> None:
        """Store what was written, behind the loop."""
        for row in sorted(self.written):
            self.memory.store(row, self._first[row])


def apply(step: Callable[..., Any], *arguments: Any, mask: Bool | None = None) -> Any:
    """Write a step of traced arithmetic; its memories arrive as rows. It changes only lanes in which `mask` holds."""
    symbols = [SymbolRows(x) if isinstance(x, Memory) else x for x in arguments]
    result = step(*symbols)
    for symbol in symbols:
        if isinstance(symbol, SymbolRows):
            symbol.flush(None if symbol.memory.scratch else mask)
    return result


def repeat(
    step: Callable[..., Any], begin: Int | int, end: Int | int, *arguments: Any, kept: Sequence[Memory] = ()
) -> None:
    """Write a step, whose last argument runs from one number up to another, as a loop; `kept` stay in registers."""
    printer = next(x.printer for x in arguments if isinstance(x, Memory))
    carried: list[RegisterRows] = []
    for number, loop in printer.carrying_loop(begin, end):
        carried = [RegisterRows(x, loop) for x in kept]
        by_place = {rows.memory.base: rows for rows in carried}
        symbols = [by_place.get(x.base) or SymbolRows(x) if isinstance(x, Memory) else x for x in arguments]
        step(*symbols, number)
        for symbol in symbols:
            if isinstance(symbol, SymbolRows) and not isinstance(symbol, RegisterRows):
                symbol.flush()
    for rows in carried:
        rows.flush()
