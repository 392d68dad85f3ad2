"""Traced arithmetic as LLVM's assembly: operations, memory, and the loops and branches around them.

A function is written from front to back into one list of lines. A loop is a ``for`` statement over `LlvmPrinter.loop`,
which runs its body once, a branch a ``with`` statement; numbers that change in them are `arrays.Variable`s.
"""

from __future__ import annotations

import contextlib
import functools
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from servoscope.core.jit.symbolic import Bool, Float, Int

CACHE_LINE = 64  # bytes: a vector must not straddle two cache lines
BYTES = {"double": 8, "float": 4, "i8": 1, "i32": 4, "i64": 8}
SUFFIX = {"double": "f64", "float": "f32"}
COMPARISONS = {"<": "lt", "<=": "le", ">": "gt", ">=": "ge", "==": "eq"}
FLAGS = "nnan nsz "  # of maximum and minimum: without them none could be vectorised


def vector(element: str, lanes: int) -> str:
    """Return the type of so many numbers side by side."""
    return element if lanes == 1 else f"<{lanes} x {element}>"


@functools.cache
def _split(kind: str) -> tuple[str, int]:
    """Return element and lanes of a type."""
    if not kind.startswith("<"):
        return kind, 1
    lanes, _, element = kind[1:-1].partition(" x ")
    return element, int(lanes)


@functools.cache
def _constant(number: float, kind: str) -> str:
    element, lanes = _split(kind)
    if element == "float":
        with np.errstate(over="ignore"):
            number = float(np.float32(number))
    text = f"0x{struct.pack('>d', number).hex().upper()}"
    return text if lanes == 1 else f"<{', '.join([f'{element} {text}'] * lanes)}>"


@dataclass
class TextLoop:
    """A loop that is being written: what stands before it, and what its head carries from round to round."""

    before: str  # label of the block from which it is entered
    entry: list[Any] = field(default_factory=list)
    carried: list[Callable[[str], str]] = field(default_factory=list)  # label of the last block -> line


class LlvmPrinter:
    """Writes one function, of pointers and whole numbers, or numbers in double precision."""

    def __init__(self, arguments: Sequence[tuple[str, str]], result: str = "void") -> None:
        self._declarations: set[str] = set()
        self._stack: list[str] = []
        self._lines: list[Any] = []
        self._loops: list[int] = []
        self._count = 0
        self._block = "entry"
        kinds = [f"{kind}{' noalias' * (kind == 'ptr')} %{name}" for name, kind in arguments]
        self._parameters, self.result = ", ".join(kinds), result

    def text(self) -> str:
        """Return the whole module."""
        lines: list[str] = []

        def flatten(items: list[Any]) -> None:
            for item in items:
                flatten(item) if isinstance(item, list) else lines.append(item)

        flatten(self._lines)
        head = f"define internal {self.result} @run({self._parameters}) noinline {{\nentry:"
        return "\n".join([*sorted(self._declarations), head, *self._stack, *lines, "}", *self._metadata()])

    def _metadata(self) -> list[str]:
        """Return the nodes that say of each loop that it is not to be unrolled."""
        return ['!0 = !{!"llvm.loop.unroll.disable"}', *(f"!{k} = distinct !{{!{k}, !0}}" for k in self._loops)]

    def assign(self, text: str) -> str:
        """Write an instruction that has a result; return its name."""
        self._count += 1
        self._lines.append(f"  %v{self._count} = {text}")
        return f"%v{self._count}"

    def write(self, text: str) -> None:
        """Write an instruction that has none."""
        self._lines.append(f"  {text}")

    # operations

    def constant(self, number: float, kind: str) -> str:
        """Return a constant, bit by bit."""
        return _constant(number, kind)

    def operate(self, name: str, kind: str, a: str, b: str) -> str:
        """Write an operation on two numbers, or conditions."""
        return self.assign(f"{name} {kind} {a}, {b}")

    def negate(self, kind: str, a: str) -> str:
        """Write -a."""
        return self.assign(f"fneg {kind} {a}")

    def convert(self, kind: str, a: str, target: str) -> str:
        """Write a number in another precision."""
        word = "fpext" if _split(target)[0] == "double" else "fptrunc"
        return self.assign(f"{word} {kind} {a} to {target}")

    def compare(self, sign: str, kind: str, a: str, b: str) -> str:
        """Write a comparison, which does not hold where one of the two is NaN."""
        return self.assign(f"fcmp o{COMPARISONS[sign]} {kind} {a}, {b}")

    def compare_whole(self, sign: str, a: str, b: str) -> str:
        """Write a comparison of whole numbers."""
        return self.assign(f"icmp {'s' * (sign != '==')}{COMPARISONS[sign]} i64 {a}, {b}")

    def select(self, condition_kind: str, condition: str, kind: str, a: str, b: str) -> str:
        """Write a where the condition holds, b where not."""
        return self.assign(f"select {condition_kind} {condition}, {kind} {a}, {kind} {b}")

    def call(self, name: str, kind: str, arguments: Sequence[str]) -> str:
        """Write a call of one of LLVM's own functions."""
        element, lanes = _split(kind)
        function = f"@llvm.{name}.{f'v{lanes}' * (lanes > 1)}{SUFFIX[element]}"
        self._declarations.add(f"declare {kind} {function}({', '.join([kind] * len(arguments))})")
        flags = FLAGS if name in ("maxnum", "minnum") else ""
        return self.assign(f"call {flags}{kind} {function}({', '.join(f'{kind} {x}' for x in arguments)})")

    def call_library(self, name: str, number: Float) -> Float:
        """Write a call of a function of C's library."""
        self._declarations.add(f"declare double @{name}(double)")
        return Float(self, self.assign(f"call double @{name}(double {number.text})"), "double")

    # conditions and lanes

    def holds(self, name: str, condition: Bool) -> Bool:
        """Return whether a condition holds in all lanes ("and"), or in any ("or")."""
        lanes = _split(condition.kind)[1]
        if lanes == 1:
            return condition
        function = f"@llvm.vector.reduce.{name}.v{lanes}i1"
        self._declarations.add(f"declare i1 {function}({condition.kind})")
        return Bool(self, self.assign(f"call i1 {function}({condition.kind} {condition.text})"), "i1")

    def opposite(self, kind: str, condition: str) -> str:
        """Write that a condition does not hold."""
        lanes = _split(kind)[1]
        true = "true" if lanes == 1 else f"<{', '.join(['i1 true'] * lanes)}>"
        return self.assign(f"xor {kind} {condition}, {true}")

    def broadcast(self, element: str, text: str, lanes: int) -> str:
        """Write a vector of copies of a value."""
        if lanes == 1:
            return text
        kind = vector(element, lanes)
        first = self.assign(f"insertelement {kind} poison, {element} {text}, i64 0")
        return self.assign(f"shufflevector {kind} {first}, {kind} poison, <{lanes} x i32> zeroinitializer")

    def gather(self, element: str, texts: Sequence[str]) -> str:
        """Write a vector of values."""
        if len(texts) == 1:
            return texts[0]
        kind, gathered = vector(element, len(texts)), "poison"
        for lane, text in enumerate(texts):
            gathered = self.assign(f"insertelement {kind} {gathered}, {element} {text}, i64 {lane}")
        return gathered

    def transpose(self, kind: str, rows: Sequence[str]) -> list[str]:
        """Write the columns of a square matrix that is given by its rows, all as vectors (Eklundh, 1972)."""
        width, lanes, apart = len(rows), list(rows), 1
        while apart < width:
            first = [j + (width - apart if j & apart else 0) for j in range(width)]
            masks = [", ".join(f"i32 {j + shift}" for j in first) for shift in (0, apart)]
            for i in range(width):
                if not i & apart:
                    pair = f"{kind} {lanes[i]}, {kind} {lanes[i + apart]}"
                    lanes[i], lanes[i + apart] = (
                        self.assign(f"shufflevector {pair}, <{width} x i32> <{mask}>") for mask in masks
                    )
            apart *= 2
        return lanes

    # memory

    def place(self, element: str, base: str, index: Int | int) -> str:
        """Return the place of an element behind another one."""
        return self.assign(f"getelementptr {element}, ptr {base}, i64 {index}")

    def load(self, kind: str, place: str) -> str:
        """Read numbers at a place."""
        return self.assign(f"load {kind}, ptr {place}, align {BYTES[_split(kind)[0]]}")

    def store(self, kind: str, text: str, place: str) -> None:
        """Write numbers to a place."""
        self.write(f"store {kind} {text}, ptr {place}, align {BYTES[_split(kind)[0]]}")

    def prefetch(self, place: str) -> None:
        """Fetch a place, which need not exist, into the cache."""
        self._declarations.add("declare void @llvm.prefetch.p0(ptr, i32, i32, i32)")
        self.write(f"call void @llvm.prefetch.p0(ptr {place}, i32 0, i32 3, i32 1)")

    def argument(self, name: str) -> Int:
        """Return a whole number that the function is called with."""
        return Int(self, f"%{name}")

    def truncate(self, number: Float) -> Int:
        """Return a number without what follows its point."""
        return Int(self, self.assign(f"fptosi {number.kind} {number.text} to i64"))

    def number(self, whole: Int) -> Float:
        """Return a whole number as a number."""
        return Float(self, self.assign(f"sitofp i64 {whole} to double"), "double")

    def stack(self, element: str, size: int) -> str:
        """Return the place of numbers of this call, not filled."""
        self._count += 1
        self._stack.append(f"  %v{self._count} = alloca [{max(size, 1)} x {element}], align {CACHE_LINE}")
        return f"%v{self._count}"

    # loops and branches

    def _label(self, name: str) -> str:
        self._count += 1
        return f"{name}{self._count}"

    def _begin(self, label: str) -> None:
        self._lines.append(f"{label}:")
        self._block = label

    @contextlib.contextmanager
    def when(self, condition: Bool) -> Iterator[None]:
        """Write what happens only where a condition, of one lane, holds."""
        inside, after = self._label("then"), self._label("after")
        self.write(f"br i1 {condition.text}, label %{inside}, label %{after}")
        self._begin(inside)
        yield
        self.write(f"br label %{after}")
        self._begin(after)

    def loop(self, begin: Int | int, end: Int | int, step: int = 1) -> Iterator[Int]:
        """Write a loop over whole numbers."""
        for number, _ in self.carrying_loop(begin, end, step):
            yield number

    def carrying_loop(self, begin: Int | int, end: Int | int, step: int = 1) -> Iterator[tuple[Int, TextLoop]]:
        """Write a loop that may carry numbers in registers."""
        loop, head, inside, after = TextLoop(self._block), *map(self._label, ("head", "body", "after"))
        self._lines.append(loop.entry)
        self.write(f"br label %{head}")
        self._begin(head)
        phis: list[Any] = []
        self._lines.append(phis)
        self._count += 1
        number = Int(self, f"%v{self._count}")
        inside_too = self.compare_whole("<", str(number), str(end))
        self.write(f"br i1 {inside_too}, label %{inside}, label %{after}")
        self._begin(inside)
        yield number, loop
        following, latch = number + step, self._block
        phis.append(f"  {number} = phi i64 [ {begin}, %{loop.before} ], [ {following}, %{latch} ]")
        phis.extend(line(latch) for line in loop.carried)
        self._back(head)
        self._begin(after)

    def loop_while(self, condition: Callable[[], Bool]) -> Iterator[None]:
        """Write a loop that goes on while a condition holds."""
        head, inside, after = map(self._label, ("head", "body", "after"))
        self.write(f"br label %{head}")
        self._begin(head)
        self.write(f"br i1 {condition().text}, label %{inside}, label %{after}")
        self._begin(inside)
        yield
        self._back(head)
        self._begin(after)

    def _back(self, head: str) -> None:
        self._count += 1
        self._loops.append(self._count)
        self.write(f"br label %{head}, !llvm.loop !{self._count}")

    @contextlib.contextmanager
    def at(self, lines: list[Any]) -> Iterator[None]:
        """Write into another list of lines."""
        kept, self._lines = self._lines, lines
        yield
        self._lines = kept
