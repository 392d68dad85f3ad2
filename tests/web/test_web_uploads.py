"""Uploads within bounds: how much they take together, how large a preview is, and that no event waits for a file."""

from __future__ import annotations

import asyncio
import functools
import inspect
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from pages_context import open_context

from servoscope.core.errors import RecordingError
from servoscope.service.access import WebSettings
from servoscope.signals.readers.formats import open_file
from servoscope.web.app import create_app
from servoscope.web.dependencies import Context
from servoscope.web.jobs.queue import JobQueue
from servoscope.web.jobs.tasks import MAX_COLUMNS, preview_file
from servoscope.web.storage import PREVIEW_BYTES, FileStorage, UploadStorage

PREVIEW = {"rows": 1, "columns": [], "preview": {"columns": ["t"], "rows": [[0.0]]}, "mapping": {}}
FILE_TYPE = {"Content-Type": "application/octet-stream"}


class QuietQueue(JobQueue):
    """Looks at no file, and begins no job."""

    async def run_now(self, task: str, folder: Path, *arguments: Any) -> Any:
        return PREVIEW

    async def _run(self, job: Any) -> None:
        pass


@pytest.fixture
def context(tmp_path: Path) -> Iterator[Context]:
    with open_context(tmp_path, WebSettings(upload_mb=1.0), queue=QuietQueue) as opened:
        yield opened


def ask(context: Context, *requests: tuple[str, str, Any]) -> list[httpx.Response]:
    """Return the answers to requests that are sent at once: method, address, and bytes or what is sent as JSON."""

    async def together() -> list[httpx.Response]:
        transport = httpx.ASGITransport(create_app(context), client=("127.0.0.1", 1))
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost/api/v1") as client:
            sent = [
                client.request(method, path, content=body, headers=FILE_TYPE)
                if isinstance(body, bytes)
                else client.request(method, path, json=body)
                for method, path, body in requests
            ]
            return await asyncio.gather(*sent)

    return asyncio.run(together())


def disk_usage(context: Context) -> int:
    return sum(path.stat().st_size for folder in context.storage.folders("uploads") for path in folder.iterdir())


def test_uploads_at_once_do_not_pass_the_quota_together(context: Context, tmp_path: Path) -> None:
    answers = ask(context, *[("POST", "/uploads?name=a.csv", b"x" * 1_000_000)] * 20)
    statuses = [one.status_code for one in answers]
    assert set(statuses) == {201, 507} and 2 <= statuses.count(201) < 10
    assert disk_usage(context) <= 10_000_000
    free = statuses.count(201) * 1_000_000 <= 10_000_000 - PREVIEW_BYTES - 1_000_000
    assert (
        free and ask(context, ("POST", "/uploads?name=a.csv", b"x"))[0].status_code == 201
    )  # what was reserved is free


def test_what_lies_on_the_disk_counts_whether_it_is_complete_or_not(context: Context) -> None:
    _, folder = context.storage.create("uploads")
    (folder / "half.csv").write_bytes(b"x" * 10_000_000)
    assert ask(context, ("POST", "/uploads?name=a.csv", b"x"))[0].status_code == 507
    shutil.rmtree(folder)
    assert ask(context, ("POST", "/uploads?name=a.csv", b"x"))[0].status_code == 201


def test_a_preview_lies_apart_from_the_record(context: Context) -> None:
    (made,) = ask(context, ("POST", "/uploads?name=a.csv", b"x"))
    record = context.storage.folder("uploads", made.json()["id"]) / "about.json"
    assert "preview" not in record.read_text()
    (one,) = ask(context, ("GET", f"/uploads/{made.json()['id']}", None))
    assert one.json() == made.json() and one.json()["preview"] == PREVIEW["preview"]


def test_a_preview_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for count, name in ((MAX_COLUMNS + 1, "c{}"), (10, "c" * 20_000 + "{}")):
        pq.write_table(pa.table({name.format(i): pa.array([1.0]) for i in range(count)}), "wide.parquet")
        with pytest.raises(RecordingError, match="columns"):
            preview_file(lambda _: None, "wide.parquet")
    names = [f"c{i}" for i in range(MAX_COLUMNS)]
    cells = ["x" * 90] * len(names)
    Path("wide.csv").write_text("\n".join(",".join(row) for row in [names, *[cells] * 20]))
    assert len(pa.py_buffer(repr(preview_file(lambda _: None, "wide.csv")).encode())) < PREVIEW_BYTES


def test_a_wide_parquet_file_is_refused_before_its_columns_are_looked_at(tmp_path: Path) -> None:
    path = tmp_path / "wide.parquet"
    pq.write_table(pa.table({f"c{i}": pa.array(np.zeros(1)) for i in range(20_001)}), path)
    with pytest.raises(RecordingError, match="20001 columns"):
        open_file(path)
    path.write_bytes(path.read_bytes()[:-8] + (40_000_000).to_bytes(4, "little") + b"PAR1")
    with pytest.raises(RecordingError, match="describes its columns and row groups in 40 MB"):
        open_file(path)


def test_no_file_is_touched_where_events_wait_for_it(context: Context, monkeypatch: pytest.MonkeyPatch) -> None:
    touched: list[str] = []

    def watch(kind: type, name: str) -> None:
        method = getattr(kind, name)

        @functools.wraps(method)
        def watched(*arguments: Any, **more: Any) -> Any:
            try:
                asyncio.get_running_loop()
            except RuntimeError:
                return method(*arguments, **more)
            touched.append(f"{kind.__name__}.{name}")
            return method(*arguments, **more)

        monkeypatch.setattr(kind, name, watched)

    for kind in (FileStorage, UploadStorage):
        for name, _ in inspect.getmembers(kind, inspect.isfunction):
            if name not in ("__init__", "_release"):
                watch(kind, name)
    (made,) = ask(context, ("POST", "/uploads?name=a.csv", b"x"))
    id_ = made.json()["id"]
    loop = {"example": "reference-rig"}
    statuses = [
        one.status_code
        for one in ask(
            context,
            ("GET", "/uploads", None),
            ("GET", f"/uploads/{id_}", None),
            ("POST", "/inspections", {"upload": id_}),
            ("POST", "/diagnoses", {"upload": id_, "baseline": "none"}),
            ("POST", "/learnings", {"loop": loop, "recordings": [{"upload": id_}]}),
            ("POST", "/designs", {"loop": loop, "recordings": [id_]}),
            ("DELETE", f"/uploads/{id_}", None),
        )
    ]
    assert statuses[0] == 200 and statuses.count(422) == 0
    assert touched == []
