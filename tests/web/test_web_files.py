"""The pages in a real browser: files of one's own, from the drop to the verdict; a session or service that ends."""

from __future__ import annotations

import re
from pathlib import Path

import halls
import pytest
import screens
from commands import run
from logs import german_axis
from opening import LONG_MS, THEMES, Open, accessible, fits, shot
from screens import asked, until

playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
expect = playwright.expect

pytestmark = pytest.mark.slow

SIGNALS = ("Time", "Reference r", "Input u", "Output y")


def test_a_recording_is_dropped_inspected_and_diagnosed(open_page: Open, eha_cases: Path) -> None:
    page = open_page("/diagnose")
    page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
    expect(page.get_by_role("heading", name="Is it usable?")).to_be_visible(timeout=LONG_MS)
    expect(page.get_by_label("Input u", exact=True)).to_have_value("u")
    page.wait_for_timeout(500)
    accessible(page)
    page.get_by_label("Compare with the baseline").select_option(index=0)
    page.get_by_role("button", name="Diagnose").click()
    page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)
    verdict = page.get_by_role("region", name="Verdict")
    expect(verdict).to_contain_text("leakage has risen")
    expect(page.get_by_role("heading", name="What else it could be")).to_be_visible()
    shot(page, "diagnosis", full_page=True)
    page.reload()  # its address is permanent
    expect(verdict).to_contain_text("leakage has risen")
    for theme in THEMES:
        page.emulate_media(color_scheme=theme)
        accessible(page)
    with page.expect_popup() as report:
        page.get_by_role("link", name="Report as one file").click()
    expect(report.value.get_by_role("heading", name=re.compile("leakage has risen"))).to_be_visible()


def test_what_was_typed_in_is_there_again(open_page: Open, eha_cases: Path) -> None:
    page = open_page("/diagnose")
    page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
    page.get_by_label("Output y", exact=True).select_option("a combination")
    page.get_by_label("Output y: a combination").fill("y + 0")
    page.get_by_label("From [s]").fill("1.5")
    page.get_by_role("button", name="Diagnose").click()
    page.wait_for_url("**/diagnoses/*", timeout=LONG_MS)
    diagnosis = page.url
    page.go_back()
    expect(page.get_by_label("Output y: a combination")).to_have_value("y + 0")
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


def test_what_cannot_be_read_is_said(open_page: Open, eha_cases: Path, tmp_path: Path) -> None:
    page = open_page("/diagnose", quiet=("422",))
    page.get_by_label("Drop a recording here").set_input_files(eha_cases / "multisine_C_iex1.2_11.csv")
    expect(page.get_by_role("heading", name="What is what")).to_be_visible()
    broken = tmp_path / "broken.csv"
    broken.write_bytes(b"\x00\xff nothing that a log would be")
    page.get_by_label("Drop a recording here").set_input_files(broken)
    expect(page.get_by_role("alert")).to_contain_text("broken.csv")
    expect(page.get_by_role("heading", name="What is what")).to_have_count(0)  # that was of another file


def test_from_a_log_to_a_baseline_without_a_line_of_toml(open_page: Open, tmp_path: Path) -> None:
    log = german_axis(tmp_path / "achse.csv")
    page = open_page("/begin")
    page.get_by_label("Drop a log here").set_input_files(log)
    proposed = page.get_by_role("region", name="Proposed settings")
    expect(proposed).to_contain_text("mm in the name, factor to SI units", timeout=LONG_MS)
    expect(page.get_by_role("heading", name="Is the log usable?")).to_be_visible()
    expect(page.get_by_text("Usable with care", exact=True)).to_be_visible()
    with page.expect_download() as download:
        page.get_by_role("button", name="Save loop.toml").click()
    download.value.save_as(tmp_path / "page.toml")
    assert run("init", log, "-o", tmp_path / "terminal.toml", "--yes").code == 0
    assert (tmp_path / "page.toml").read_bytes() == (tmp_path / "terminal.toml").read_bytes()
    accessible(page)
    page.get_by_label("Cutoff [Hz]").fill("much")
    page.get_by_role("button", name="Inspect with these").click()
    expect(page.get_by_role("alert")).to_have_text("Cutoff [Hz]: much is no number")
    page.get_by_label("Cutoff [Hz]").fill("0.75")
    page.get_by_role("button", name="Inspect with these").click()
    expect(page.get_by_role("alert")).to_have_count(0)
    shot(page, "begin", full_page=True)
    page.get_by_role("button", name="Learn a baseline with these").click()
    expect(page.get_by_role("region", name="Recordings to learn from")).to_contain_text("achse.csv")
    expect(page.get_by_label("Loop file (TOML)").last).to_have_value(re.compile("cutoff = 0.75  # changed by hand"))
    page.get_by_role("button", name="Learn", exact=True).click()
    expect(page.get_by_role("heading", name="What was learned")).to_be_visible(timeout=LONG_MS)


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
    fits(page, 1440, 800, 390)
    for i in range(5):
        page.get_by_label("Save as").fill(f"emps-{i}")
        page.get_by_role("button", name="Save").click()
        expect(page.get_by_text(f"Saved as emps-{i}:")).to_be_visible()
    page.get_by_text("A new machine among like ones").click()
    for i in range(5):
        page.get_by_label(f"Use emps-{i}").check()
    page.get_by_role("button", name="Learn").click()
    expect(page.get_by_text("learned with 5 like machines as a prior")).to_be_visible(timeout=LONG_MS)
    page.get_by_label("Save as").fill("emps")
    page.get_by_role("button", name="Save").click()
    page.get_by_role("link", name="diagnose a recording with it").click()
    page.get_by_label("Drop a recording here").set_input_files(log)
    expect(page.get_by_label("Compare with the baseline")).to_be_visible()
    # the columns are the baseline's, not what their names look like; without one that fits they are guessed
    assert [page.get_by_label(name, exact=True).input_value() for name in SIGNALS] == ["t", "qg", "vir", "*"]
    expect(page.get_by_label(f"{SIGNALS[3]}: a combination", exact=True)).to_have_value("1.0 * qm")
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
    limits = page.get_by_role("region", name="Limits of faults").get_by_role("row")
    mimics = page.get_by_role("region", name="Mimics").get_by_role("rowheader")
    assert "a further delay" in mimics.all_inner_texts()
    expect(limits.filter(has_text="Pump down")).to_contain_text("0.41")  # where tracking is lost
    shot(page, "design", full_page=True)
    fits(page, 1440, 800, 390)


def test_a_service_that_stops_is_told_and_its_restart_too(open_page: Open, tmp_path: Path) -> None:
    """The server goes on without the service; the page's own clock is put forward by the minute that it waits."""
    halls.files(tmp_path)
    path = halls.hall(tmp_path, "small", speed=1.0)
    with screens.serving(path) as address:
        with screens.process("run", path.name, cwd=tmp_path):
            until(lambda: len(asked(address, "/assets")["assets"]) == 2)
            page = open_page("/", address=address)
            page.clock.install()
            page.reload()
            link = page.locator(".link")
            expect(link).to_have_text("Live")
        page.clock.fast_forward("01:05")
        expect(link).to_have_text("Nothing new: does the service run?")
        accessible(page)
        with screens.process("run", path.name, cwd=tmp_path):
            expect(link).to_have_text("Live", timeout=LONG_MS)


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
        expect(page.get_by_role("region", name="Verdict")).to_contain_text("leakage has risen")
