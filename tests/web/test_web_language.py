"""The pages in a browser that asks for German: no English left, of the pages' own words and of the service's."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import screens
from logs import german_axis
from opening import LONG_MS, PATIENCE_MS, accessible, diagnosis_of
from screens import asked, until

from golden.results import FOLDER

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = pytest.mark.slow

# no German text has them; names of files, columns, commands and faults in a document's own words are marked as such
ENGLISH = re.compile(
    r"\b(the|and|with|from|by|recording|baseline|healthy|fault|reference|output|input|size|since|none|of|is|to|are"
    r"|what|when|which|learn|choose|shown|limit|time|change|asset|assets|verdict|save|view|print)\b",
    re.IGNORECASE,
)
# all that is read and heard on a page but for data
VISIBLE = """() => {
  const said = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walker.nextNode())
    if (!walker.currentNode.parentElement.closest("[translate=no], script, style, noscript, textarea"))
      said.push(walker.currentNode.data.trim());
  for (const name of ["aria-label", "title", "placeholder"])
    for (const each of document.querySelectorAll(`[${name}]:not([translate=no])`)) said.push(each.getAttribute(name));
  return said;
}"""


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Pages over a hall that a German service has followed to the end: one asset, with a leak."""
    folder = tmp_path_factory.mktemp("halle")
    shutil.copy(FOLDER / "rig.json", folder / "gut.json")
    shutil.copy(FOLDER / "suspect.parquet", folder / "leck.parquet")
    config = folder / "halle.toml"
    config.write_text(
        'name = "halle"\n[service]\nlisten = ""\nlog = "error"\n[store]\nurl = "history.sqlite"\n'
        "[diagnosis]\nwindow_s = 40.0\nevery_s = 30.0\n"
        '[sources.linie]\nkind = "replay"\nspeed = 0.0\n'
        '[assets.presse]\nbaseline = "gut.json"\nsource = "linie"\nfiles = ["leck.parquet"]\n'
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SERVOSCOPE_LANGUAGE", "de")
        with screens.process("run", config.name, cwd=folder) as running:
            until(lambda: running.poll() is not None)
        with screens.serving(config) as served:
            until(lambda: asked(served, "/diagnoses")["diagnoses"])
            yield served


def browse(chromium: Any, locale: str = "de-DE") -> Any:
    context = chromium.new_context(viewport={"width": 1366, "height": 768}, locale=locale, timezone_id="UTC")
    page = context.new_page()
    page.set_default_timeout(PATIENCE_MS)
    return page


def crumbs(page: Any) -> list[str]:
    """Texts of a page with English words in them; the example's name is data."""
    page.wait_for_timeout(1000)
    return sorted({text for text in page.evaluate(VISIBLE) if ENGLISH.search(text.replace("reference rig", ""))})


def test_every_page_is_german_where_the_browser_is(chromium: Any, address: str) -> None:
    page = browse(chromium)
    found = {}
    diagnosis = f"/diagnoses/{diagnosis_of(address, 'presse')}"
    for path in ("/", "/assets/presse", "/alarms", "/begin", "/diagnose", "/learn", "/design", "/nowhere", diagnosis):
        page.goto(address + path)
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        found[path] = crumbs(page)
    assert not any(found.values()), found
    assert page.evaluate("document.documentElement.lang") == "de"
    page.context.close()


def test_a_log_is_judged_in_german(chromium: Any, address: str, tmp_path: Path) -> None:
    page = browse(chromium)
    page.goto(f"{address}/begin")
    page.get_by_label("Hier eine Aufzeichnung ablegen").set_input_files(german_axis(tmp_path / "achse.csv"))
    expect(page.get_by_role("heading", name="Ist die Aufzeichnung brauchbar?")).to_be_visible(timeout=LONG_MS)
    assert crumbs(page) == []
    expect(page.get_by_role("region", name="Die ersten Zeilen von achse.csv")).to_contain_text("Istposition [mm]")
    accessible(page)
    page.context.close()


def test_the_switch_overrules_the_browser_and_is_remembered(chromium: Any, address: str) -> None:
    page = browse(chromium, "en-GB")
    page.goto(f"{address}/alarms")
    expect(page.get_by_role("heading", level=1)).to_have_text("Alarms")
    page.get_by_label("Language").select_option("de")
    expect(page.get_by_role("heading", level=1)).to_have_text("Alarme")
    page.goto(f"{address}/learn")
    expect(page.get_by_role("heading", level=1)).to_have_text("Einen Gutzustand lernen")
    page.context.close()
