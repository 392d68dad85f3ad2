"""From an alarm to what to do, in front of a hall that is really followed: checks, own texts, language and clock."""

from __future__ import annotations

import csv
import re
from datetime import datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import pytest
from brokers import until
from opening import SIZE, Open, diagnosis_of, shot
from screens import asked

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = pytest.mark.slow


def test_from_an_alarm_to_the_reasons_is_one_click(open_page: Open) -> None:
    page = open_page("/assets/press-1")
    page.get_by_role("link", name="all of it, with the reasons").click()
    expect(page.get_by_role("heading", name="What to check")).to_be_visible()
    page.get_by_text("For experts").click()
    expect(page.get_by_role("heading", name="Why")).to_be_visible()


def test_what_to_check_is_written_in_words_of_ones_own(open_page: Open, base: str) -> None:
    page = open_page("/assets/rig-1")
    page.get_by_text("Change what to check on this machine").click()
    text = "Filter F3 behind the cabinet <b>first</b>"
    page.get_by_label(re.compile("^pump")).fill(f"{text}\n\nthen the valve")
    page.get_by_role("button", name="Save").click()
    verdict = page.get_by_role("region", name="Verdict")
    expect(verdict.get_by_role("list").first).to_contain_text(text)
    expect(verdict).to_contain_text(re.compile("Written by local, 20"))
    page.get_by_role("link", name="all of it, with the reasons").click()
    expect(verdict.get_by_role("listitem").first).to_have_text(text)
    page.goto(f"{base}/alarms")
    row = page.get_by_role("row").filter(has=page.get_by_role("link", name="rig-1")).first
    expect(row).to_contain_text(text)
    entry = [one for one in asked(base, "/audit?asset=rig-1")["entries"] if one["what"] == "checks"][-1]
    assert entry["who"] == "local" and entry["document"] == {"fault": "pump", "texts": [text, "then the valve"]}


def test_sentences_come_in_the_readers_language_and_clock(chromium: Any, base: str) -> None:
    """Of a service that speaks English, on a German browser in Berlin."""
    context = chromium.new_context(viewport=SIZE, locale="de-DE", timezone_id="Europe/Berlin")
    page = context.new_page()
    for path in ("/assets/press-1", f"/diagnoses/{diagnosis_of(base, 'press-1')}"):
        page.goto(base + path)
        verdict = page.get_by_role("region", name="Urteil")
        expect(verdict).to_contain_text("die innere Leckage ist um ")
        expect(verdict).to_contain_text("Kolbendichtung und Steuerkanten")
        # an asset is diagnosed again while the page is open: its onset is asked anew with each look
        until(lambda path=path, verdict=verdict: onset_minute(base, path) in verdict.inner_text(), 30.0)
        expect(page.locator("header.top")).to_contain_text("Europe/Berlin")
        assert not re.search(r"\b(the|Fault|since|leakage)\b", verdict.inner_text())
    context.close()


def onset_minute(base: str, path: str) -> str:
    return f"{datetime.fromtimestamp(asked(base, path)['onset'], ZoneInfo('Europe/Berlin')):%Y-%m-%d %H:%M}"


def test_an_alarm_is_acknowledged_and_another_shelved(open_page: Open, base: str) -> None:
    page, watching = open_page("/alarms"), open_page("/assets/press-1")
    row = page.get_by_role("row").filter(has=page.get_by_role("link", name="press-1")).first
    expect(row).to_contain_text("piston seal and valve edges")  # without a click
    shot(page, "alarms")
    row.get_by_role("button", name=re.compile("^Acknowledge")).click()
    expect(row).to_contain_text("acknowledged")
    expect(row.get_by_role("button", name=re.compile("^Acknowledge"))).to_have_count(0)
    expect(watching.get_by_role("region", name="Alarms of this asset")).to_contain_text("acknowledged")
    other = page.get_by_role("row").filter(has=page.get_by_role("link", name="rig-1")).first
    other.get_by_role("button", name=re.compile("^Shelve")).click()
    dialog = page.get_by_role("dialog")
    dialog.get_by_label("Why").fill("waiting for the spare part")
    dialog.get_by_label("For").select_option("1 h")
    dialog.get_by_role("button", name="Shelve").click()
    expect(other).to_contain_text("shelved until")
    steps = {(one["asset"], one["after"]): one["who"] for one in asked(base, "/alarms/history")["transitions"]}
    assert steps["press-1", "acknowledged"] == steps["rig-1", "shelved"] == "local"


# what an asset and a diagnosis draw; of the asset some are empty until there is something to draw
CHARTS = {
    "/assets/press-1": (
        "What has happened",
        "Both tests over time",
        "Reference, output and input",
        "Magnitude and phase",
    ),
    "/diagnoses/": ("Mean input over position and speed",),
}


@pytest.mark.parametrize("path", CHARTS)
def test_every_chart_is_saved_as_csv(open_page: Open, base: str, path: str, tmp_path: Path) -> None:
    page = open_page(path if path != "/diagnoses/" else f"{path}{diagnosis_of(base, 'press-1')}")
    page.get_by_text("For experts").click()
    for label in CHARTS[path]:
        expect(page.get_by_role("img", name=re.compile(f"^{label}")).first).to_be_visible()
    charts = page.get_by_role("img").filter(visible=True).filter(has=page.locator("canvas"))
    # all at once: asked one by one, a chart that comes meanwhile names its neighbour twice, and a menu is closed again
    labels = charts.evaluate_all("charts => charts.map(chart => chart.getAttribute('aria-label'))")
    assert len(labels) >= len(CHARTS[path])
    for label in labels:
        page.get_by_label(f"View and save: {label}").click()
        with page.expect_download() as download:
            page.get_by_role("button", name=f"Save the values: {label}").click()
        download.value.save_as(tmp_path / "chart.csv")
        with (tmp_path / "chart.csv").open(encoding="utf-8", newline="") as file:
            head, *rows = csv.reader(file)
        assert rows and {len(row) for row in rows} == {len(head)}, label
