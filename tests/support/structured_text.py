"""Structured Text translated back to Python, for tests: the few statements that exported function blocks consist of."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

VARIABLE = re.compile(r"(?P<names>[\w, ]+?)\s*:\s*(?P<kind>[^:=;]+?)\s*(?::=\s*(?P<value>.+?))?;", re.DOTALL)
SIZE = re.compile(r"ARRAY\[0\.\.(\d+)\] OF LREAL")
STATEMENTS = (
    (re.compile(r"(.+?) := (.+);"), r"\1 = \2"),
    (re.compile(r"IF (.+) THEN"), r"if \1:"),
    (re.compile(r"ELSIF (.+) THEN"), r"elif \1:"),
    (re.compile(r"ELSE"), "else:"),
    (re.compile(r"FOR (\w+) := (.+) TO (.+) DO"), r"for \1 in range(\2, \3 + 1):"),
    (re.compile(r"END_(?:IF|FOR);"), ""),
)
WORDS = {"AND": "and", "OR": "or", "NOT": "not", "TRUE": "True", "FALSE": "False", "ABS": "abs"}
FUNCTIONS: dict[str, Any] = {
    "SEL": lambda g, in0, in1: in1 if g else in0,
    "SQRT": lambda x: float(np.sqrt(x)),
    "TRUNC": int,
    "DINT_TO_LREAL": float,
}
PYTHON = "if", "elif", "else", "for", "in", "range"
DECLARED = "VAR_INPUT|VAR_OUTPUT|VAR RETAIN|VAR CONSTANT|VAR_TEMP|VAR"


class FunctionBlock:
    """An instance of a function block: `variables` by name, and a call."""

    def __init__(self, text: str) -> None:
        text = re.sub(r"\(\*.*?\*\)", "", text, flags=re.DOTALL)
        match = re.fullmatch(r"\s*FUNCTION_BLOCK (\w+)\n(.*)END_FUNCTION_BLOCK\s*", text, re.DOTALL)
        assert match, "no function block"
        self.name, rest = match.groups()
        self.variables: dict[str, Any] = {}
        self.kinds: dict[str, str] = {}
        self.sections: dict[str, list[str]] = {}
        while section := re.match(rf"\s*({DECLARED})\n(.*?)END_VAR\n", rest, re.DOTALL):
            self.sections[section[1]] = list(self._declare(section[2]))
            rest = rest[section.end() :]
        self._run = self._translate(rest)

    def _declare(self, text: str) -> Any:
        end = 0
        for found in VARIABLE.finditer(text):
            assert not text[end : found.start()].strip(), text[end : found.start()]
            end, kind, value = found.end(), found["kind"], found["value"]
            for name in re.split(r"\s*,\s*", found["names"].strip()):
                assert name not in self.variables, f"{name} is declared twice"
                self.kinds[name] = kind
                self.variables[name] = self._initial(kind, value)
                yield name
        assert not text[end:].strip(), text[end:]

    def _initial(self, kind: str, value: str | None) -> Any:
        if size := SIZE.fullmatch(kind):
            if repeated := re.fullmatch(r"\[(\d+)\(0\.0\)\]", value or ""):
                return [0.0] * int(repeated[1])
            numbers = [float(x) for x in value.strip("[] \n").split(",")] if value else [0.0] * (int(size[1]) + 1)
            assert len(numbers) == int(size[1]) + 1, kind
            return numbers
        if kind == "BOOL":
            return value == "TRUE"
        return {"LREAL": float, "DINT": int, "INT": int}[kind](value or 0)

    def _translate(self, body: str) -> Callable[[], None]:
        """Return the body as a function; every name in it has to be declared."""
        lines, depth = ["def run(V):"], 1
        for line in filter(None, map(str.strip, body.splitlines())):
            python = next(
                (pattern.sub(new, line) for pattern, new in STATEMENTS if pattern.fullmatch(line)),
                None,
            )
            assert python is not None, f"no statement: {line}"
            if python.startswith(("if", "elif")):
                python = python.replace(" = ", " == ")
            depth -= line.startswith(("END_", "ELS"))
            lines.append("    " * depth + (re.sub(r"\b[A-Za-z_]\w*\b", self._word, python) or "pass"))
            depth += python.endswith(":")
        space = dict(FUNCTIONS)
        exec("\n".join(lines), space)
        return lambda: space["run"](self.variables)

    def _word(self, match: re.Match[str]) -> str:
        word = match[0]
        if word in WORDS:
            return WORDS[word]
        if word in (
            "SEL",
            "SQRT",
            "TRUNC",
            "DINT_TO_LREAL",
            "if",
            "elif",
            "else",
            "for",
            "in",
            "range",
        ) or re.fullmatch(r"E\d+", word):
            return word
        assert word in self.variables, f"{word} is not declared"
        return f"V[{word!r}]"

    def __call__(self, **inputs: Any) -> bool:
        """Take one sample; return whether an evaluation was made."""
        self.variables |= inputs
        self._run()
        return bool(self.variables["evaluated"])
