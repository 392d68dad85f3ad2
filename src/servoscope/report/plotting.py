"""What pictures are drawn with: colours, envelopes of long signals, ranges of axes, SVG for a page, files."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.resources import files
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.text import Text

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.errors import OutputError
from servoscope.core.files import atomic_write
from servoscope.core.messages import translate
from servoscope.report.downsample import downsample_indices

# The light side of palette.css, which reports and pages share.
COLOURS: dict[str, str] = dict(
    re.findall(
        r"--(\w+): light-dark\((#\w+)", files("servoscope.report").joinpath("palette.css").read_text(encoding="utf-8")
    )
)
STYLE: dict[str, Any] = {
    "axes.edgecolor": COLOURS["muted"],
    "axes.facecolor": "none",
    "axes.formatter.useoffset": False,
    "axes.labelcolor": COLOURS["ink"],
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.7,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": COLOURS["ink"],
    "axes.titlesize": 9.5,
    "figure.facecolor": "none",
    "figure.constrained_layout.h_pad": 0.06,
    "font.size": 8.5,
    "legend.borderaxespad": 0.0,
    "legend.columnspacing": 1.6,
    "legend.fontsize": 8.5,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "legend.labelcolor": COLOURS["ink"],
    "lines.linewidth": 1.2,
    "savefig.facecolor": "none",
    "svg.hashsalt": "servoscope",  # the same diagnosis gives the same bytes
    "text.color": COLOURS["ink"],
    "xtick.color": COLOURS["muted"],
    "xtick.labelcolor": COLOURS["ink"],
    "ytick.color": COLOURS["muted"],
    "ytick.labelcolor": COLOURS["ink"],
}
WIDTH = 9.0  # inches; a page scales pictures to its own width
COLUMNS = 1200  # of an envelope
FORMATS = ("svg", "png", "pdf")


@contextmanager
def plot_style(fonttype: str = "path") -> Iterator[None]:
    """Let our style alone count within, whatever the user's matplotlibrc says; theirs is back afterwards.

    `fonttype`: whether SVG holds text as shapes ("path") or as text ("none").
    """
    parameters: Any = matplotlib.rcParams  # which keys its type knows depends on the release
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        parameters.update(STYLE | {"svg.fonttype": fonttype})
        yield


def create_panels(
    height: float, rows: int = 1, columns: int = 1, *, width: float = WIDTH, **options: Any
) -> tuple[Figure, Any]:
    """Return a figure of a size in inches with its axes: one, or an array; options are those of matplotlib."""
    figure = Figure(figsize=(width, height), layout="constrained")
    return figure, figure.subplots(rows, columns, **options)


def envelope(
    t: FloatArray, x: FloatArray, restart: BoolArray | None = None, columns: int = COLUMNS
) -> tuple[FloatArray, FloatArray]:
    """Return a line that looks like x(t) with at most about three points per column.

    Short signals are returned as they are, long ones as the smallest and largest value in each of as many parts.
    NaN breaks the line where it restarts.

    `t, x`: shape (N,); t must not fall; `restart`: true where a sample does not follow its predecessor, shape (N,).
    """
    breaks = np.flatnonzero(restart[1:]) + 1 if restart is not None else np.empty(0, dtype=np.intp)
    at = downsample_indices((x,), 2 * columns) if len(t) > 4 * columns else np.arange(len(t))
    places, first = np.unique(np.searchsorted(at, breaks), return_index=True)
    return np.insert(t[at], places, t[breaks[first]]), np.insert(x[at], places, np.nan)


def visible_spans(t: FloatArray, low: FloatArray, high: FloatArray, most: int = COLUMNS) -> list[tuple[float, float]]:
    """Return the spans low to high; where there are many, those that a picture would show as one are joined.

    `t`: the time axis, shape (N,); `low, high`: rising, shape (M,); `most`: parts of the time axis that can be told
    apart.
    """
    if not len(low):
        return []
    fine = (t[-1] - t[0]) / most if len(low) > 50 else 0.0
    apart = low[1:] - np.maximum.accumulate(high)[:-1] > fine
    first = np.concatenate([[True], apart])
    last = np.concatenate([apart, [True]])
    return list(zip(low[first].tolist(), high[last].tolist(), strict=True))


def robust_range(values: FloatArray, always: FloatArray | None = None, *, room: float = 1.0) -> tuple[float, float]:
    """Return limits of an axis that hold all but the wildest 2 % of the values, and all of `always`.

    `values, always`: any shape; what is not finite is left out; `room`: all values are held where that makes the
    axis at most so many times as long.
    """
    finite = values[np.isfinite(values)]
    kept = list(np.percentile(finite, [1.0, 99.0])) if finite.size else []
    if always is not None:
        kept += list(always[np.isfinite(always)])
    if not kept:
        return 0.0, 1.0
    low, high = float(min(kept)), float(max(kept))
    if finite.size and np.ptp([*finite[[finite.argmin(), finite.argmax()]], low, high]) <= room * (high - low):
        low, high = min(low, float(finite.min())), max(high, float(finite.max()))
    pad = 0.08 * (high - low) or 0.05 * abs(high) or 1.0
    return low - pad, high + pad


def render_svg(figure: Figure, name: str) -> str:
    """Return a figure as an ``<svg>`` element for a page that may hold several.

    Text stays text in the page's own font, colours become the page's (``var(--ink)``, ...), ids begin with
    `name`, and nothing refers to anything outside.
    """
    text = _render_figure(figure, "svg", fonttype="none").decode()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\s(?:xmlns(?::\w+)?|version)="[^"]*"', "", text, count=3)
    text = re.sub(r'(<svg[^>]*?)\s(?:width="[^"]*"\s*)', r"\1 ", text, count=1)
    text = re.sub(r'(<svg[^>]*?)\s(?:height="[^"]*"\s*)', r"\1 ", text, count=1)
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'href="#', f'href="#{name}-', text)
    text = re.sub(r"url\(#", f"url(#{name}-", text)
    text = re.sub(r";? ?font-family: [^;\"]*", "", text)
    text = re.sub(r"font: (?:(bold|\d+) )?([\d.]+px)[^;\"]*", _font, text)
    for word, colour in COLOURS.items():
        text = text.replace(colour, f"var(--{word})")
    return text.replace("<svg", '<svg role="img"', 1)


def _font(match: re.Match[str]) -> str:
    weight = f"; font-weight: {match[1]}" if match[1] else ""
    return f"font-size: {match[2]}{weight}"


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as SVG, PNG or PDF, told by the file's name; nothing half-written stays behind.

    Raises OutputError if the name has another ending, or the file cannot be written.
    """
    kind = Path(path).suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise OutputError(f"{path}: a figure is written as .svg, .png or .pdf, let its name end so")
    atomic_write(path, _render_figure(figure, kind, fonttype="path"))


def _render_figure(figure: Figure, kind: str, *, fonttype: str) -> bytes:
    buffer = io.BytesIO()
    metadata = {"svg": {"Date": None}, "png": {}, "pdf": {"CreationDate": None}}[kind]
    for words in figure.findobj(Text):
        words.set_text(translate(words.get_text()))
    with plot_style(fonttype):
        face = "none" if fonttype == "none" else "white"
        figure.savefig(buffer, format=kind, facecolor=face, dpi=150, metadata=metadata)
    return buffer.getvalue()
