"""Several files that are one recording, by an address such as ``join:monday/`` or ``join:early.csv,late.csv``."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

from servoscope.signals.readers.addresses import TableAddress
from servoscope.signals.readers.archives import expand_paths
from servoscope.signals.readers.formats import open_file, readable_suffixes
from servoscope.signals.readers.table import Table, TableFile


def open_concatenation(address: TableAddress) -> TableFile:
    """Open the files of a folder, a pattern or a list with commas, in the order of the numbers in their names.

    Raises RecordingError if there are none, or one cannot be read; if a column that is used is not in all of them.
    """
    paths = expand_paths([Path(place) for place in address.place.split(",")], readable_suffixes())
    paths.sort(key=lambda path: [int(x) if x.isdecimal() else x for x in re.split(r"(\d+)", str(path))])
    files = [open_file(path, address.text_layout) for path in paths]

    def read_chunks(wanted: Sequence[str], texts: Collection[str]) -> Iterator[Table]:
        for file in files:
            yield from file.tables(wanted, texts)

    first = files[0]
    missing = {
        name: f"is missing in {file.name}, give its files the same columns"
        for file in files
        for name in first.columns
        if name not in file.columns
    }
    columns = tuple(name for name in first.columns if name not in missing)
    aliases = {alias: name for alias, name in first.aliases.items() if name in columns}
    groups = tuple(tuple(name for name in group if name in columns) for group in first.channel_groups)
    named = Path(f"{first.name} to {files[-1].name}")
    return TableFile(named, columns, read_chunks, {**first.non_channels, **missing}, groups, aliases)
