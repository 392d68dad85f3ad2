"""Situations as somebody meets them at night: what is it, since when, what do I do now, on the first screen."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import screens
from opening import LONG_MS, PATIENCE_MS, accessible, fits
from screens import asked, until
from situations import LATER, NOTED, NOW, ONSET, SITUATIONS, WAS, stored

from servoscope.service.store import Batch, Store

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")

pytestmark = pytest.mark.slow

FIRST_SCREENS = ((1366, 768), (390, 844))

# of the asset "step", seconds before its diagnosis: alarm, states before and after, what happened, and by whom
STEPS = (
    (5000.0, "fault", "normal", "unacknowledged", "occur", ""),
    (4000.0, "fault", "unacknowledged", "acknowledged", "acknowledge", "otto"),
    (3000.0, "fault", "acknowledged", "normal", "clear", ""),
    (2500.0, "data_quality", "normal", "unacknowledged", "occur", ""),
    (2000.0, "data_quality", "unacknowledged", "returned_unacknowledged", "clear", ""),
    (470.0, "fault", "normal", "unacknowledged", "occur", ""),
)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    folder = tmp_path_factory.mktemp("night")
    store, batch = Store.open("history.sqlite", folder, write=True), Batch()
    for name, situation in SITUATIONS.items():
        batch.checkpoints[name] = stored(name, situation)
        if situation.full is not None:
            t = ONSET + 20.0 if situation.full is WAS else NOW
            row = {"asset": name, "number": 1, "t": t, "grounds": "full", **situation.full.columns("")}
            batch.rows["diagnoses"].append(row)
    for name, situation in LATER.items():
        gone = not situation.status["alarms"]["fault"]["active"]
        for number, t, before, after in ((2, ONSET + 10.0, "normal", "unacknowledged"), (3, NOW - 70.0, "", "")):
            if number == 2 or gone:
                states = {"before": before or "unacknowledged", "after": after or "returned_unacknowledged"}
                row = {"asset": name, "number": number, "t": t, "alarm": "fault", **states, "cause": "", "who": ""}
                batch.rows["transitions"].append(row | {"document": {"event": "occur" if number == 2 else "clear"}})
    for number, (ago, alarm, before, after, event, who) in enumerate(STEPS, start=10):
        row = {"asset": "step", "number": number, "t": NOW - ago, "alarm": alarm, "before": before, "after": after}
        batch.rows["transitions"].append(row | {"cause": "", "who": who, "document": {"event": event}})
    store.write(batch, "hall", 1)
    store.add_audit("otto", "step", "note", {"t": NOW - 3000.0, "text": "seal replaced", "anew": True})
    document = {"t": NOW - 1000.0, "text": "baseline 2 (repair)", "anew": True, "kind": "baseline"}
    store.add_audit("otto", "step", "note", document)
    store.close()
    base = f"http://127.0.0.1:{screens.free_port()}"
    with screens.process("serve", "--store", "history.sqlite", "--listen", base.removeprefix("http://"), cwd=folder):
        until(lambda: asked(base, "/session"))
        yield base


@pytest.fixture(scope="module")
def page(chromium: Any) -> Iterator[Any]:
    context = chromium.new_context(locale="en-GB", timezone_id="UTC")
    opened = context.new_page()
    opened.set_default_timeout(PATIENCE_MS)
    yield opened
    context.close()


@pytest.mark.parametrize("name", SITUATIONS)
def test_the_first_screen_says_what_since_when_and_what_to_do(page: Any, address: str, name: str) -> None:
    what, since, todo = SITUATIONS[name].expected
    for width, height in FIRST_SCREENS:
        page.set_viewport_size({"width": width, "height": height})
        page.goto(f"{address}/assets/{name}")
        verdict = page.get_by_role("region", name="Verdict")
        for words in (what, since, todo):
            shown = verdict.get_by_text(words).first
            playwright.expect(shown).to_be_visible()
            box = shown.bounding_box()
            assert box["y"] + box["height"] <= height, (words, width)
        assert not re.search(r"T²|CUSUM|σ|iFRF|_friction", verdict.inner_text())
    accessible(page)


@pytest.mark.parametrize("name", LATER)
def test_after_a_fault_every_view_says_the_same(page: Any, address: str, name: str) -> None:
    what, _, _ = LATER[name].expected
    asset = asked(address, f"/assets/{name}")
    row = next(row for row in asked(address, "/assets")["assets"] if row["asset"] == name)
    said = what.replace("2026-12-23 04:23:20", "2026-12-23 04:23:20 UTC")  # nobody has said where the reader is
    headline = asset["sections"][0]["title"]
    assert said in headline and said in row["summary"]
    alarm = next(one for one in asked(address, "/alarms")["alarms"] if one["asset"] == name)
    is_fault = asset["verdict"] == "fault"
    assert alarm["active"] == (name in ("not-quite", "learning"))
    assert (alarm["since"], said in alarm["cause"]) == ((NOTED, True) if is_fault else (NOW, False))
    assert [size["ratio"] for size in asset["sizes"]] == ([1.12] if is_fault else [])
    page.set_viewport_size({"width": 1280, "height": 844})
    page.goto(f"{address}/assets/{name}")
    label = "What has happened to this asset over time"
    page.get_by_label(f"View and save: {label}").click()

    def bars() -> list[tuple[float | None, float | None]]:
        with page.expect_download() as download:
            page.get_by_role("button", name=f"Save the values: {label}").click()
        rows = csv.DictReader(Path(download.value.path()).read_text(encoding="utf-8").splitlines())
        return [(_seconds_ago(row["from"]), _seconds_ago(row["to"])) for row in rows if row["what"] == "Fault"]

    assert until(bars) == [(NOW - (NOTED if is_fault else ONSET), 0.0 if alarm["active"] else 70.0)]
    if is_fault:  # one load for what has to fit: pages of a phone and of a small screen, with axe in both colours
        page.set_viewport_size({"width": 390, "height": 844})
        page.reload()
        folds = page.locator("details.fold > summary")
        playwright.expect(folds.filter(visible=True).first).to_have_text("Events")
        assert page.evaluate("document.documentElement.scrollHeight") < 5000
        folds.first.click()
        table = page.get_by_role("table", name="Events, the newest first")
        playwright.expect(table).to_contain_text("friction has risen by 12 %")
        fits(page, 1280, 390)
    page.goto(f"{address}/alarms?asset={name}")
    for width in (390, 1280):
        page.set_viewport_size({"width": width, "height": 844})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    listed = page.get_by_role("table").first
    playwright.expect(listed).to_contain_text(what if is_fault else "friction has risen by 37 %")


def test_a_timeline_shows_what_has_happened(page: Any, address: str, tmp_path: Path) -> None:
    page.set_viewport_size({"width": 1366, "height": 768})
    page.goto(f"{address}/assets/step")
    label = "What has happened to this asset over time"
    playwright.expect(page.get_by_text("Nothing has been followed yet")).to_be_visible()
    playwright.expect(page.get_by_role("img", name=re.compile("^Size over time"))).to_be_hidden()  # it has no values
    page.get_by_label(f"View and save: {label}").click()
    with page.expect_download() as download:
        page.get_by_role("button", name=f"Save the values: {label}").click()
    download.value.save_as(tmp_path / "timeline.csv")
    with (tmp_path / "timeline.csv").open(encoding="utf-8", newline="") as file:
        rows = [(row["what"], *(_seconds_ago(row[end]) for end in ("from", "to"))) for row in csv.DictReader(file)]
    assert rows == [
        ("Fault", 5000.0, 3000.0),
        ("Answers", 4000.0, None),
        ("Repairs", 3000.0, None),
        ("Data", 2500.0, 2000.0),
        ("Baselines", 1000.0, None),
        ("Fault", 480.0, 0.0),  # from its onset on, and until now
        ("Diagnoses", 0.0, None),
    ]
    page.get_by_text("For experts").click()
    tests = page.get_by_role("img", name="Both tests over time, as multiples of their limits")
    view = "chart => (({ start, end }) => [start, end])(echarts.getInstanceByDom(chart).getOption().dataZoom[0])"
    for _ in range(4):
        page.get_by_role("button", name=f"Zoom in: {label}").click()
        page.get_by_role("button", name=f"Later: {label}").click()
    page.wait_for_url("**view-what-has-happened*=93.75%2C100")  # the last 312.5 s
    start, end = tests.evaluate(view)  # of the 600 s that are shown there
    assert start == pytest.approx(100.0 * (1.0 - 312.5 / 600.0), abs=1.0) and end == 100.0
    assert "view-both-tests" not in page.url
    page.get_by_role("button", name=f"Show all: {label}").click()
    page.wait_for_url(lambda url: "view-" not in url)
    assert tests.evaluate(view) == [0.0, 100.0]


def _seconds_ago(date: str) -> float | None:
    return NOW - datetime.fromisoformat(date).timestamp() if date else None


def test_alarm_and_diagnosis_lead_to_each_other_and_several_are_answered_at_once(page: Any, address: str) -> None:
    page.goto(f"{address}/alarms")
    page.get_by_role("row").filter(has=page.get_by_role("link", name="gone", exact=True)).get_by_role(
        "link", name="reasons"
    ).click()
    playwright.expect(page.get_by_role("heading", level=1)).to_have_text("Diagnosis of gone")
    page.get_by_role("link", name="Its alarms").click()
    rows = page.get_by_role("table").first.get_by_role("row")
    playwright.expect(rows).to_have_count(1 + 1)
    page.get_by_label("Search alarms").fill("")
    playwright.expect(rows).to_have_count(1 + 2 + len(LATER))
    page.get_by_role("button", name="Acknowledge these 6").click()
    playwright.expect(page.get_by_text("Asked for: the service carries it out")).to_be_visible()


def test_a_fleet_without_assets_leads_to_the_first_one(page: Any, tmp_path: Path) -> None:
    base = f"http://127.0.0.1:{screens.free_port()}"
    with screens.process("serve", "--store", "new.sqlite", "--listen", base.removeprefix("http://"), cwd=tmp_path):
        empty = until(lambda: asked(base, "/assets"))
        page.goto(base)
        playwright.expect(page.get_by_role("heading", name="Add a machine")).to_be_visible()
        playwright.expect(page.get_by_role("link", name="Begin with a log")).to_have_attribute("href", "/begin")
        accessible(page)
        page.route("**/api/v1/assets*", lambda route: route.fulfill(json=empty | {"configured": 6}))
        page.goto(base)
        playwright.expect(page.get_by_text("6 assets are configured, waiting for the first samples.")).to_be_visible()
        page.unroute("**/api/v1/assets*")


def test_a_phone_shows_machines_first(page: Any, address: str) -> None:
    page.set_viewport_size({"width": 390, "height": 844})
    page.goto(address)
    first = page.get_by_role("row").filter(has=page.get_by_role("link", name="not-quite", exact=True))
    playwright.expect(first).to_contain_text("+12 %: friction")
    assert first.bounding_box()["y"] < 250.0
    playwright.expect(page.get_by_label("Order")).to_be_hidden()
    page.get_by_role("button", name="Filters and map").click()
    playwright.expect(page.get_by_label("Order")).to_be_visible()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    titles = page.locator(".titles > span")
    page.set_viewport_size({"width": 1366, "height": 768})
    playwright.expect(titles.filter(visible=True)).to_have_text(
        ["State", "Asset", "What is known", "Lasting", "Distance / limit", "Data", "Alarms", "Sample"]
    )  # no group, no limit, no growth


def test_a_section_opens_its_documentation_and_words_explain_themselves(page: Any, address: str) -> None:
    page.goto(f"{address}/assets/step")
    shown = page.get_by_role("link", name="Help: Timeline")
    playwright.expect(shown).to_have_attribute("href", "/help/how-to/dashboard.html#pages")
    playwright.expect(page.get_by_role("link", name="Help: Verdict")).to_be_visible()
    meaning = "what healthy looks like: learned from recordings, or computed from the plant's nominal parameters"
    page.goto(f"{address}/learn")
    playwright.expect(page.locator("dfn", has_text="baseline").first).to_have_attribute("title", meaning)


def test_an_example_leads_to_a_verdict(page: Any, address: str) -> None:
    page.goto(f"{address}/diagnose")
    page.get_by_role("button", name="Try it with an example").click()
    playwright.expect(page.get_by_label("Compare with the baseline")).to_have_value("example-axis", timeout=LONG_MS)
    playwright.expect(page.get_by_label("Input u", exact=True)).to_have_value("Motor voltage (V)")
    page.get_by_role("button", name="Diagnose", exact=True).click()
    page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)
    verdict = page.get_by_role("region", name="Verdict")
    playwright.expect(verdict).to_contain_text("friction at speed has risen by a quarter")
