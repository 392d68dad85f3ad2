"""What an application of the pages needs, over a store of its own, without a server."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from servoscope.core.workers import ProcessLimits
from servoscope.service.access import Sessions, Users, WebSettings
from servoscope.service.store import Store
from servoscope.web.dependencies import Context
from servoscope.web.event_hub import EventHub
from servoscope.web.jobs.queue import JobQueue
from servoscope.web.storage import FileStorage, UploadStorage


@contextmanager
def open_context(
    folder: Path, settings: WebSettings, users: Users | None = None, queue: type[JobQueue] = JobQueue, **more: Any
) -> Iterator[Context]:
    """Open a store in a folder, and return what the pages need; `more`: further fields of the context."""
    store = Store.open("history.sqlite", folder, write=True)
    storage = FileStorage(folder / "web")
    yield Context(
        settings=settings,
        store=store,
        config=None,
        storage=storage,
        uploads=UploadStorage(storage),
        event_hub=EventHub(store),
        jobs=queue(ProcessLimits(10.0, 1000.0)),
        users=users,
        sessions=Sessions(3600.0),
        **more,
    )
    store.close()
