"""The items of a lake, one per asset and day, from the names of folders or from a table of files."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

from servoscope.core.errors import RecordingError

TABLES = (".csv", ".txt", ".tsv")
ASSET, DAY = "asset", "day"
POINT = "point"  # the group that names the operating point
UNDATED_DAY = "all"  # the day of files that name none


@dataclass(frozen=True)
class AssetDay:
    """One asset's day."""

    asset: str
    day: str
    files: tuple[str, ...]  # where the rows are, as paths or URLs
    stamp: str  # hash of the files' names, sizes and times
    groups: tuple[tuple[str, str], ...] = ()  # what the asset belongs to: (key, value), such as its hydraulic supply

    @property
    def key(self) -> tuple[str, str]:
        """What identifies it."""
        return self.asset, self.day


@dataclass(frozen=True)
class Lake:
    """All items of a lake, by asset and day in order."""

    location: str
    items: tuple[AssetDay, ...]

    @property
    def assets(self) -> tuple[str, ...]:
        """Names of the assets."""
        return tuple(dict.fromkeys(item.asset for item in self.items))

    @classmethod
    def open(
        cls,
        where: str,
        partition: tuple[str, str] = (ASSET, DAY),
        groups: Mapping[str, Mapping[str, str]] | None = None,
    ) -> Lake:
        """Find the items of a lake.

        Parameters
        ----------
        where
            A folder or URL of Parquet files in folders such as ``asset=P07/day=2026-11-20``, in any depth; folders
            with other keys are groups. Or a table of files, CSV, with the columns ``asset``, ``file`` and, if wanted,
            ``day`` and groups.
        partition
            The keys of asset and day.
        groups
            More groups by asset.

        Raises
        ------
        RecordingError
            If there is no file, or no key for the asset.
        """
        is_table = where.lower().endswith(TABLES)
        files: dict[tuple[str, str], list[tuple[str, ...]]] = {}
        keys: dict[tuple[str, str], dict[str, str]] = {}
        for file in (_read_file_table if is_table else _walk_folders)(where, partition):
            files.setdefault(file.key, []).append((*file.files, file.stamp))
            keys.setdefault(file.key, {}).update(file.groups)
        if not files:
            raise RecordingError(f"{where}: holds no Parquet file, give a folder with asset=.../day=... in it")
        items = []
        for (asset, day), stamped in sorted(files.items()):
            digest = hashlib.sha256(repr(sorted(stamped)).encode()).hexdigest()[:16]
            own = {**keys[asset, day], **(groups or {}).get(asset, {})}
            items.append(
                AssetDay(asset, day, tuple(path for path, _ in sorted(stamped)), digest, tuple(sorted(own.items())))
            )
        return cls(where, tuple(items))


def filesystem(where: str) -> tuple[Any, str]:
    """Return the file system of a path or URL, and the path in it.

    Raises RecordingError if the URL is of an unknown kind.
    """
    import pyarrow as pa
    from pyarrow import fs

    if "://" not in where:
        return fs.LocalFileSystem(), str(Path(where).absolute())
    try:
        system, path = fs.FileSystem.from_uri(where)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise RecordingError(f"{where}: cannot be opened ({' '.join(str(error).split())[:100]})") from None
    return system, path


def read_groups(path: Path) -> dict[str, dict[str, str]]:
    """Read groups by asset from a table with the column ``asset``; each other column is a key.

    Raises RecordingError if there is no such column.
    """
    rows = _read_csv(str(path))
    if rows and ASSET not in rows[0]:
        raise RecordingError(f"{path}: no column {ASSET!r}, the table of groups has one row per asset")
    return {row[ASSET]: {key: value for key, value in row.items() if key != ASSET and value} for row in rows}


def _walk_folders(where: str, partition: tuple[str, str]) -> Iterator[AssetDay]:
    """Yield each file, with the groups that its folders name."""
    from pyarrow import fs

    system, root = filesystem(where)
    prefix = where.rstrip("/").removesuffix(root.rstrip("/")) if "://" in where else ""
    try:
        infos = system.get_file_info(fs.FileSelector(root, recursive=True))
    except (FileNotFoundError, NotADirectoryError):
        raise RecordingError(f"{where}: no such folder, give a folder with asset=.../day=... in it") from None
    except OSError as error:
        raise RecordingError(f"{where}: cannot be read ({error})") from None
    for info in sorted(infos, key=lambda info: info.path):
        parts = PurePosixPath(info.path).relative_to(root).parts
        if not info.is_file or not info.path.endswith((".parquet", ".pq")) or any(p[0] in "._" for p in parts):
            continue
        keys = {k: unquote(v) for k, equals, v in (part.partition("=") for part in parts[:-1]) if equals}
        if partition[0] not in keys:
            raise RecordingError(f"{info.path}: no folder {partition[0]}=... above it: say with --partition which keys")
        asset, day = keys.pop(partition[0]), keys.pop(partition[1], UNDATED_DAY)
        yield AssetDay(asset, day, (prefix + info.path,), f"{info.size} {info.mtime_ns}", tuple(keys.items()))


def _read_file_table(where: str, partition: tuple[str, str]) -> Iterator[AssetDay]:
    """Yield each file, with the groups that its row names."""
    folder = Path(where).parent
    for i, row in enumerate(_read_csv(where), start=2):
        asset, file = row.pop(partition[0], ""), row.pop("file", "")
        if not asset or not file:
            raise RecordingError(f"{where}: row {i}: needs a value in the columns {partition[0]!r} and 'file'")
        path = file if "://" in file else str(folder / file)
        day = row.pop(partition[1], "") or Path(file).stem
        try:
            state = Path(path).stat()
            stamp = f"{state.st_size} {state.st_mtime_ns}"
        except OSError:
            stamp = "missing"  # reading the item will fail with the reason
        yield AssetDay(asset, day, (path,), stamp, tuple((key, value) for key, value in row.items() if value))


def _read_csv(where: str) -> list[dict[str, str]]:
    import csv

    try:
        with Path(where).open(newline="", encoding="utf-8-sig") as file:
            return [{k: (v or "").strip() for k, v in row.items() if k} for row in csv.DictReader(file)]
    except OSError as error:
        raise RecordingError(f"{where}: cannot be read ({error.strerror or error})") from None
    except (UnicodeDecodeError, csv.Error):
        raise RecordingError(f"{where}: is no table in CSV, write asset,file,day in its first row") from None
