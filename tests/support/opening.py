"""A browser in front of a followed hall, one of each for a file of tests; and what these look at in common."""

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
from PIL import Image
from screens import asked, until

SIZE = {"width": 1366, "height": 768}
THEMES = ("light", "dark")
PATIENCE_MS = 30_000.0
LONG_MS = 180_000.0  # learning and designing, on a busy machine
Open = Callable[..., Any]


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is missing: make install brings it")
    found = screens.browser()
    if found is None:
        pytest.skip("there is no Chromium: scripts/install-test-servers installs it")
    with playwright.sync_playwright() as driver:
        launched = driver.chromium.launch(executable_path=found, args=["--no-sandbox", "--disable-dev-shm-usage"])
        playwright.expect.set_options(timeout=PATIENCE_MS)
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
            stuck = asked(address, "/assets/press-3")
            # it looks like a fault until its full diagnosis has seen the sensor
            return named and judged and bool(stuck["quality"]) and stuck["verdict"] == "undetermined"

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


@pytest.fixture(scope="module")
def users(config: Path) -> str:
    """The name of a file of users beside the service file: vera may look, otto may answer."""
    for name, role in (("vera", "viewer"), ("otto", "operator")):
        command = [sys.executable, "-m", "servoscope", "users", "add", name, "--role", role, "--users", "users.json"]
        environment = os.environ | {"PYTHONPATH": screens.SOURCES}
        said = [*command, "--password-stdin"]
        subprocess.run(said, cwd=config.parent, input=b"correct horse battery\n", check=True, env=environment)
    return "users.json"


def shot(page: Any, name: str, **how: Any) -> None:
    """Write a picture for the docs, where one is asked for; else compare what it shows with the one that is there."""
    from sources import load  # not above: this file is a plugin of all tests, also of those in a copy without scripts

    pictures, picture = load(Path(__file__).resolve().parents[2] / "scripts" / "pictures.py"), f"pages/{name}.png"
    words = page.eval_on_selector_all("nav a, h1", "all => all.filter(e => e.checkVisibility()).map(e => e.innerText)")
    shows, folder = pictures.shown_by_page(words), os.environ.get("SCREENSHOTS")
    if not folder:
        assert pictures.stale(picture, shows) == "", words
        return
    page.mouse.move(0, 0)
    page.wait_for_timeout(600)
    path = Path(folder) / f"{name}.png"
    page.screenshot(path=path, **how)
    Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)  # a third of the size, in the same colours
    pictures.record(picture, shows)


def accessible(page: Any) -> None:
    """No finding of axe-core: contrast, names, roles, order of headings and so on."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(page, options={"resultTypes": ["violations"]}).response["violations"]
    told = [f"{one['id']}: {one['help']}: {[node['html'][:200] for node in one['nodes'][:3]]}" for one in found]
    assert told == []


def fits(page: Any, *widths: int) -> None:
    """At each width nothing scrolls sideways, and axe finds nothing at the last one, in light and dark."""
    for width in widths:
        page.set_viewport_size({"width": width, "height": 844})
        page.wait_for_timeout(300)
        assert page.evaluate("document.documentElement.scrollWidth") <= width, (page.url, width)
    for theme in THEMES:
        page.emulate_media(color_scheme=theme)
        page.wait_for_timeout(300)
        accessible(page)


def tab_to(page: Any, name: str) -> None:
    """Press Tab until what is focused is called so."""
    seen = []
    for _ in range(250):
        page.keyboard.press("Tab")
        one = page.evaluate(
            "(e => e.getAttribute('aria-label') ?? e.labels?.[0]?.innerText ?? e.innerText)(document.activeElement)"
        )
        seen.append(str(one)[:80])
        if re.search(name, seen[-1]):
            return
    raise AssertionError(f"Tab does not come to {name}: {seen}")


def drag(page: Any, box: dict[str, float], dx: float, dy: float) -> None:
    """Drag one finger from the middle of a box."""
    touch = page.context.new_cdp_session(page)
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for k in range(11):
        points = [{"x": x + dx * k / 10, "y": y + dy * k / 10}]
        touch.send("Input.dispatchTouchEvent", {"type": "touchMove" if k else "touchStart", "touchPoints": points})
        page.wait_for_timeout(16)
    touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def painted(page: Any) -> bool:
    """Whether every chart has something in it."""
    one = "c => c.width > 0 && [...c.getContext('2d').getImageData(0, 0, c.width, c.height).data].some(Boolean)"
    return all(page.locator("canvas").evaluate_all(f"all => all.map({one})"))


def diagnosis_of(base: str, asset: str) -> str:
    return str(
        [one for one in asked(base, f"/diagnoses?asset={asset}")["diagnoses"] if one["grounds"] == "full"][-1]["id"]
    )
