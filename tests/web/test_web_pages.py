"""The pages in a real browser, in front of a hall that is really followed: what a person sees and can do.

SCREENSHOTS=docs/images/pages writes the pictures of README and docs while the tests pass through the pages.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import screens
from opening import SIZE, THEMES, Open, accessible, diagnosis_of, drag, painted, shot, tab_to
from screens import asked, until

from servoscope.prognosis.series import read_sizes

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = pytest.mark.slow


def test_the_fleet_shows_the_worst_first(open_page: Open) -> None:
    page = open_page("/")
    rows = page.get_by_role("table", name="Assets, worst first").get_by_role("row")
    expect(rows).to_have_count(1 + screens.ASSETS)
    expect(rows.nth(1)).to_contain_text("Fault")
    for row in (1, 2):  # a sensor that is stuck looks like a fault until it has been stuck for a while
        expect(rows.nth(row).get_by_role("link").first).to_have_text(re.compile("press-1|rig-1"), timeout=60_000)
    assert {rows.nth(i).get_by_role("link").inner_text() for i in (1, 2)} == {"press-1", "rig-1"}
    expect(page.get_by_role("link", name=re.compile("press-1: Fault"))).to_be_visible()
    shot(page, "fleet")
    page.get_by_role("button", name=re.compile("^Fault")).click()
    expect(rows.filter(visible=True)).to_have_count(1 + 2)
    page.get_by_role("button", name=re.compile("^All")).click()
    page.get_by_label("Search assets").fill("lift")
    expect(rows.filter(visible=True)).to_have_count(1 + len(screens.HALL["Lifts"]))
    page.get_by_label("Search assets").fill("")
    page.get_by_label("Group").select_option("Test rigs")
    expect(rows.filter(visible=True)).to_have_count(1 + len(screens.HALL["Test rigs"]))
    assert page.url.endswith("group=Test+rigs")  # what is looked at can be sent to somebody
    page.get_by_label("Group").select_option("")
    sources = page.get_by_role("group", name="Sources").get_by_role("button")
    expect(sources).to_contain_text(re.compile(rf"line: (all|\\d+ of) {screens.ASSETS} heard"))
    page.get_by_role("button", name=re.compile("^Limit within 90 days")).click()
    expect(page.get_by_text("No asset is like this.")).to_be_visible()  # no limit is set in this hall
    assert page.url.endswith("show=soon")


def test_the_fleet_is_live_and_nothing_jumps(open_page: Open) -> None:
    page = open_page("/")
    expect(page.get_by_role("status").first).to_have_text("Live")
    row = page.get_by_role("row").filter(has=page.get_by_role("link", name="lift-3", exact=True))
    value = row.get_by_role("cell").nth(5)
    seen, places = set(), set()
    for _ in range(600):
        seen.add(value.inner_text())
        places.add(tuple(row.bounding_box().values()))
        if len(seen) > 3:
            break
        page.wait_for_timeout(100)
    assert len(seen) > 3
    assert len(places) == 1


def test_the_fleet_is_walked_with_the_keyboard(open_page: Open) -> None:
    page = open_page("/")
    first = page.locator(".map a").first
    expect(first).to_be_visible()
    page.keyboard.press("Tab")
    expect(page.get_by_role("link", name="Skip to content")).to_be_focused()
    first.focus()
    page.keyboard.press("ArrowRight")
    expect(page.locator(".map a").nth(1)).to_be_focused()
    name = page.locator(".map a").nth(1).get_attribute("aria-label").split(":")[0]
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", level=1)).to_have_text(name)


def test_an_asset_says_what_is_wrong_how_much_and_since_when(open_page: Open) -> None:
    page = open_page("/assets/press-1")
    verdict = page.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text(re.compile(r"Fault: leakage has risen by.*Cie \+(19|20)"))
    check = verdict.get_by_role("listitem").first
    # without a click or a scroll; there is no box while the page draws it anew
    until(lambda: (box := check.bounding_box()) is not None and box["y"] < SIZE["height"] / 2)
    expect(page.get_by_text("Statistic T²")).to_be_hidden()
    page.get_by_text("For experts").click()
    expect(page.get_by_role("img", name=re.compile("complex plane"))).to_have_count(3)
    expect(page.get_by_role("row", name=re.compile("θ₀"))).to_contain_text("A/m")
    expect(page.get_by_text("samples in")).to_be_visible()
    page.wait_for_timeout(3000)
    shot(page, "asset", full_page=True)
    assert painted(page)


def test_an_asset_says_how_its_fault_grows_and_what_to_check(open_page: Open, tmp_path: Path) -> None:
    page = open_page("/assets/press-1?limit=1.5&span=7+d")
    expect(page.get_by_role("region", name="What else it could be").first).to_contain_text("leakage")
    expect(page.get_by_label("What is followed")).to_have_value("leakage")
    expect(page.get_by_role("button", name="7 d").first).to_have_attribute("aria-pressed", "true")
    expect(page.get_by_text("values are shown")).to_be_visible()
    page.get_by_label("View and save: Size over time").click()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save the values: Size over time").click()
    path = tmp_path / "sizes.csv"
    download.value.save_as(path)
    series = read_sizes(path, "leakage", interval=("low", "high"))  # as servoscope trend reads it
    assert series.value[-1] == pytest.approx(1.2, abs=0.02) and 0.0 < series.std[-1] < 0.01
    with page.expect_download() as download:
        page.get_by_role("button", name="Save the picture: Size over time").click()
    download.value.save_as(tmp_path / "sizes.png")
    assert (tmp_path / "sizes.png").read_bytes().startswith(b"\x89PNG")
    page.get_by_text("Note what was done").click()
    page.get_by_label("What was done").fill("oil filter changed")
    page.get_by_role("button", name="Note it").click()
    expect(page.get_by_text(re.compile("oil filter changed \\(local\\)"))).to_be_visible()
    page.get_by_role("button", name="Keep samples for a new baseline").click()
    kept = page.get_by_text(re.compile("samples are kept as a recording"))
    expect(kept).to_be_visible()
    assert (
        int(re.sub(r"\D", "", kept.inner_text().split(":")[1].split("samples")[0])) > 3000
    )  # the window of 40 s at least
    page.get_by_role("link", name="Learn a baseline from it").click()
    expect(page.get_by_label("or one that was uploaded before")).to_contain_text("press-1")
    page.go_back()
    page.get_by_label("Limit, as a ratio to healthy").fill("1.3")
    page.keyboard.press("Tab")
    page.wait_for_url("**limit=1.3**")  # what is looked at can be sent to somebody


def test_a_chart_is_zoomed_saved_and_its_address_opens_the_same_view(open_page: Open, tmp_path: Path) -> None:
    page = open_page("/assets/press-1")
    label = "Both tests over time, as multiples of their limits"
    page.get_by_text("For experts").click()
    page.get_by_label(f"View and save: {label}").click()
    with page.expect_response(re.compile("/history\\?.*to=")):  # what is zoomed into is asked for more closely
        page.get_by_role("button", name=f"Zoom in: {label}").click()
    page.get_by_role("button", name=f"Earlier: {label}").press("Enter")  # by keyboard too
    page.wait_for_url("**view-both-tests*=0%2C50")
    with page.expect_download() as download:
        page.get_by_role("button", name=f"Save the values: {label}").click()
    download.value.save_as(tmp_path / "tests.csv")
    head, first, *_ = (tmp_path / "tests.csv").read_text().splitlines()
    assert head == "what,x,y" and re.match(r'"(statistic T²|sequential test)",20\d\d-', first)
    again = open_page(page.url.removeprefix(page.url.split("/assets")[0]))
    again.get_by_text("For experts").click()
    again.get_by_label(f"View and save: {label}").click()
    again.get_by_role("button", name=f"Later: {label}").click()
    again.wait_for_url("**view-both-tests*=25%2C75")  # on from where it was
    again.get_by_role("button", name=f"Show all: {label}").click()
    again.wait_for_url(lambda url: "view-" not in url)


def test_an_asset_shows_before_and_now_and_two_periods(open_page: Open) -> None:
    page = open_page("/assets/press-1")
    page.get_by_text("For experts").click()
    expect(page.get_by_role("img", name="Magnitude and phase over frequency, before and now")).to_be_visible()
    expect(page.get_by_role("img", name="Mean input over position and speed, before and now")).to_be_visible()
    expect(page.get_by_text(re.compile("^Friction band: .* now .* ± "))).to_be_visible()
    page.get_by_role("button", name="Compare").click()
    rows = page.get_by_role("region", name="Two periods side by side").get_by_role("row")
    expect(rows.filter(has_text="leakage")).to_contain_text("1.")
    expect(page.get_by_role("img", name=re.compile("^Both tests, (first|second) period"))).to_have_count(2)
    page.reload()
    expect(page.get_by_role("img", name="Both tests, second period")).to_be_visible()  # the address says which
    assert painted(page)


def test_a_phone_shows_cards_and_is_accessible(open_page: Open) -> None:
    for path in ("/", "/assets/press-1"):
        page = open_page(path, "dark")
        page.set_viewport_size({"width": 390, "height": 844})
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        page.wait_for_timeout(1000)
        accessible(page)
        assert page.evaluate("document.documentElement.scrollWidth") <= 390
        assert page.locator("table:visible, .grid:visible").evaluate_all(
            "all => all.every(one => one.scrollWidth <= 390)"
        )


def test_a_finger_zooms_and_pans_a_chart_and_scrolls_the_page(chromium: Any, base: str) -> None:
    size = {"width": 390, "height": 844}
    context = chromium.new_context(viewport=size, has_touch=True, is_mobile=True, locale="en-GB")
    page = context.new_page()
    page.goto(f"{base}/assets/press-1")
    page.get_by_text("For experts").click()
    chart = page.get_by_role("img", name="Both tests over time, as multiples of their limits")
    expect(chart).to_be_visible()
    page.wait_for_timeout(2000)  # what stands above it has come
    chart.scroll_into_view_if_needed()
    before = page.evaluate("scrollY")
    drag(page, chart.bounding_box(), 0.0, -120.0)
    page.wait_for_function(f"scrollY > {before + 60}")  # a chart is as wide as the phone, and lets the page go on
    box = chart.bounding_box()
    middle = {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}
    touch = context.new_cdp_session(page)
    touch.send("Input.synthesizePinchGesture", {**middle, "scaleFactor": 2.0, "gestureSourceType": "touch"})
    page.wait_for_url("**view-both-tests*")
    assert page.evaluate("[visualViewport.scale, document.documentElement.scrollWidth]") == [1, 390]
    zoomed = page.url
    drag(page, chart.bounding_box(), -120.0, 0.0)
    page.wait_for_url(lambda url: "view-both-tests" in url and url != zoomed)
    page.get_by_label("View and save: Both tests over time").tap()
    page.get_by_role("button", name="Show all: Both tests over time").tap()
    page.wait_for_url(lambda url: "view-" not in url)
    context.close()


def test_the_keyboard_alone_is_enough(open_page: Open, base: str) -> None:
    page = open_page("/")
    tab_to(page, "^Alarms$")
    page.keyboard.press("Enter")
    page.wait_for_url("**/alarms")
    standing = [one for one in asked(base, "/alarms")["alarms"] if one["asset"] == "press-3"]
    alarm = next(one["alarm"] for one in standing if "shelve" in one["commands"])
    row = page.get_by_role("row").filter(has=page.get_by_role("button", name=re.compile(f": {alarm} of press-3$")))
    expect(row).to_have_count(1)
    tab_to(page, f"^Shelve: {alarm} of press-3$")
    page.keyboard.press("Enter")
    expect(page.get_by_role("dialog")).to_be_visible()
    tab_to(page, "^Why")
    page.keyboard.type("sensor is on order")
    page.keyboard.press("Enter")
    expect(row).to_contain_text("shelved until")
    tab_to(page, f"^Unshelve: {alarm} of press-3$")
    page.keyboard.press("Enter")
    expect(row).not_to_contain_text("shelved until")
    tab_to(page, "^press-3$")
    page.keyboard.press("Enter")
    page.wait_for_url("**/assets/press-3")
    label = "Both tests over time, as multiples of their limits"
    tab_to(page, "^For experts")
    page.keyboard.press("Enter")
    tab_to(page, f"^View and save: {label}")
    page.keyboard.press("Enter")
    tab_to(page, f"^Zoom in: {label}")
    page.keyboard.press("Enter")
    page.wait_for_url("**view-both-tests*=25%2C75")
    tab_to(page, "^Note what was done")
    page.keyboard.press("Enter")
    tab_to(page, "^What was done")
    page.keyboard.type("sensor looked at")
    page.keyboard.press("Enter")
    expect(page.get_by_text("sensor looked at (local)")).to_be_visible()
    steps = [one["after"] for one in asked(base, "/assets/press-3/alarms")["transitions"] if one["alarm"] == alarm]
    assert "shelved" in steps and steps[-1] != "shelved"


def test_an_asset_is_live(open_page: Open) -> None:
    page = open_page("/assets/lift-1")
    last = page.locator("main p", has_text="Last sample")
    expect(last).to_contain_text(":")
    before, height = last.inner_text(), page.locator(".verdict").bounding_box()["height"]
    expect(last).not_to_have_text(before)
    page.get_by_text("For experts").click()
    page.get_by_role("button", name="24 h").click()
    expect(page.get_by_role("button", name="24 h")).to_have_attribute("aria-pressed", "true")
    assert page.locator(".verdict").bounding_box()["height"] == height


def test_a_diagnosis_prints_in_black_on_white(open_page: Open, base: str, tmp_path: Path) -> None:
    page = open_page(f"/diagnoses/{diagnosis_of(base, 'press-1')}", "dark")
    expect(page.get_by_role("region", name="Verdict")).to_contain_text("leakage has risen")
    page.get_by_text("For experts").click()
    page.wait_for_timeout(1000)
    pdf = page.pdf(path=tmp_path / "diagnosis.pdf", format="A4", print_background=True)
    assert len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 3 and len(pdf) > 20_000
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).color") == "rgb(28, 37, 48)"
    expect(page.locator("header.top")).to_be_hidden()
    page.wait_for_timeout(500)  # sizes are watched
    sizes = page.locator("canvas").evaluate_all("all => all.map(c => c.getBoundingClientRect().height)")
    assert painted(page) and min(sizes) > 50.0


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize(
    "path", ["/", "/assets/press-1", "/alarms", "/begin", "/diagnose", "/learn", "/design", "/nowhere", "diagnosis"]
)
def test_every_page_is_accessible(open_page: Open, base: str, path: str, theme: str) -> None:
    page = open_page(f"/diagnoses/{diagnosis_of(base, 'press-1')}" if path == "diagnosis" else path, theme)
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    page.wait_for_timeout(1000)
    accessible(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZE["width"]
    if (path, theme) == ("/", "dark"):
        shot(page, "fleet-dark")


@pytest.mark.parametrize("width", [1440, 800, 390])
def test_no_page_is_wider_than_its_window(open_page: Open, base: str, tmp_path: Path, width: int) -> None:
    wide = tmp_path / "wide.csv"  # what other columns a log has is its own affair
    rows = [[str(i / 100) for _ in range(17)] for i in range(300)]
    heads = ["t", "r", "u", "y", *(f"temperature_sensor_{i}" for i in range(13))]
    wide.write_text("\n".join(map(",".join, [heads, *rows])))
    page = open_page("/", "dark" if width == 800 else "light")
    page.set_viewport_size({"width": width, "height": SIZE["height"]})
    pages = [
        "/",
        "/assets/press-1",
        "/alarms",
        "/begin",
        "/diagnose",
        "/learn",
        "/design",
        f"/diagnoses/{diagnosis_of(base, 'press-1')}",
    ]
    for path in pages:
        page.goto(base + path)
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        if path in ("/begin", "/diagnose", "/learn"):
            page.locator("input[type=file]").set_input_files(wide)
            expect(page.get_by_role("region", name="The first rows of wide.csv")).to_be_visible()
        if path == "/alarms":
            last = page.get_by_role("button", name="Out of service: fault of press-1").bounding_box()
            assert last["x"] + last["width"] <= width
        assert page.evaluate("document.documentElement.scrollWidth") <= width, path
        accessible(page)


SAID = {  # by the service: as the pages say it
    "T^2 is 1.27e+03 times its limit (p = 3e-69)": "T² is 1270 times its limit (p = 3 × 10⁻⁶⁹)",
    "a budget of 3.16e+06 false alarms": "a budget of 3.16 × 10⁶ false alarms",
    "set [monitor] model_error = 0.049": "set [monitor] model_error = 0.049",
    "explains only 62% of u": "explains only 62\u00a0% of u",
    "delay -0.00 samples (-0.00841 ms)": "delay 0.00 samples (−0.00841\u00a0ms)",
    "press-1 on 2026-11-21": "press-1 on 2026-11-21",
    "theta_0 fits valve_gain": "θ₀ fits valve gain",
}


def test_sentences_and_numbers_keep_to_one_style(open_page: Open) -> None:
    page = open_page("/")
    words = "(await import('/static/words.js'))"
    for said, shown in SAID.items():
        assert page.evaluate(f"async text => {words}.sentence(text)", said) == shown
    assert page.evaluate(f"async () => {words}.withStd(-4e-9, 3.6e-7, 1e-6)") == ["0.0", "0.4 × 10⁻⁶", "1.0 × 10⁻⁶"]
    assert page.evaluate(f"async () => {words}.capital('p_s is low')") == "p_s is low"


def test_the_switch_changes_colours_and_is_remembered(open_page: Open) -> None:
    page = open_page("/")
    paper = "getComputedStyle(document.documentElement).backgroundColor"
    light = page.evaluate(paper)
    page.get_by_role("button", name="Switch to dark colours").click()
    dark = page.evaluate(paper)
    assert light != dark
    page.reload()
    assert page.evaluate(paper) == dark


def test_the_page_says_when_the_service_is_gone_and_when_it_is_back(
    chromium: Any, config: Path, open_page: Open
) -> None:
    with screens.serving(config) as address:
        page = open_page("/", address=address, quiet=("ERR_", "Failed to load"))
        link = page.locator(".link")
        expect(link).to_have_text("Live")
        port = address.rsplit(":", 1)[1]
    expect(link).to_have_text("Connection lost, trying again")
    with screens.process("serve", config.name, "--listen", f"127.0.0.1:{port}", cwd=config.parent):
        expect(link).to_have_text("Live")


def test_login_is_refused_and_granted_by_role(open_page: Open, config: Path, users: str) -> None:
    with screens.serving(config, "--users", users) as address:
        page = open_page("/alarms", address=address, quiet=("401", "ERR_"))
        expect(page.get_by_role("heading", name="Log in")).to_be_visible()
        accessible(page)
        page.get_by_label("User").fill("vera")
        page.get_by_label("Password").fill("wrong")
        page.get_by_role("button", name="Log in").click()
        expect(page.get_by_role("alert")).to_be_visible()
        page.get_by_label("Password").fill("correct horse battery")
        page.get_by_role("button", name="Log in").click()
        page.wait_for_url("**/alarms")  # where she wanted to be
        expect(page.get_by_text("vera, viewer")).to_be_visible()
        expect(page.get_by_role("region", name="Alarms, the most urgent first")).to_contain_text("operators answer")
        expect(page.get_by_role("button", name=re.compile("^Acknowledge"))).to_have_count(0)
        page.get_by_role("button", name="Log out").click()
        page.get_by_label("User").fill("otto")
        page.get_by_label("Password").fill("correct horse battery")
        page.get_by_role("button", name="Log in").click()
        expect(page.get_by_text("otto, operator")).to_be_visible()
