#!/usr/bin/env python3
"""Draws the beginning of a page as a picture, for make pictures: screenshot.py PAGE.html PICTURE.png."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SIZE = "1005,1220"  # of the report in README

if __name__ == "__main__":
    browser = next((path for path in map(shutil.which, BROWSERS) if path), None)
    if browser is None:
        sys.exit(f"no browser: one of {', '.join(BROWSERS)} is needed")
    page, picture = (Path(name).resolve() for name in sys.argv[1:])
    flags = "--headless", "--no-sandbox", "--disable-dev-shm-usage", "--hide-scrollbars", f"--window-size={SIZE}"
    command = [browser, *flags, f"--screenshot={picture}", page.as_uri()]
    subprocess.run(command, check=True, capture_output=True, timeout=120)
