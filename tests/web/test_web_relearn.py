"""From an alarm to "repaired, learning again" in three clicks, then the new baseline, and one step back."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import screens
from axis_logs import repaired_axis
from opening import LONG_MS, SIZE, accessible
from screens import asked, until

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = pytest.mark.slow


def baseline_of(base: str, id_: str) -> str:
    return str(asked(base, f"/diagnoses/{id_}")["baseline"]["hash"])


def test_after_a_repair_an_asset_learns_again(chromium: Any, tmp_path: Path) -> None:
    config = repaired_axis(tmp_path)
    with screens.process("run", config.name, cwd=tmp_path), screens.serving(config) as base:
        until(lambda: asked(base, "/alarms")["alarms"])
        until(lambda: asked(base, "/diagnoses?asset=axis&verdict=fault")["diagnoses"])  # others have no baseline
        rows = asked(base, "/diagnoses?asset=axis&verdict=fault")["diagnoses"]
        before = {row["id"]: baseline_of(base, row["id"]) for row in rows}
        assert before and all(before.values())
        page = chromium.new_context(viewport=SIZE, locale="en-GB", timezone_id="UTC").new_page()
        page.goto(f"{base}/alarms")
        page.get_by_role("link", name="axis", exact=True).first.click()  # 1
        page.get_by_role("button", name="This was repaired").click()  # 2
        page.get_by_role("button", name="Learn again").click()  # 3
        part = page.locator("section", has=page.get_by_role("heading", name="Baseline", exact=True))
        expect(part).to_contain_text(re.compile("Learn(ing|ed enough) after repair"), timeout=LONG_MS)
        expect(part).to_contain_text("Learned enough after repair", timeout=LONG_MS)
        accessible(page)
        part.get_by_role("button", name="This was healthy").click()
        page.get_by_role("dialog").get_by_label("Why").fill("motor exchanged")
        page.get_by_role("button", name="Preview").click()
        take = part.get_by_role("button", name="Put in force")
        take.wait_for(timeout=LONG_MS)
        expect(part.get_by_role("region", name="What moved")).to_contain_text("inertia", timeout=LONG_MS)
        accessible(page)
        take.click()
        expect(part).to_contain_text("Baseline 2 is in force.", timeout=LONG_MS)
        assert [baseline_of(base, id_) for id_ in before] == list(before.values())  # and not the new one's
        until(lambda: asked(base, "/assets/axis")["verdict"] == "healthy", 180.0)
        part.get_by_role("button", name="One step back").click()
        page.get_by_role("dialog").get_by_label("Why").fill("not run in")
        page.get_by_role("button", name="Go back").click()
        expect(part).to_contain_text("Baseline 3 is in force.", timeout=LONG_MS)
        notes = asked(base, "/assets/axis/notes")["notes"]
        assert [note["kind"] for note in notes] == ["repair", "baseline", "baseline"]
        assert all(note["who"] == "local" for note in notes)
