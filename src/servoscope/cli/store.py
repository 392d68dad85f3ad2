"""The commands ``servoscope store ...``: a history copied to a file, and back into either database."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.service import StoreArgument, open_store, parse_store_address
from servoscope.core.messages import count_words

store_app = typer.Typer(no_args_is_help=True, help="Back up a history, and restore it.")
app.add_typer(store_app, name="store")


@store_app.command()
def backup(
    store: StoreArgument,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File to write; it must not exist yet.")],
) -> None:
    """Write all that a store holds at this moment into a file, which is a store itself; services may go on."""
    from servoscope.service.store.copy import copy_store

    with closing(open_store(store)) as opened:
        _print_counts(file, copy_store(opened, str(file.absolute())))


@store_app.command()
def restore(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="What backup has written.")], store: StoreArgument
) -> None:
    """Bring a backup into a store that has no history yet: a new SQLite file, or an empty PostgreSQL database."""
    from servoscope.service.store.copy import copy_store
    from servoscope.service.store.engine import display_url, parse_store_url

    url, folder = parse_store_address(store)
    with closing(open_store(str(file))) as opened:
        counts = copy_store(opened, url, folder)
    _print_counts(display_url(parse_store_url(url, folder or Path())), counts)


def _print_counts(where: str | Path, counts: dict[str, int]) -> None:
    rows, states = sum(counts.values()), counts.get("checkpoints", 0)
    typer.echo(f"{where}: {count_words(rows, 'row', 'en')}, {count_words(states, 'saved_state', 'en')}")
