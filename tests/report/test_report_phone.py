"""Reports on a phone and a small screen, in a real browser: nothing but tables scrolls sideways."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import servoscope as ss
from golden.results import FOLDER
from servoscope.assessment.assess import assess
from servoscope.learning.inspection import inspect
from servoscope.report.assessment_page import write_assessment_page
from servoscope.report.inspection_page import write_inspection_page

pytestmark = pytest.mark.slow

WIDTHS = 390, 1280
BEYOND = """(width) => [...document.querySelectorAll("h1, h2, p, li, dt, dd, header, figure svg")].filter(
  (one) => !one.closest(".scroll") && one.getBoundingClientRect().right > width
).map((one) => one.textContent)"""


def test_reports_are_read_at_the_width_of_a_phone_and_of_a_small_screen(chromium: Any, tmp_path: Path) -> None:
    baseline = ss.Baseline.load(FOLDER / "rig.json")
    recording = ss.read(FOLDER / "suspect.parquet", baseline.loop)
    ss.write_report(tmp_path / "diagnosis.html", baseline, recording)
    write_inspection_page(tmp_path / "inspection.html", inspect(recording, baseline.loop), recording)
    t = np.arange(0.0, 60.0, 0.1)
    log = {"t": t, "r": np.ones_like(t), "u": 0.5 - 0.1 * np.sin(t), "y": 1.0 + 0.1 * np.sin(t)}
    write_assessment_page(tmp_path / "assessment.html", assess(log, name=f"{'long' * 20}.csv"))
    page = chromium.new_page()
    for path in sorted(tmp_path.glob("*.html")):
        for width in WIDTHS:
            page.set_viewport_size({"width": width, "height": 844})
            page.goto(path.as_uri())
            first = page.get_by_role("heading", level=1).bounding_box()
            assert width > WIDTHS[0] or first["y"] + first["height"] < 844.0
            if path.stem == "diagnosis":  # the picture of the change comes next to the verdict
                title = page.get_by_role("heading", level=2, name="What has changed").bounding_box()
                assert title["y"] < 844.0
            page.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = true))")
            assert page.evaluate("document.documentElement.scrollWidth") <= width, path.name
            assert page.evaluate(BEYOND, width) == []
    page.close()
