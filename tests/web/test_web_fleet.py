"""A fleet of many assets: pages of it, what a stream sends first and after a mark, and answers that stay small."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browsing import Served
from pages_context import open_context
from test_web_uploads import ask

from servoscope.service.access import WebSettings
from servoscope.service.assets.examination import undetermined
from servoscope.service.assets.examination_schedule import PendingDiagnosis
from servoscope.service.assets.records import diagnosis_row
from servoscope.service.store import Batch
from servoscope.service.store.rows import BASELINE_NOTE
from servoscope.web.dependencies import Context
from servoscope.web.event_hub import ROWS_PER_EVENT

ASSETS = 450


def write(context: Context, commit: int, **statistics: float) -> None:
    """Store a status of each asset; what is not healthy is so by its number."""
    batch = Batch()
    for name, statistic in statistics.items():
        number = int(name.removeprefix("press_"))
        status: dict[str, Any] = {"verdict": "fault" if number % 100 == 7 else "healthy", "summary": "As it was."}
        status |= {"since": 0.0, "onset": None, "examined": None, "ne107": "good", "reasons": [], "quality": {}}
        status |= {
            "alarms": {},
            "statistic": statistic,
            "level": 0.0,
            "about": {"group": f"hall {number % 2}", "baseline": "present"},
        }
        if number % 50 == 3:
            status["alarms"] = {"limit": {"state": "unacknowledged", "since": 0.0, "priority": "high"}}
        if number % 100 == 9:
            status["learning"] = {"after": "repair", "since": 0.0, "learned_s": 10.0, "needed_s": 200.0}
        status |= {"counted": {"began": 0.0, "t": float(commit), "rows": 0}}
        batch.checkpoints[name] = {
            "asset": name, "sequence": commit, "state": b"", "status": status, "at": float(commit)
        }  # fmt: skip
    service = {"service": True, "flood": {"since": None, "counted": 0, "held": 0}, "alarms": {}}
    batch.checkpoints["hall"] = {
        "asset": "hall", "sequence": commit, "state": b"", "status": service, "at": float(commit)
    }  # fmt: skip
    context.store.write(batch, "hall", commit)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fleet")


@pytest.fixture(scope="module")
def context(folder: Path) -> Iterator[Context]:
    with open_context(folder, WebSettings()) as opened:
        write(opened, 1, **{f"press_{k}": k % 11 / 20.0 for k in range(ASSETS)})
        yield opened


def names(answer: Any) -> list[str]:
    return [row["asset"] for row in answer.json()["assets"]]


def test_pages_are_parts_of_the_whole_list_the_most_urgent_first(context: Context) -> None:
    whole, *pages, group, search, healthy, fault, neither = ask(
        context,
        ("GET", "/assets", None),
        *(("GET", f"/assets?limit=200&offset={k}", None) for k in (0, 200, 400, 600)),
        ("GET", "/assets?limit=10&offset=10&group=hall+1&verdict=healthy", None),
        ("GET", "/assets?limit=10&search=PRESS_44", None),
        *(("GET", f"/assets?limit=500&search={text}", None) for text in ("HALL+1+healthy", "As+it+was", "nothing")),
    )
    assert len(names(whole)) == ASSETS and [name for page in pages for name in names(page)] == names(whole)
    assert [len(names(page)) for page in pages] == [200, 200, 50, 0]
    assert all(page.json()["total"] == ASSETS and page.json()["groups"] == ["hall 0", "hall 1"] for page in pages)
    assert set(names(whole)[:5]) == {f"press_{k}" for k in (7, 107, 207, 307, 407)}
    assert set(names(whole)[5:14]) == {f"press_{50 * k + 3}" for k in range(9)}
    assert [one["service"] for one in pages[0].json()["services"]] == ["hall"]
    like = [row["asset"] for row in whole.json()["assets"] if (row["group"], row["verdict"]) == ("hall 1", "healthy")]
    assert names(group) == like[10:20] and group.json()["total"] == len(like)
    assert search.json()["total"] == 11 and set(names(search)) <= {"press_44", *(f"press_44{k}" for k in range(10))}
    shown = {
        row["asset"]: f"{row['asset']} {row['group']} {row['summary']}".casefold() for row in whole.json()["assets"]
    }
    for answer, text in ((healthy, "hall 1 healthy"), (fault, "as it was"), (neither, "nothing")):
        assert names(answer) == [name for name in names(whole) if text in shown[name]], text
    assert len(names(healthy)) > 200 and len(names(fault)) == 5
    assert whole.headers["content-encoding"] == "gzip" and len(whole.content) > 50_000


def test_an_undetermined_diagnosis_names_the_baseline_that_it_was_made_with(context: Context) -> None:
    window = PendingDiagnosis(1, 0, 100.0, "full")
    made = diagnosis_row(window, undetermined("crashed"), "0" * 16).values
    earlier = {**made, "number": 2, "document": {"said": made["document"]["said"]}}  # of an earlier version
    batch = Batch()
    rows = (made, earlier, {**earlier, "number": 3, "t": 300.0})
    batch.rows["diagnoses"] += [{"asset": "press_1", **row} for row in rows]
    context.store.write(batch, "hall", 3)
    note = {"t": 200.0, "text": "baseline 2", "anew": True, "kind": BASELINE_NOTE}
    context.store.add_audit("vera", "press_1", "note", note)
    answers = ask(context, *(("GET", f"/diagnoses/press_1@{number}", None) for number in (1, 2, 3)))
    assert [answer.json()["baseline"]["hash"] for answer in answers] == ["0" * 16, "", "present"]
    assert answers[0].json()["document"] == {}


def events(text: bytes) -> list[tuple[bool, list[dict[str, Any]]]]:
    """Return of each event with assets whether it has a mark, and its rows."""
    blocks = [block.splitlines() for block in text.decode().split("\n\n") if "event: assets" in block]
    return [(lines[0].startswith("id: "), json.loads(lines[-1].removeprefix("data: "))["assets"]) for lines in blocks]


def test_no_event_has_the_whole_fleet_and_a_mark_leaves_out_what_is_known(context: Context) -> None:
    hub = context.event_hub
    asyncio.run(hub.poll())
    marked, rows = zip(*events(hub.events_since(hub.tick_at(""))), strict=True)
    assert [len(each) for each in rows] == [ROWS_PER_EVENT, ROWS_PER_EVENT, 50] and marked == (False, False, True)
    mark = ask(context, ("GET", "/assets?limit=1", None))[0].json()["mark"]
    assert hub.events_since(hub.tick_at(mark)) == b""
    write(context, 2, press_9=0.9)
    asyncio.run(hub.poll())
    ((has_mark, changed),) = events(hub.events_since(hub.tick_at(mark)))
    assert has_mark and [(row["asset"], row["statistic"]) for row in changed] == [("press_9", 0.9)]
    for strange in (f"0-{mark.partition('-')[2]}", "x", f"{mark}9", f"{mark.partition('-')[0]}--1"):
        assert hub.tick_at(strange) == -1


def test_the_answer_to_a_body_that_is_wrong_in_many_places_names_some(context: Context) -> None:
    body = {"loop": {}, "recordings": [{"uploads": k} for k in range(90)]}
    (answer,) = ask(context, ("POST", "/learnings", body))
    assert answer.status_code == 422 and len(answer.json()["errors"]) == 20


@pytest.mark.slow
def test_the_page_draws_so_many_rows_at_a_time(context: Context, folder: Path, chromium: Any) -> None:
    expect = pytest.importorskip("playwright.sync_api").expect
    with Served(folder, "serve", "--store", "history.sqlite", "--listen", "127.0.0.1:0") as served:
        page = chromium.new_page()
        page.goto(served.url)
        lines = page.locator(".rows > .line")
        expect(page.locator(".map a")).to_have_count(ASSETS)
        expect(lines).to_have_count(200)
        expect(lines.first).to_contain_text("press_107")
        page.get_by_role("button", name="Show more").click()
        expect(lines).to_have_count(400)
        page.get_by_label("Search assets").fill("press_44")
        expect(lines).to_have_count(11)
        write(context, 3, press_44=5.0)
        expect(lines.filter(has_text="5.0")).to_have_count(1)
        page.close()
