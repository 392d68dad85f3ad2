"""Public names by name, for methods of results that lead to packages above theirs: looked up when they are called."""

from __future__ import annotations

import base64
import io
import sys
from typing import Any

PICTURE_DPI = 60


def public_name(name: str) -> Any:
    """Return what ``servoscope.NAME`` is; the package is loaded whenever one of its modules is."""
    return getattr(sys.modules["servoscope"], name)


def picture_html(thing: object) -> str:
    """Return what ``servoscope.plot`` draws as an image for the table of a notebook."""
    import matplotlib.pyplot as plt

    file, figure = io.BytesIO(), public_name("plot")(thing)[0].figure
    figure.savefig(file, format="png", dpi=PICTURE_DPI)
    plt.close(figure)
    return f'<img alt="plot" src="data:image/png;base64,{base64.b64encode(file.getvalue()).decode()}">'
