"""The pages in a real browser, in front of a hall that is really followed: what a person sees and can do.

SCREENSHOTS=docs/images/pages writes the pictures of README and docs while the tests pass through the pages.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import screens
from screens import asked, until

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = [pytest.mark.slow, pytest.mark.xdist_group("pages")]

SIZE = {"width": 1366, "height": 768}
THEMES = ("light", "dark")
PATIENCE_MS = 30_000.0
LONG_MS = 180_000.0  # learning and designing, on a busy machine
Open = Callable[..., Any]
SIGNALS = ("Time", "Reference r", "Input u", "Output y")


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    found = screens.browser()
    if found is None:
        pytest.skip("there is no Chromium: scripts/install-test-servers installs it")
    with playwright.sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=found, args=["--no-sandbox", "--disable-dev-shm-usage"])
        expect.set_options(timeout=PATIENCE_MS)
        yield launched
        launched.close()


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("hall")
    screens.recordings(folder)
    return screens.hall(folder)


@pytest.fixture(scope="module")
def base(chromium: Any, config: Path) -> Iterator[str]:
    """The address of the pages, once the hall has its faults and what is wrong with them is known in full."""
    with screens.process("run", config.name, cwd=config.parent) as running, screens.serving(config) as address:

        def known() -> bool:
            assert running.poll() is None, (config.parent / "run.log").read_text()
            named = all(asked(address, f"/assets/{asset}")["sizes"] for asset in ("press-1", "rig-1"))
            rows = asked(address, "/assets")["assets"]
            judged = all(row["examined"] for row in rows)  # from now on nobody changes places
            return named and judged and bool(asked(address, "/assets/press-3")["quality"])

        until(known, 240.0)
        yield address


@pytest.fixture
def open_page(chromium: Any, base: str) -> Iterator[Open]:
    """Opens pages; whatever a page complains of in its console, its policy included, fails the test."""
    contexts, complaints = [], []

    def opened(path: str, theme: str = "light", address: str = base, *, quiet: tuple[str, ...] = ()) -> Any:
        context = chromium.new_context(viewport=SIZE, color_scheme=theme, locale="en-GB", timezone_id="UTC")
        contexts.append(context)
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)

        def heard(message: Any) -> None:
            if message.type == "error" and not any(word in message.text for word in quiet):
                complaints.append(message.text)

        page.on("console", heard)
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(address + path)
        return page

    yield opened
    for context in contexts:
        context.close()
    assert complaints == []


def shot(page: Any, name: str, **how: Any) -> None:
    """Write a picture for the docs, where one is asked for."""
    folder = os.environ.get("SCREENSHOTS")
    if folder:
        page.mouse.move(0, 0)
        page.wait_for_timeout(600)
        page.screenshot(path=str(Path(folder) / f"{name}.png"), **how)


def accessible(page: Any) -> None:
    """No serious finding of axe-core: contrast, names, roles, order of headings and so on."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"]
    serious = [one for one in found if one["impact"] in ("serious", "critical")]
    told = [f"{one['id']}: {one['help']}: {[node['html'][:200] for node in one['nodes'][:3]]}" for one in serious]
    assert told == []


def painted(page: Any) -> bool:
    """Whether every chart has something in it."""
    one = "c => c.width > 0 && [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].some(Boolean)"
    return all(page.locator("canvas").evaluate_all(f"all => all.map({one})"))


def diagnosis_of(base: str, asset: str) -> str:
    return str(
        [one for one in asked(base, f"/diagnoses?asset={asset}")["diagnoses"] if one["grounds"] == "full"][-1]["id"]
    )


def test_the_fleet_shows_the_worst_first(open_page: Open) -> None:
    page = open_page("/")
    rows = page.get_by_role("table", name="Assets, worst first").get_by_role("row")
    expect(rows).to_have_count(1 + screens.ASSETS)
    expect(rows.nth(1)).to_contain_text("Fault")
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
    verdict = page.get_by_role("region", name="Verdict on press-1")
    expect(verdict).to_contain_text("Internal leakage")
    expect(verdict).to_contain_text("Since")
    expect(verdict).to_contain_text(re.compile(r"Cie \+(19|20)"))
    expect(page.get_by_role("img", name=re.compile("complex plane"))).to_have_count(3)
    expect(page.get_by_role("row", name=re.compile("θ₀"))).to_contain_text("A/m")
    expect(page.get_by_text("samples in")).to_be_visible()
    page.wait_for_timeout(3000)
    shot(page, "asset", full_page=True)
    assert painted(page)


def test_an_asset_is_live(open_page: Open) -> None:
    page = open_page("/assets/lift-1")
    last = page.locator(".facts dd").last
    expect(last).to_contain_text(":")
    before, height = last.inner_text(), page.locator(".verdict").bounding_box()["height"]
    expect(last).not_to_have_text(before)
    page.get_by_role("button", name="24 h").click()
    expect(page.get_by_role("button", name="24 h")).to_have_attribute("aria-pressed", "true")
    assert page.locator(".verdict").bounding_box()["height"] == height


def test_an_alarm_is_acknowledged_and_another_shelved(open_page: Open, base: str) -> None:
    page, watching = open_page("/alarms"), open_page("/assets/press-1")
    row = page.get_by_role("row").filter(has=page.get_by_role("link", name="press-1")).first
    expect(row).to_contain_text("plan an inspection")
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


def test_a_recording_is_dropped_inspected_and_diagnosed(open_page: Open, eha_cases: Path) -> None:
    page = open_page("/diagnose")
    page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
    expect(page.get_by_role("heading", name="Is it usable?")).to_be_visible(timeout=LONG_MS)
    expect(page.get_by_label("Input u")).to_have_value("u")
    page.wait_for_timeout(500)
    accessible(page)
    page.get_by_label("Compare with the baseline").select_option(index=0)
    page.get_by_role("button", name="Diagnose").click()
    page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)
    verdict = page.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text("Internal leakage")
    expect(page.get_by_role("heading", name="Candidates")).to_be_visible()
    shot(page, "diagnosis", full_page=True)
    page.reload()  # its address is permanent
    expect(verdict).to_contain_text("Internal leakage")
    for theme in THEMES:
        page.emulate_media(color_scheme=theme)
        accessible(page)
    with page.expect_popup() as report:
        page.get_by_role("link", name="Report as one file").click()
    expect(report.value.get_by_role("heading", name="Internal leakage")).to_be_visible()


def test_what_was_typed_in_is_there_again(open_page: Open, eha_cases: Path) -> None:
    page = open_page("/diagnose")
    page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
    page.get_by_label("Output y").fill("y + 0")
    page.get_by_label("From [s]").fill("1.5")
    page.get_by_role("button", name="Diagnose").click()
    page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)
    diagnosis = page.url
    page.go_back()
    expect(page.get_by_label("Output y")).to_have_value("y + 0")
    expect(page.get_by_label("From [s]")).to_have_value("1.5")
    page.goto(diagnosis)
    page.get_by_role("link", name="Diagnose again").click()
    expect(page.get_by_label("From [s]")).to_have_value("1.5")


def test_a_loop_file_that_was_typed_in_survives_a_reload(open_page: Open, project: Path) -> None:
    page = open_page("/learn")
    text = (project / "examples" / "emps.toml").read_text()
    page.get_by_role("combobox", name="Loop", exact=True).select_option("a loop file of your own")
    page.get_by_label("Loop file (TOML)").last.fill(text)
    page.reload()
    expect(page.get_by_label("Loop file (TOML)").last).to_have_value(text)


def test_a_diagnosis_prints_in_black_on_white(open_page: Open, base: str, tmp_path: Path) -> None:
    page = open_page(f"/diagnoses/{diagnosis_of(base, 'press-1')}", "dark")
    expect(page.get_by_role("region", name="Verdict")).to_contain_text("Internal leakage")
    pdf = page.pdf(path=tmp_path / "diagnosis.pdf", format="A4", print_background=True)
    assert pdf.startswith(b"%PDF-") and len(pdf) > 20_000
    page.emulate_media(media="print")
    assert page.evaluate("getComputedStyle(document.body).color") == "rgb(28, 37, 48)"
    expect(page.locator("header.top")).to_be_hidden()
    page.wait_for_timeout(500)  # sizes are watched
    sizes = page.locator("canvas").evaluate_all("all => all.map(c => c.getBoundingClientRect().height)")
    assert painted(page) and min(sizes) > 50.0


def test_what_cannot_be_read_is_said(open_page: Open, eha_cases: Path, tmp_path: Path) -> None:
    page = open_page("/diagnose", quiet=("422",))
    page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
    expect(page.get_by_role("heading", name="What is what")).to_be_visible()
    broken = tmp_path / "broken.csv"
    broken.write_bytes(b"\x00\xff nothing that a log would be")
    page.get_by_label("Drop a recording here").set_input_files(broken)
    expect(page.get_by_role("alert")).to_contain_text("broken.csv")
    expect(page.get_by_role("heading", name="What is what")).to_have_count(0)  # that was of another file


def test_a_real_axis_is_learned_and_then_healthy(open_page: Open, shared_data: Path, project: Path) -> None:
    log = shared_data / "real" / "emps" / "DATA_EMPS.mat"
    page = open_page("/learn")
    page.get_by_role("combobox", name="Loop", exact=True).select_option("a loop file of your own")
    text = (project / "examples" / "emps.toml").read_text().replace('output = "qm"', 'output = "1.0 * qm"')
    page.get_by_label("Loop file (TOML)").last.fill(text)
    page.get_by_label("Drop healthy recordings here").set_input_files(log)
    expect(page.get_by_role("region", name="Recordings to learn from")).to_contain_text("DATA_EMPS.mat")
    expect(page.get_by_text("As the loop file says.")).to_be_visible()
    assert [page.get_by_label(name, exact=True).input_value() for name in SIGNALS] == [""] * 4
    page.get_by_role("button", name="Inspect them").click()
    expect(page.get_by_role("region", name="Recordings to learn from")).to_contain_text("usable", timeout=LONG_MS)
    page.get_by_role("button", name="Learn").click()
    expect(page.get_by_role("heading", name="What was learned")).to_be_visible(timeout=LONG_MS)
    shot(page, "learn", full_page=True)
    accessible(page)
    page.get_by_label("Save as").fill("emps")
    page.get_by_role("button", name="Save").click()
    page.get_by_role("link", name="diagnose a recording with it").click()
    page.get_by_label("Drop a recording here").set_input_files(log)
    expect(page.get_by_label("Compare with the baseline")).to_be_visible()
    # the columns are the baseline's, not what their names look like; without one that fits they are guessed
    assert [page.get_by_label(name, exact=True).input_value() for name in SIGNALS] == ["t", "qg", "vir", "1.0 * qm"]
    expect(page.get_by_text("As the loop says.")).to_be_visible()
    page.get_by_label("Compare with the baseline").select_option(index=0)
    expect(page.get_by_text("Guessed from the names")).to_be_visible()
    page.get_by_label("Compare with the baseline").select_option("emps")
    page.get_by_label("From [s]").fill("12.4")
    page.get_by_role("button", name="Diagnose").click()
    page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)
    expect(page.get_by_role("region", name="Verdict")).to_contain_text("Healthy")


def test_a_study_says_what_can_be_told_apart(open_page: Open) -> None:
    page = open_page("/design")
    page.get_by_role("combobox", name="Loop", exact=True).select_option(index=0)
    page.get_by_role("button", name="Study").click()
    expect(page.get_by_role("heading", name="How alike they look")).to_be_visible(timeout=LONG_MS)
    expect(page.get_by_role("region", name="Radii of faults")).to_contain_text("Leakage up")
    shot(page, "design", full_page=True)
    accessible(page)


@pytest.mark.parametrize("theme", THEMES)
@pytest.mark.parametrize(
    "path", ["/", "/assets/press-1", "/alarms", "/diagnose", "/learn", "/design", "/nowhere", "diagnosis"]
)
def test_every_page_is_accessible(open_page: Open, base: str, path: str, theme: str) -> None:
    page = open_page(f"/diagnoses/{diagnosis_of(base, 'press-1')}" if path == "diagnosis" else path, theme)
    expect(page.get_by_role("heading", level=1)).to_be_visible()
    page.wait_for_timeout(1000)
    accessible(page)
    assert page.evaluate("document.documentElement.scrollWidth") <= SIZE["width"]
    if (path, theme) == ("/", "dark"):
        shot(page, "fleet-dark")


@pytest.mark.parametrize("width", [1366, 800, 500])
def test_no_page_is_wider_than_its_window(open_page: Open, base: str, tmp_path: Path, width: int) -> None:
    wide = tmp_path / "wide.csv"  # what other columns a log has is its own affair
    rows = [[str(i / 100) for _ in range(17)] for i in range(300)]
    heads = ["t", "r", "u", "y", *(f"temperature_sensor_{i}" for i in range(13))]
    wide.write_text("\n".join(map(",".join, [heads, *rows])))
    page = open_page("/")
    page.set_viewport_size({"width": width, "height": SIZE["height"]})
    pages = [
        "/",
        "/assets/press-1",
        "/alarms",
        "/diagnose",
        "/learn",
        "/design",
        f"/diagnoses/{diagnosis_of(base, 'press-1')}",
    ]
    for path in pages:
        page.goto(base + path)
        expect(page.get_by_role("heading", level=1)).to_be_visible()
        if path in ("/diagnose", "/learn"):
            page.locator("input[type=file]").set_input_files(wide)
            expect(page.get_by_role("region", name="The first rows of wide.csv")).to_be_visible()
        if path == "/alarms":
            last = page.get_by_role("button", name="Out of service: fault of press-1").bounding_box()
            assert last["x"] + last["width"] <= width
        assert page.evaluate("document.documentElement.scrollWidth") <= width, path


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


@pytest.fixture(scope="module")
def users(config: Path) -> str:
    """The name of a file of users beside the service file: vera may look, otto may answer."""
    for name, role in (("vera", "viewer"), ("otto", "operator")):
        command = [sys.executable, "-m", "servoscope", "users", "add", name, "--role", role, "--users", "users.json"]
        environment = os.environ | {"PYTHONPATH": screens.SOURCES}
        said = [*command, "--password-stdin"]
        subprocess.run(said, cwd=config.parent, input=b"correct horse battery\n", check=True, env=environment)
    return "users.json"


def test_a_session_that_is_over_begins_again_on_the_page(
    open_page: Open, config: Path, users: str, eha_cases: Path
) -> None:
    def log_in() -> None:
        page.get_by_label("User").fill("otto")
        page.get_by_label("Password").fill("correct horse battery")
        page.get_by_role("button", name="Log in").click()

    with screens.serving(config, "--users", users) as address:
        page = open_page("/diagnose", address=address, quiet=("401", "ERR_"))
        log_in()
        page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
        expect(page.get_by_role("heading", name="Is it usable?")).to_be_visible(timeout=LONG_MS)
    page.get_by_label("From [s]").fill("2.5")
    listen = address.removeprefix("http://")
    with screens.process("serve", config.name, "--listen", listen, "--users", users, cwd=config.parent):
        until(lambda: asked(address, "/session"))
        page.get_by_role("button", name="Diagnose").click()
        expect(page.get_by_role("dialog", name="Log in again")).to_be_visible()
        accessible(page)
        page.keyboard.press("Escape")
        expect(page.get_by_role("alert")).to_contain_text("log in first")
        page.get_by_role("button", name="Diagnose").click()
        log_in()
        page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)  # what was asked for is done
        expect(page.get_by_role("region", name="Verdict")).to_contain_text("Internal leakage")


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
