"""The parts behind the HTTP interface: limits of jobs, what readers of events are told, thinned signals, guesses."""

from __future__ import annotations

import asyncio
import json
import re
from pathlib import Path

import numpy as np
import pytest
import screens
from starlette.datastructures import Headers

from servoscope.core.sandbox import Sandbox
from servoscope.core.workers import ProcessLimits, WorkerError
from servoscope.report.downsample import downsample_indices
from servoscope.service.store import Batch, Store
from servoscope.signals.readers.guess_columns import guess_mapping
from servoscope.web.event_hub import EventHub
from servoscope.web.jobs.queue import run_task
from servoscope.web.middleware import request_language
from servoscope.web.schemas.requests import DesignRequest, LoopRef


def test_work_that_takes_too_long_is_ended(tmp_path: Path) -> None:
    request = DesignRequest(loop=LoopRef(example="reference-rig"))
    arguments = request, request.loop, [], str(tmp_path)
    walls = Sandbox((str(tmp_path),))
    with pytest.raises(WorkerError, match="more than 1 s of processor time"):
        asyncio.run(run_task("study_design", arguments, tmp_path, ProcessLimits(1.0, 3000.0), walls))


def test_a_reader_that_is_late_hears_the_newest_state_and_no_backlog(tmp_path: Path) -> None:
    store = Store.open("x.sqlite", tmp_path, write=True)
    status = {"verdict": "healthy", "summary": "", "since": 0.0, "onset": None, "examined": None, "ne107": "good"}
    status |= {"reasons": [], "quality": {}, "alarms": {}}

    async def change(hub: EventHub, commit: int, *assets: str) -> None:
        batch = Batch()
        for asset in assets:
            said = {**status, "counted": {"began": 0.0, "t": float(commit), "rows": 0}}
            row = {"asset": asset, "sequence": commit, "state": b"", "status": said, "at": float(commit)}
            batch.checkpoints[asset] = row
        store.write(batch, "hall", commit)
        await hub.poll()

    async def story() -> None:
        hub = EventHub(store)
        await change(hub, 1, "press", "lift")
        first = hub.tick
        for commit in range(2, 50):
            await change(hub, commit, "press")
        (late,) = [
            json.loads(line[6:]) for line in hub.events_since(first).decode().splitlines() if line.startswith("data: ")
        ]
        assert [(row["asset"], row["t"]) for row in late["assets"]] == [("press", 49.0)]
        assert hub.events_since(hub.tick) == b"" and len(hub.events_since(-1)) > 2 * len(hub.events_since(first)) * 0.8

    asyncio.run(story())
    store.close()


def test_thinning_keeps_order_and_extremes() -> None:
    rng = np.random.default_rng(1)
    signals = rng.normal(size=10_000), np.where(rng.random(10_000) < 0.1, np.nan, rng.normal(size=10_000))
    at = downsample_indices(signals, 400)
    assert np.all(np.diff(at) > 0) and at.size <= 402 and at[0] == 0 and at[-1] == 9999
    for one in signals:
        assert np.nanmax(one[at]) == np.nanmax(one) and np.nanmin(one[at]) == np.nanmin(one)
    assert downsample_indices(signals, 20_000).size == 10_000


@pytest.mark.parametrize(
    ("names", "found"),
    [
        (["t", "r", "u", "y"], ("t", "r", "u", "y")),
        (
            ["Time [ms]", "SetPoint", "MotorCurrent", "ActualPosition"],
            ("Time [ms]", "SetPoint", "MotorCurrent", "ActualPosition"),
        ),
        (["time", "qg", "vir", "qm"], ("time", "qg", "vir", "qm")),
        (["a", "b"], (None, None, None, None)),
    ],
)
def test_columns_are_guessed_by_their_names(names: list[str], found: tuple[str | None, ...]) -> None:
    said = guess_mapping(names)
    assert tuple(said[key] for key in ("time", "reference", "input", "output")) == found
    assert said["time_unit"] == ("ms" if "ms" in names[0] else "s")


@pytest.mark.parametrize(
    ("cookie", "asked", "language"),
    [
        ("", "de-DE,de;q=0.9,en;q=0.8", "de"),
        ("", "fr;q=0.9, en-GB;q=0.4, de;q=0.5", "de"),
        ("", "fr, *;q=0.1", "en"),
        ("", "de;q=much", "en"),
        ("language=en", "de-DE", "en"),
        ("language=../secret", "de-DE", "de"),
    ],
)
def test_the_language_is_the_readers_choice_or_the_browsers(cookie: str, asked: str, language: str) -> None:
    assert request_language(Headers({"cookie": cookie, "accept-language": asked})) == language


PAGES = Path(screens.SOURCES) / "servoscope" / "web" / "pages"


def test_help_leads_to_headings_of_the_documentation(project: Path) -> None:
    source = (PAGES / "help.js").read_text(encoding="utf-8")
    topics = re.findall(r'^  "([a-z/#0-9-]+)": \[', source, re.M)
    assert len(topics) > 10
    for page, _, part in (topic.partition("#") for topic in topics):
        text = (project / "docs" / f"{page}.md").read_text(encoding="utf-8")
        headings = [
            re.sub(r"[^\w -]", "", each.lower()).replace(" ", "-") for each in re.findall("^#+ (.+)", text, re.M)
        ]
        assert not part or part in headings, (page, part)
    titled = {
        title for path in PAGES.glob("*.js") for title in re.findall(r'(?:section|titled)\("([^"]+)"', path.read_text())
    }
    assert len(titled) > 20 and [title for title in titled if f'"{title}"' not in source] == []


def test_pages_explain_words_as_the_glossary_does(project: Path) -> None:
    source = (PAGES / "help.js").read_text(encoding="utf-8").partition("const GLOSSARY")[2].partition("};")[0]
    explained = re.findall(r'^  (?:"([^"]+)"|(\w+)): "(.*)",$', source, re.M)
    rows = re.findall(
        r"^\| ([^|]+) \| ([^|]+) \|", (project / "docs" / "glossary.md").read_text(encoding="utf-8"), re.M
    )
    known = {term: means for terms, means in rows for term in terms.split(", ")}
    assert len(explained) == 10 and [one for one in explained if known.get(one[0] or one[1]) != one[2]] == []
