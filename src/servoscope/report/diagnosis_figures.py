"""The pictures of a diagnosis: signals, statistic, coefficients, iFRF in the complex plane; imported late."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from servoscope.core.arrays import BoolArray, FloatArray
from servoscope.core.messages import translate
from servoscope.detection.trace import Trace
from servoscope.diagnosis.motion_signature import MotionSignature
from servoscope.diagnosis.result import Diagnosis
from servoscope.estimation.frequency_response import CHI2_95_2DOF, FrequencyResponse
from servoscope.isolation.candidate import Candidate, FaultEstimate
from servoscope.report.format_values import axis_scale, text_symbol, time_axis_unit
from servoscope.report.plotting import COLOURS, WIDTH, create_panels, envelope, plot_style, robust_range, visible_spans
from servoscope.signals import Recording

MAX_PATH_POINTS = 1500  # of a path in the complex plane
MAX_AXES_FACTOR = 2.5  # times the range of 98 % of a path: so far the axes give way to the wildest 2 %
PAPER, INK, MUTED, RULE = COLOURS["paper"], COLOURS["ink"], COLOURS["muted"], COLOURS["rule"]
MEASURED, HEALTHY, ALARM = COLOURS["measured"], COLOURS["healthy"], COLOURS["alarm"]
REFERENCE = COLOURS["reference"]


@plot_style()
def plot_signals(
    recording: Recording, diagnosis: Diagnosis | None = None, *, units: tuple[str, str] = ("", "")
) -> Figure:
    """Draw reference and output, their difference, and the input over time; gaps are shaded.

    `recording`: signals of any length; long ones are drawn as their envelope; `units`: of the output (and
    reference) and of the input; empty where unknown.
    """
    figure, axes = create_panels(5.0, 3, 1, sharex=True, height_ratios=[3, 2, 3])
    unit, factor = time_axis_unit(recording.duration_s)
    t = recording.t / factor
    both = ((recording.y, MEASURED, "output y"), (recording.r, REFERENCE, "reference r"))
    rows = (
        ("r, y", units[0], both),
        ("r − y", units[0], ((recording.r - recording.y, INK, ""),)),
        ("u", units[1], ((recording.u, MEASURED, ""),)),
    )
    for ax, (label, of, lines) in zip(axes, rows, strict=True):
        prefix, scale = axis_scale([x for x, _, _ in lines], of)
        for x, colour, _ in lines:
            # a thin light reference on a wide dark output: where one hides the other, both still show
            width = 2.0 if x is recording.y else 0.9
            ax.plot(*envelope(t, x * scale, recording.restart), color=colour, linewidth=width)
        ax.set_ylabel(f"{label} [{prefix}]" if prefix else label)
        _gaps(ax, t, recording.restart, 1.5 / recording.sample_rate / factor)
        _marks(ax, diagnosis, factor)
    two = [
        Line2D([], [], color=colour, linewidth=width, label=words)
        for (_, colour, words), width in zip(both, (2.0, 1.2), strict=True)
    ]
    _legend_above(figure, diagnosis, two)
    axes[0].margins(x=0.0)
    axes[-1].set_xlabel(f"time [{unit}]")
    return figure


@plot_style()
def plot_statistic(trace: Trace, diagnosis: Diagnosis | None = None) -> Figure:
    """Draw both tests over time on a logarithmic axis, with their common limit, the onset and the detection.

    The sequential test is scaled to the threshold of T^2, so that one line is the limit of both.
    """
    figure, ax = create_panels(2.7)
    usable = trace.ready & np.isfinite(trace.statistic) & (trace.statistic > 0.0)
    unit, factor = time_axis_unit(float(np.ptp(trace.t)) if len(trace.t) else 0.0)
    ax.set(xlabel=f"time [{unit}]", ylabel="statistic T²")
    if not usable.any():
        _empty(ax, "no evaluation: the estimator never had enough data")
        return figure
    limit = float(np.max(trace.threshold))
    t = trace.t / factor
    value = np.where(usable, trace.statistic, np.nan)
    lowest = min(float(np.nanpercentile(value, 1.0)), limit) / 2.0
    ax.plot(*envelope(t, value), color=MEASURED, marker="o" if usable.sum() < 20 else "", markersize=3)
    ax.axhline(limit, color=ALARM, linewidth=1.0, linestyle=(0, (5, 2.5)))
    level = np.where(usable & (trace.level > 0.0), np.maximum(limit * trace.level, lowest), np.nan)
    sequential = bool(np.isfinite(level).any())
    if sequential:
        ax.plot(*envelope(t, level), color=HEALTHY, linewidth=1.0)
    highest = np.fmax(value, level)
    over = np.where(usable, np.maximum(highest, limit), np.nan)
    ax.fill_between(*envelope(t, over), limit, color=ALARM, alpha=0.16, linewidth=0)
    ax.set(yscale="log", ylim=(lowest, 3.0 * max(float(np.nanmax(highest)), limit)))
    ax.yaxis.set_major_formatter("{x:g}")
    ax.margins(x=0.0)
    if usable.sum() == 1:
        ax.set_xlim(t[usable][0] - 1.0, t[usable][0] + 1.0)
    _marks(ax, diagnosis, factor)
    lines = [
        Line2D([], [], color=MEASURED, label="statistic T²"),
        Line2D([], [], color=ALARM, linestyle=(0, (5, 2.5)), label=f"{translate('threshold')} {limit:.3g}"),
    ]
    if sequential:
        lines.insert(1, Line2D([], [], color=HEALTHY, linewidth=1.0, label="sequential test, to the same limit"))
    _legend_above(figure, diagnosis, lines)
    return figure


@plot_style()
def plot_coefficients(
    trace: Trace, diagnosis: Diagnosis | None = None, *, units: Sequence[str] = (), only: int | None = None
) -> Figure:
    """Draw each coefficient's deviation from its healthy expectation over time, with bands of two sigma.

    In percent of the expectation, or in units of the coefficient where the expectation is no larger than the
    estimate's standard deviation.

    `units`: of the n coefficients; empty where unknown. `only`: the number of one that is drawn alone.
    """
    shown = range(len(trace.names)) if only is None else (only,)
    n = len(shown)
    columns = 1 if n == 1 else 2
    rows = -(-n // columns)
    figure, axes = create_panels(0.7 + 1.65 * rows, rows, columns, sharex=True, squeeze=False)
    unit, factor = time_axis_unit(float(np.ptp(trace.t)) if len(trace.t) else 0.0)
    for i, ax in enumerate(axes.flat):
        if i < n:
            _coefficient(ax, trace, shown[i], factor, units[shown[i]] if shown[i] < len(units) else "")
            _marks(ax, diagnosis, factor)
            ax.xaxis.set_tick_params(labelbottom=i + columns >= n)
            if i + columns >= n:
                ax.set_xlabel(f"time [{unit}]")
        else:
            ax.set_axis_off()
    lines: list[Line2D | Patch] = [
        Line2D([], [], color=MEASURED, label="estimate"),
        Patch(facecolor=MEASURED, alpha=0.2, label="± 2 standard deviations"),
        Line2D([], [], color=HEALTHY, linestyle=(0, (4, 2)), label="healthy expectation"),
    ]
    _legend_above(figure, diagnosis, lines)
    return figure


def _coefficient(ax: Axes, trace: Trace, i: int, factor: float, unit: str) -> None:
    healthy = trace.expected[:, i]
    std = np.sqrt(np.maximum(trace.covariance[:, i, i], 0.0))
    deviation = trace.theta[:, i] - healthy
    usable = trace.ready & np.isfinite(deviation)
    ax.set_title(text_symbol(trace.names[i]), loc="left", fontweight="bold")
    ax.axhline(0.0, color=HEALTHY, linewidth=1.1, linestyle=(0, (4, 2)), zorder=3)
    ax.margins(x=0.0)
    if not usable.any():
        _empty(ax, "no estimate")
        return
    size = np.abs(healthy)
    if np.nanmedian(size[usable]) > np.nanmedian(np.nan_to_num(std[usable])):
        size = np.where(size > 0.0, size, np.nan)
        deviation, std = 100.0 * deviation / size, 100.0 * std / size
        ax.set_ylabel("deviation [%]")
    else:
        ax.set_ylabel(f"deviation [{unit}]" if unit else "deviation")
    middle = np.where(usable, deviation, np.nan)
    band = 2.0 * np.nan_to_num(std)
    t = trace.t / factor
    x, low = envelope(t, middle - band)
    _, high = envelope(t, middle + band)
    ax.fill_between(x, low, high, color=MEASURED, alpha=0.2, linewidth=0)
    ax.plot(*envelope(t, middle), color=MEASURED, marker="o" if usable.sum() < 20 else "", markersize=3)
    ax.set_ylim(robust_range(np.concatenate([(middle - band)[usable], (middle + band)[usable], [0.0]])))


@plot_style()
def plot_ifrf(trace: Trace, diagnosis: Diagnosis | None = None) -> Figure:
    """Draw the iFRF in the complex plane, one panel per frequency: path over time, last estimate, healthy.

    Ellipses hold 95 %. The axes of a panel are scaled each on its own: as a rule the iFRF moves far less
    one way than the other.
    """
    F = len(trace.ifrf.frequencies)
    columns = max(1, min(F, 4 if F in (4, 7, 8) else 3))
    rows = max(1, -(-F // columns))
    height = 8.0 / columns if columns > 1 else 4.0
    figure, axes = create_panels(0.5 + height * rows, rows, columns, squeeze=False)
    usable = trace.ready & np.isfinite(trace.theta).all(axis=1)
    onset = diagnosis.onset_s[1] if diagnosis is not None and diagnosis.onset_s is not None else np.inf
    faulty = bool(np.isfinite(onset))
    for i, ax in enumerate(axes.flat):
        if i < F:
            ax.set_title(f"{trace.ifrf.frequencies[i]:g} Hz", loc="left", fontweight="bold")
            _plane(ax, trace, i, usable, onset)
            ax.set_xlabel("real part")
            if i % columns == 0:
                ax.set_ylabel("imaginary part")
        else:
            ax.set_axis_off()
    handles = [
        _marker("D", PAPER, INK, "healthy expectation"),
        _marker("o", ALARM if faulty else MEASURED, PAPER, "last estimate; ellipses hold 95 %"),
        Line2D([], [], color=MEASURED, alpha=0.5, label="path before onset" if faulty else "path"),
    ]
    if faulty:
        handles.append(Line2D([], [], color=ALARM, alpha=0.5, label="path after onset"))
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles))
    return figure


def _plane(ax: Axes, trace: Trace, i: int, usable: BoolArray, onset: float) -> None:
    rows = np.flatnonzero(usable)
    if not len(rows):
        _empty(ax, "no estimate")
        return
    last = int(rows[-1])
    path = trace.ifrf.H[:, i]
    thin = rows[:: max(1, len(rows) // MAX_PATH_POINTS)]
    for part, colour in ((thin[trace.t[thin] <= onset], MEASURED), (thin[trace.t[thin] > onset], ALARM)):
        ax.plot(path[part].real, path[part].imag, color=colour, linewidth=0.7, alpha=0.45)
    shown = [np.stack([path[rows].real, path[rows].imag], axis=-1)]
    faulty = np.isfinite(onset)
    for response, colour, alpha, marker in (
        (trace.ifrf_expected, HEALTHY, 0.28, "D"),
        (trace.ifrf, ALARM if faulty else MEASURED, 0.24, "o"),
    ):
        H, covariance = response.H[last, i], response.covariance[last, i]
        if not np.isfinite(H):
            continue
        if np.isfinite(covariance).all():
            frequency_response = FrequencyResponse(response.frequencies[i : i + 1], H[None], covariance[None])
            outline = frequency_response.ellipse(96)[0]
            ax.fill(*outline.T, facecolor=colour, alpha=alpha, linewidth=0)
            ax.plot(*outline.T, color=colour, linewidth=1.1)
            shown.append(outline)
        face, edge = (PAPER, INK) if marker == "D" else (colour, PAPER)
        ax.plot(H.real, H.imag, marker, markersize=5.5, mfc=face, mec=edge, zorder=4)
        shown.append(np.array([[H.real, H.imag]]))
    certain = np.vstack(shown[1:]) if len(shown) > 1 else shown[0]
    x, y = (robust_range(shown[0][:, i], certain[:, i], room=MAX_AXES_FACTOR) for i in (0, 1))
    ax.set(xlim=x, ylim=y)
    ax.locator_params(nbins=4)
    ax.grid(visible=True, color=RULE, linewidth=0.6)


def _marker(shape: str, face: str, edge: str, label: str) -> Line2D:
    return Line2D([], [], marker=shape, linestyle="", markerfacecolor=face, markeredgecolor=edge, label=label)


def _gaps(ax: Axes, t: FloatArray, restart: BoolArray, longest: float) -> None:
    step = np.diff(t)
    after = np.flatnonzero(restart[1:] & (step > longest))
    for low, high in visible_spans(t, t[after], t[after + 1]):
        ax.axvspan(low, high, facecolor=HEALTHY, edgecolor=HEALTHY, linewidth=0.6, alpha=0.3, zorder=0)
    joints = t[1:][restart[1:] & (step <= longest)]
    for joint, _ in visible_spans(t, joints, joints):
        ax.axvline(joint, color=MUTED, linewidth=0.6, linestyle=(0, (1, 3)), zorder=1)


def _marks(ax: Axes, diagnosis: Diagnosis | None, factor: float) -> None:
    if diagnosis is None:
        return
    for interval in diagnosis.intervals:
        for change in (interval.onset_s, interval.end_interval_s):
            if change is not None:
                low, likely, high = (value / factor for value in change)
                ax.axvspan(low, high, facecolor=ALARM, edgecolor=ALARM, linewidth=0.5, alpha=0.22, zorder=0)
                ax.axvline(likely, color=ALARM, linewidth=1.0, alpha=0.8, zorder=1)
        if interval.onset_s is not None and (len(diagnosis.intervals) > 1 or interval.end_interval_s is not None):
            # how long each lasted: a band along the top
            end = ax.get_xlim()[1] if interval.end_s is None else interval.end_s / factor
            ax.axvspan(
                interval.onset_s[1] / factor, end, ymin=0.96, facecolor=ALARM, linewidth=0.0, alpha=0.8, zorder=3
            )
    if diagnosis.detected_at_s is not None:
        ax.axvline(diagnosis.detected_at_s / factor, color=INK, linewidth=0.9, linestyle=(0, (2, 2)), zorder=2)


def _legend_above(figure: Figure, diagnosis: Diagnosis | None, lines: Sequence[Line2D | Patch]) -> None:
    handles = list(lines)
    if diagnosis is not None and diagnosis.onset_s is not None:
        handles.append(Patch(facecolor=ALARM, edgecolor=ALARM, alpha=0.4, label="onset, 95 % interval"))
    if diagnosis is not None and diagnosis.detected_at_s is not None:
        handles.append(Line2D([], [], color=INK, linestyle=(0, (2, 2)), label="detected"))
    figure.legend(handles=handles, loc="outside upper left", ncols=len(handles))


def _empty(ax: Axes, words: str) -> None:
    ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", va="center", color=MUTED)
    ax.tick_params(axis="x", bottom=False, labelbottom=False)  # of this panel alone: ticks are shared
    ax.set_yticks([])


def plot_fault_sizes(diagnosis: Diagnosis) -> Figure | None:
    """Draw the sizes of the first candidate by refit and recursion, and the joint region of a pair.

    None where there is no refit, or no fault that explains the change.
    """
    if diagnosis.refit is None or not diagnosis.candidates[0].faults:
        return None
    best = diagnosis.candidates[0]
    if best.covariance is not None:
        return _pair(best)
    other = next((c for c in diagnosis.refit.recursive if c.name == best.name), None)
    return _single(best.faults[0], other.faults[0] if other is not None else None)


@plot_style()
def _single(estimate: FaultEstimate, other: FaultEstimate | None) -> Figure:
    figure, ax = create_panels(1.25 if other is not None else 1.0)
    shown = [("refit", estimate, MEASURED), *([("recursion", other, HEALTHY)] if other is not None else [])]
    for i, (_, fault, colour) in enumerate(shown):
        _interval(ax, fault, -i, colour)
    ax.set_yticks([-i for i in range(len(shown))], [name for name, _, _ in shown])
    _size_axis(ax, estimate, 0.6 - len(shown), 0.6)
    return figure


@plot_style()
def _pair(best: Candidate) -> Figure:
    figure = Figure(figsize=(WIDTH, 2.6), layout="constrained")
    axes = figure.subplot_mosaic([["a", "both"], ["b", "both"]], width_ratios=[3, 2])
    for key, fault in zip("ab", best.faults, strict=True):
        ax = axes[key]
        _interval(ax, fault, 0.0, MEASURED)
        ax.set_yticks([0.0], ["refit"])
        _size_axis(ax, fault, -1.0, 1.0)
    _joint(axes["both"], best)
    return figure


def _size_axis(ax: Axes, fault: FaultEstimate, low: float, high: float) -> None:
    ax.set(ylim=(low, high), xlabel=f"{text_symbol(fault.parameter)}, {translate('relative to healthy')}")
    ax.grid(visible=True, axis="x", color=RULE, linewidth=0.6)


def _interval(ax: Axes, fault: FaultEstimate, at: float, colour: str) -> None:
    low, high = fault.interval
    ax.plot([low, high], [at, at], color=colour, linewidth=3.0, alpha=0.45, solid_capstyle="butt")
    ax.plot([low, low, np.nan, high, high], [at - 0.18, at + 0.18, np.nan, at - 0.18, at + 0.18], color=colour)
    ax.plot(fault.ratio, at, "o", markersize=5.5, color=colour)
    ax.locator_params(axis="x", nbins=7)


def _joint(ax: Axes, best: Candidate) -> None:
    """Draw where both sizes are with 95 % probability."""
    estimate, other = best.faults
    angle = np.linspace(0.0, 2.0 * np.pi, 97)
    values, vectors = np.linalg.eigh(np.array(best.covariance))
    root = vectors * np.sqrt(np.maximum(values, 0.0) * CHI2_95_2DOF)
    x, y = np.exp(np.log([[estimate.ratio], [other.ratio]]) + root @ np.array([np.cos(angle), np.sin(angle)]))
    ax.fill(x, y, facecolor=MEASURED, alpha=0.24, linewidth=0)
    ax.plot(x, y, color=MEASURED, linewidth=1.1)
    ax.plot(estimate.ratio, other.ratio, "o", markersize=5.5, color=MEASURED)
    ax.set(xlabel=text_symbol(estimate.parameter), ylabel=text_symbol(other.parameter))
    ax.set_title("both at once, 95 %", loc="left", fontweight="bold")
    ax.locator_params(nbins=4)
    ax.grid(visible=True, color=RULE, linewidth=0.6)


@plot_style()
def plot_signature(
    before: MotionSignature | None, after: MotionSignature, *, units: tuple[str, str] = ("", "")
) -> Figure:
    """Draw mean u over position, forward and backward, and over speed; `units`: of the output and of the input."""
    figure, (of_position, of_speed) = create_panels(3.2, 1, 2, sharey=True)
    shown = [(before, COLOURS["healthy"], "before"), (after, COLOURS["measured"], "after" if before else "measured")]
    kept = [(signature, colour, words) for signature, colour, words in shown if signature is not None]
    y_unit, y_scale = axis_scale([signature.position for signature, *_ in kept], units[0])
    v_unit, v_scale = axis_scale([signature.speed for signature, *_ in kept], f"{units[0]}/s" if units[0] else "")
    u_unit, u_scale = axis_scale([signature.by_speed for signature, *_ in kept], units[1])
    for signature, colour, _ in kept:
        of_position.plot(y_scale * signature.position, u_scale * signature.forward, color=colour)
        of_position.plot(y_scale * signature.position, u_scale * signature.backward, color=colour, linestyle="--")
        of_speed.plot(v_scale * signature.speed, u_scale * signature.by_speed, color=colour, marker="o", markersize=2.5)
    of_position.set_xlabel(f"output y [{y_unit}]" if y_unit else "output y")
    of_position.set_ylabel(f"mean u [{u_unit}]" if u_unit else "mean u")
    of_speed.set_xlabel(f"speed of y [{v_unit}]" if v_unit else "speed of y")
    for ax in (of_position, of_speed):
        ax.axhline(0.0, color=COLOURS["rule"], linewidth=0.7, zorder=0)
    of_speed.axvline(0.0, color=COLOURS["rule"], linewidth=0.7, zorder=0)
    lines = [Line2D([], [], color=colour, label=words) for _, colour, words in kept]
    lines.append(Line2D([], [], color=COLOURS["muted"], label="forward"))
    lines.append(Line2D([], [], color=COLOURS["muted"], linestyle="--", label="backward"))
    figure.legend(handles=lines, loc="outside upper left", ncols=len(lines))
    return figure
