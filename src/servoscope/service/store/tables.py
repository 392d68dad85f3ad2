"""The tables of a store, for SQLite and PostgreSQL alike.

All times are UTC seconds: `t` by the clock of the asset's own samples, `at` by that of the machine that wrote the row.
The rows of one asset are numbered: `number` counts through residuals, diagnoses and transitions, so that a row that is
lost or written twice can be detected.
"""

from __future__ import annotations

from typing import Any

import sqlalchemy as sa

from servoscope.core.texts import MAX_TEXT_CHARS, clean_text

METADATA = sa.MetaData()
MAX_KEY_CHARS = 200  # of a text in an index: PostgreSQL takes 2704 bytes of an entry


class CleanText(sa.TypeDecorator[str]):
    """A text of up to so many characters, written and looked for as `clean_text` returns it."""

    impl, cache_ok = sa.Text, True

    def __init__(self, longest: int = MAX_TEXT_CHARS) -> None:
        super().__init__()
        self.longest = longest

    def process_bind_param(self, value: Any, dialect: sa.Dialect) -> Any:
        """Return what is sent to the database."""
        return clean_text(value, self.longest) if isinstance(value, str) else value


Text, Key = CleanText(), CleanText(MAX_KEY_CHARS)

Identity = sa.BigInteger().with_variant(sa.Integer(), "sqlite")  # the only kind that SQLite counts up by itself


def within(column: sa.Column[float], span: tuple[float | None, float | None]) -> list[sa.ColumnElement[bool]]:
    """Return the conditions that a time lies between two others, the second one left out; None: without bound."""
    since, until = span
    begun = [] if since is None else [column >= since]
    return begun if until is None else [*begun, column < until]


def _numbered_table(name: str, *columns: sa.Column[object], covered: tuple[str, ...] = ()) -> sa.Table:
    """Return a table of an asset's numbered rows; `covered`: columns that its index by time holds, too."""
    return sa.Table(
        name,
        METADATA,
        sa.Column("asset", Key, primary_key=True),
        sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("t", sa.Double, nullable=False),
        *columns,
        sa.Index(f"{name}_by_time", "asset", "t", *covered),
        sqlite_with_rowid=False,
    )


meta = sa.Table(  # schema: version of the tables; commit of NAME: number of that service's last transaction
    "meta", METADATA, sa.Column("key", Key, primary_key=True), sa.Column("value", sa.BigInteger, nullable=False)
)
checkpoints = sa.Table(  # the state from which `run` continues each asset, and what `watch` shows
    "checkpoints",
    METADATA,
    sa.Column("asset", Key, primary_key=True),
    sa.Column("sequence", sa.BigInteger, nullable=False),
    sa.Column("state", sa.LargeBinary, nullable=False),
    sa.Column("status", sa.JSON, nullable=False),
    sa.Column("at", sa.Double, nullable=False),
)
# The last minutes of samples: those of a full diagnosis. `bundles.py` reads and writes them.
bundles = sa.Table(  # the blocks of a commit, those of the assets of a bundle in one row
    "bundles",
    METADATA,
    sa.Column("bundle", sa.Integer, primary_key=True, autoincrement=False),
    sa.Column("owner", Key, primary_key=True),  # the service that follows its assets
    sa.Column("number", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("contents", sa.Text, nullable=False),  # JSON: whose blocks, which, how long
    sa.Column("samples", sa.LargeBinary, nullable=False),
)
recent = sa.Table(  # blocks with a row of their own: of older versions, and what a bundle's row would be kept for
    "recent",
    METADATA,
    sa.Column("asset", Key, primary_key=True),
    sa.Column("sequence", sa.BigInteger, primary_key=True, autoincrement=False),
    sa.Column("samples", sa.LargeBinary, nullable=False),
)
needed = sa.Table(  # the first block that an asset's checkpoint needs; earlier ones may still be there
    "needed",
    METADATA,
    sa.Column("asset", Key, primary_key=True),
    sa.Column("sequence", sa.BigInteger, nullable=False),
)
# All of it is new every few minutes. Noise does not compress; and dead rows are vacuumed by their number: a share of
# the table's rows would grow with it, and its statistics are lost in a crash.
for _table in (bundles, recent):
    for _statement in (
        f"ALTER TABLE {_table.name} ALTER COLUMN samples SET STORAGE EXTERNAL",
        f"ALTER TABLE {_table.name} SET (autovacuum_vacuum_scale_factor = 0, autovacuum_vacuum_threshold = 1000,"
        " autovacuum_vacuum_cost_delay = 0, toast.autovacuum_vacuum_scale_factor = 0,"
        " toast.autovacuum_vacuum_threshold = 10000, toast.autovacuum_vacuum_cost_delay = 0)",
    ):
        on_postgresql = sa.DDL(_statement).execute_if(dialect="postgresql")  # type: ignore[no-untyped-call]
        sa.event.listen(_table, "after_create", on_postgresql)
residuals = _numbered_table(
    "residuals",
    sa.Column("statistic", sa.Double, nullable=False),  # the largest since the row before, over its limit
    sa.Column("level", sa.Double, nullable=False),
    sa.Column("residual", sa.JSON, nullable=False),  # per frequency: [Hz, real, imaginary, healthy |H|]
    covered=("statistic", "level"),  # a long history is thinned by them alone
)
diagnoses = _numbered_table(
    "diagnoses",
    sa.Column("grounds", Text, nullable=False),  # examination: at once; full: seconds later, with the refit
    sa.Column("verdict", Text, nullable=False),
    sa.Column("summary", Text, nullable=False),
    sa.Column("onset", sa.Double),
    sa.Column("document", sa.JSON, nullable=False),
)
sizes = sa.Table(  # faults and coefficients over years, thinned (`series.py`)
    "sizes",
    METADATA,
    sa.Column("asset", Key, primary_key=True),
    sa.Column("t", sa.Double, primary_key=True),
    # full: a fault by a full diagnosis; live: a fault by an examination; coefficient: by the recursion
    sa.Column("kind", Key, primary_key=True),
    sa.Column("name", Key, primary_key=True),
    sa.Column("value", sa.Double, nullable=False),  # of a fault: a ratio to healthy
    sa.Column("low", sa.Double, nullable=False),  # low, high: 95 % interval
    sa.Column("high", sa.Double, nullable=False),
    sa.Column("healthy", sa.Double, nullable=False),
    sqlite_with_rowid=False,
)
transitions = _numbered_table(
    "transitions",
    sa.Column("alarm", Text, nullable=False),
    sa.Column("before", Text, nullable=False),
    sa.Column("after", Text, nullable=False),
    sa.Column("cause", Text, nullable=False),
    sa.Column("who", Text, nullable=False),
    sa.Column("document", sa.JSON, nullable=False),
)
outbox = sa.Table(  # what is still to be delivered to webhooks, commands and brokers, and what was
    "outbox",
    METADATA,
    sa.Column("key", Key, primary_key=True),
    sa.Column("sink", Text, nullable=False),
    sa.Column("event", sa.JSON, nullable=False),
    sa.Column("created", sa.Double, nullable=False),
    sa.Column("due", sa.Double),  # of the next attempt; none: there will be no more
    sa.Column("attempts", sa.Integer, nullable=False),
    sa.Column("outcome", Text, nullable=False),
    sa.Index("outbox_by_due", "due"),
)
audit = sa.Table(
    "audit",
    METADATA,
    sa.Column("id", Identity, primary_key=True),
    sa.Column("at", sa.Double, nullable=False),
    sa.Column("who", Text, nullable=False),
    sa.Column("asset", Key, nullable=False),  # empty: the service as a whole
    sa.Column("what", Text, nullable=False),
    sa.Column("document", sa.JSON, nullable=False),
    sa.Index("audit_by_time", "at"),
)
commands = sa.Table(  # what operators ask for; the service executes them
    "commands",
    METADATA,
    sa.Column("id", Identity, primary_key=True),
    sa.Column("at", sa.Double, nullable=False),
    sa.Column("who", Text, nullable=False),
    sa.Column("asset", Key, nullable=False),
    sa.Column("alarm", Text, nullable=False),
    sa.Column("command", Text, nullable=False),
    sa.Column("document", sa.JSON, nullable=False),
    sa.Column("outcome", Text),  # none until it was executed
)
