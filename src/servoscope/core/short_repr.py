"""One line for a terminal and a small table for a notebook, in the place of all fields of a result."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape


class ShortRepr:
    """Shows what `_shown_facts` returns, by name, and nothing else."""

    def _shown_facts(self) -> Mapping[str, object]:
        raise NotImplementedError

    def __repr__(self) -> str:
        """Return one line."""
        return f"{type(self).__name__}({', '.join(f'{name}: {fact}' for name, fact in self._shown_facts().items())})"

    def _repr_html_(self) -> str:
        """Return a table for notebooks."""
        rows = (
            f"<tr><th>{escape(name)}</th><td>{escape(str(fact))}</td></tr>"
            for name, fact in self._shown_facts().items()
        )
        return f"<table><caption>{escape(type(self).__name__)}</caption>{''.join(rows)}</table>"
