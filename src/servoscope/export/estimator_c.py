"""The update of an estimator as C: its Python text, statement by statement, with one operation each.

Estimators whose P moves are written with loops and branches over small arrays; those few kinds of statements are all
that is translated. What is none of them is refused, by the name of the estimator and the line.
"""

from __future__ import annotations

import ast
import inspect
import sys
import textwrap
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, NoReturn

from servoscope.core.errors import BaselineError
from servoscope.core.jit.c_source import c_literal

__all__ = ["translate_update"]

ARRAYS = ("theta", "P", "P_d", "phi", "z", "K", "extra")
NUMBERS = ("R", "memory", "eta")
OPERATORS: dict[type[ast.AST], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
COMPARISONS: dict[type[ast.AST], str] = {
    ast.Lt: "<",
    ast.LtE: "<=",
    ast.Gt: ">",
    ast.GtE: ">=",
    ast.Eq: "==",
    ast.NotEq: "!=",
}
NAMED = {"np.inf": float("inf"), "np.e": 2.718281828459045, "np.finfo(P.dtype).max": sys.float_info.max}


@dataclass
class _Value:
    kind: str  # "number", "index" or "condition"
    text: str


def translate_update(module: ModuleType, n: int) -> str:
    """Return the body of ``int update(theta, P, P_d, R, memory, eta, phi, z, K, extra)`` for n coefficients.

    Raises
    ------
    BaselineError
        If the estimator is written with anything that has no counterpart here.
    """
    compiled = module.update
    function = getattr(compiled, "py_func", None) or inspect.unwrap(compiled)
    (definition,) = ast.parse(textwrap.dedent(inspect.getsource(function))).body
    assert isinstance(definition, ast.FunctionDef)
    translation = _Translation(module.NAME, n)
    translation.block(definition.body)
    return "\n".join([*translation.declarations(), *translation.lines])


@dataclass
class _Translation:
    estimator: str
    n: int
    lines: list[str] = field(default_factory=list)
    kinds: dict[str, str] = field(default_factory=lambda: dict.fromkeys(NUMBERS, "number"))
    arrays: set[str] = field(default_factory=set)
    depth: int = 1
    count: int = 0

    def declarations(self) -> list[str]:
        """Return the declarations of all variables, for a variable of Python lives through the whole function."""
        words = {"number": "double {} = 0.0;", "condition": "int {} = 0;", "index": "int {} = 0;"}
        own = [words[kind].format(name) for name, kind in self.kinds.items() if name not in NUMBERS]
        return [f"    {line}" for line in (*own, *(f"double {name}[{self.n}];" for name in sorted(self.arrays)))]

    def block(self, statements: list[ast.stmt]) -> None:
        """Write statements."""
        for statement in statements:
            self.statement(statement)

    def statement(self, node: ast.stmt) -> None:
        """Write one statement."""
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return  # the docstring
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            self.assign(node.targets[0], node.value)
        elif isinstance(node, ast.AugAssign):
            self.store(node.target, self.operate(node, self.value(node.target), node.op, self.value(node.value)))
        elif isinstance(node, ast.For):
            self.loop(node)
        elif isinstance(node, ast.If):
            self.write(f"if ({self.value(node.test).text} != 0) {{")
            self.indented(node.body)
            if node.orelse:
                self.write("} else {")
                self.indented(node.orelse)
            self.write("}")
        elif isinstance(node, ast.Return) and node.value is not None:
            value = self.value(node.value)
            self.write(f"return {value.text};")
        else:
            self.refuse(node)

    def loop(self, node: ast.For) -> None:
        """Write a loop over ``range``."""
        target, over = node.target, node.iter
        known = isinstance(target, ast.Name) and isinstance(over, ast.Call) and ast.unparse(over.func) == "range"
        if not known or len(over.args) > 2:  # type: ignore[attr-defined]
            self.refuse(node)
        ends = [self.value(x).text for x in over.args]  # type: ignore[attr-defined]
        name = target.id  # type: ignore[attr-defined]
        begin, end = ends if len(ends) == 2 else ("0", ends[0])
        self.kinds[name] = "index"
        self.write(f"for ({name} = {begin}; {name} < {end}; {name}++) {{")
        self.indented(node.body)
        self.write("}")

    def assign(self, target: ast.expr, value: ast.expr) -> None:
        """Write an assignment; an empty array becomes a declaration."""
        if isinstance(target, ast.Name):
            if ast.unparse(value) == "np.empty_like(theta)":
                self.arrays.add(target.id)
                return
            if ast.unparse(value) == "len(theta)":
                self.kinds[target.id] = "index"
                self.write(f"{target.id} = {self.n};")
                return
        self.store(target, self.value(value))

    def store(self, target: ast.expr, value: _Value) -> None:
        """Write a value to a variable or to an element."""
        if isinstance(target, ast.Name):
            self.kinds.setdefault(target.id, value.kind)
            self.write(f"{target.id} = {value.text};")
        elif isinstance(target, ast.Subscript):
            self.write(f"{self.element(target)} = {self.number(value)};")
        else:
            self.refuse(target)

    def value(self, node: ast.expr) -> _Value:
        """Return an expression's value, after the statements that compute it."""
        if (text := ast.unparse(node)) in NAMED:
            return _Value("number", c_literal(NAMED[text]))
        if isinstance(node, ast.Constant) and isinstance(node.value, float | int):
            whole = isinstance(node.value, int)
            return _Value("index" if whole else "number", str(node.value) if whole else c_literal(node.value))
        if isinstance(node, ast.Name) and node.id in self.kinds:
            return _Value(self.kinds[node.id], node.id)
        if isinstance(node, ast.Subscript):
            return _Value("number", self.element(node))
        if isinstance(node, ast.BinOp):
            return self.operate(node, self.value(node.left), node.op, self.value(node.right))
        if isinstance(node, ast.UnaryOp):
            inner = self.value(node.operand)
            if isinstance(node.op, ast.Not):
                return _Value("condition", f"(({inner.text}) == 0)")
            if isinstance(node.op, ast.USub):
                return _Value(inner.kind, f"(-{inner.text})")
        if isinstance(node, ast.Compare):
            sides = [self.value(x) for x in (node.left, *node.comparators)]
            pairs = zip(sides[:-1], node.ops, sides[1:], strict=True)
            parts = [f"({self.both(a, b)[0]} {COMPARISONS[type(op)]} {self.both(a, b)[1]})" for a, op, b in pairs]
            return _Value("condition", f"({' && '.join(parts)})")
        if isinstance(node, ast.BoolOp):
            sign = " && " if isinstance(node.op, ast.And) else " || "
            return _Value("condition", f"({sign.join(f'({self.value(x).text} != 0)' for x in node.values)})")
        if isinstance(node, ast.IfExp):
            test, one, other = (self.value(x) for x in (node.test, node.body, node.orelse))
            if one.kind == other.kind == "index":
                return _Value("index", f"(({test.text} != 0) ? {one.text} : {other.text})")
            return self.keep(f"({test.text} != 0) ? {self.number(one)} : {self.number(other)}")
        if isinstance(node, ast.Call) and not node.keywords:
            return self.call(node)
        self.refuse(node)

    def call(self, node: ast.Call) -> _Value:
        """Return the value of one of the few functions that there are."""
        name, arguments = ast.unparse(node.func), [self.number(self.value(x)) for x in node.args]
        if name == "np.sqrt":
            return self.keep(f"sqrt({arguments[0]})")
        if name == "abs":
            return self.keep(f"fabs({arguments[0]})")
        if name in ("max", "min") and len(arguments) == 2:
            a, b = arguments
            return self.keep(f"({a} {'>' if name == 'max' else '<'} {b}) ? {a} : {b}")
        self.refuse(node)

    def operate(self, node: ast.AST, a: _Value, op: ast.operator, b: _Value) -> _Value:
        """Return the value of one operation; those of indices stand inside an index, those of numbers alone."""
        if type(op) not in OPERATORS:
            self.refuse(node)
        sign = OPERATORS[type(op)]
        if a.kind == b.kind == "index" and sign != "/":
            return _Value("index", f"({a.text} {sign} {b.text})")
        return self.keep(f"{self.number(a)} {sign} {self.number(b)}")

    def keep(self, text: str) -> _Value:
        """Return a number as a constant of its own."""
        self.count += 1
        self.write(f"const double t{self.count} = {text};")
        return _Value("number", f"t{self.count}")

    def element(self, node: ast.Subscript) -> str:
        """Return an element of an array."""
        name, index = ast.unparse(node.value), node.slice
        if name not in self.arrays and name not in ARRAYS:
            self.refuse(node)
        if isinstance(index, ast.Tuple):
            i, j = (self.value(x).text for x in index.elts)
            return f"{name}[{i} * {self.n} + {j}]"
        return f"{name}[{self.value(index).text}]"

    def both(self, a: _Value, b: _Value) -> tuple[str, str]:
        """Return two values as one type."""
        return (a.text, b.text) if a.kind == b.kind else (self.number(a), self.number(b))

    def number(self, value: _Value) -> str:
        """Return a value as a number."""
        return f"(double){value.text}" if value.kind == "index" else value.text

    def indented(self, statements: list[ast.stmt]) -> None:
        """Write the inside of a block."""
        self.depth += 1
        self.block(statements)
        self.depth -= 1

    def write(self, line: str) -> None:
        """Write a line."""
        self.lines.append("    " * self.depth + line)

    def refuse(self, node: Any) -> NoReturn:
        """Raise the error for what has no counterpart."""
        raise BaselineError(
            f"[monitor] estimator = {self.estimator!r} cannot be exported as C: line {getattr(node, 'lineno', 0)} of "
            f"its update, {ast.unparse(node).splitlines()[0]!r}, has no counterpart; take akf, which is exported whole"
        )
