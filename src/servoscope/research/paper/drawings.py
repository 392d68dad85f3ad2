"""Figs. 1 and 3 as drawings: the actuator, and the diagnostic around its loop."""

from __future__ import annotations

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyBboxPatch, Polygon, Rectangle

from servoscope.report.plotting import COLOURS, plot_style

INK, MUTED, RULE = COLOURS["ink"], COLOURS["muted"], COLOURS["rule"]
OIL, ALARM = "#cfdcec", COLOURS["alarm"]


def _canvas(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(9.0, 9.0 * height / width), layout="constrained")
    ax = figure.subplots()
    ax.set(xlim=(0.0, width), ylim=(0.0, height), aspect="equal")
    ax.set_axis_off()
    return figure, ax


def _arrow(ax: Axes, *points: tuple[float, float], colour: str = INK, head: bool = True) -> None:
    x, y = zip(*points, strict=True)
    if head:
        ax.plot(x[:-1], y[:-1], color=colour, linewidth=1.0, solid_capstyle="butt")
        ax.annotate("", points[-1], points[-2], arrowprops={"arrowstyle": "-|>", "color": colour, "linewidth": 1.0})
    else:
        ax.plot(x, y, color=colour, linewidth=1.0)


def _spring(ax: Axes, x: float, y: float, length: float) -> None:
    steps = [0.0, 0.15, *(0.15 + 0.7 * i / 8 for i in range(1, 8)), 0.85, 1.0]
    sides = [0.0, 0.0, *(0.13 if i % 2 else -0.13 for i in range(1, 8)), 0.0, 0.0]
    ax.plot([x + length * s for s in steps], [y + s for s in sides], color=INK, linewidth=1.0)


@plot_style()
def figure_1() -> Figure:
    """Draw the valve-controlled cylinder of eq. (1): supply, valve, oil volumes, piston, mass, spring, friction."""
    figure, ax = _canvas(12.0, 5.6)
    ax.add_patch(Rectangle((2.6, 0.9), 4.6, 1.5, facecolor=OIL, edgecolor=INK))
    ax.add_patch(Rectangle((4.7, 0.9), 0.35, 1.5, facecolor=COLOURS["healthy"], edgecolor=INK))
    ax.add_patch(Rectangle((5.05, 1.55), 2.95, 0.2, facecolor=COLOURS["healthy"], edgecolor=INK))
    ax.add_patch(Rectangle((8.0, 1.05), 1.2, 1.2, facecolor=COLOURS["reference"], edgecolor=INK))
    ax.text(8.6, 1.65, "$m_p$", ha="center", va="center")
    _spring(ax, 9.2, 1.95, 1.6)
    ax.text(10.0, 2.2, "$k_p$", ha="center")
    ax.plot([9.2, 9.85], [1.35, 1.35], color=INK, linewidth=1.0)
    ax.plot([9.8, 9.8], [1.22, 1.48], color=INK, linewidth=1.0)
    ax.plot([10.1, 9.65, 9.65, 10.1], [1.55, 1.55, 1.15, 1.15], color=INK, linewidth=1.0)
    ax.plot([10.1, 10.1], [1.15, 1.55], color=INK, linewidth=1.0)
    ax.plot([10.1, 10.8], [1.35, 1.35], color=INK, linewidth=1.0)
    ax.text(10.0, 0.75, "$b_p$  friction", ha="center", color=ALARM)
    ax.plot([10.8, 10.8], [0.9, 2.5], color=INK, linewidth=2.0)
    _arrow(ax, (8.6, 2.55), (9.6, 2.55), colour=COLOURS["measured"])
    ax.text(9.1, 2.68, "y, displacement", ha="center", color=COLOURS["measured"])
    ax.text(3.65, 1.9, "$V_o$, β", ha="center", va="center")
    ax.text(3.65, 1.3, "contamination", ha="center", va="center", color=ALARM)
    ax.text(6.2, 2.1, "$A_p$", ha="center", va="center")
    _arrow(ax, (4.35, 0.7), (5.4, 0.7), colour=ALARM)
    ax.text(4.9, 0.35, "$C_{ie}$  leakage", ha="center", color=ALARM)
    for i in range(3):
        ax.add_patch(Rectangle((3.4 + i, 3.6), 1.0, 0.9, facecolor="none", edgecolor=INK))
    _arrow(ax, (3.65, 3.7), (3.65, 4.4))
    _arrow(ax, (4.15, 4.4), (4.15, 3.7))
    _arrow(ax, (5.55, 3.7), (6.25, 4.4))
    _arrow(ax, (6.25, 3.7), (5.55, 4.4))
    ax.text(4.9, 4.62, "directional valve: $C_d$, W, ρ", ha="center")
    _arrow(ax, (3.0, 2.4), (3.0, 3.1), (4.6, 3.1), (4.6, 3.6), head=False)
    _arrow(ax, (6.8, 2.4), (6.8, 3.1), (5.2, 3.1), (5.2, 3.6), head=False)
    ax.add_patch(Rectangle((1.7, 3.75), 1.7, 0.6, facecolor=COLOURS["reference"], edgecolor=INK))
    ax.text(2.55, 4.05, "voice coil $K_m$", ha="center", va="center", fontsize=7.5)
    _arrow(ax, (0.7, 4.05), (1.7, 4.05), colour=COLOURS["measured"])
    ax.text(0.35, 4.22, "u, current", color=COLOURS["measured"])
    ax.add_patch(Circle((8.2, 4.05), 0.4, facecolor="none", edgecolor=INK))
    ax.add_patch(Polygon([(7.95, 3.95), (7.95, 4.15), (7.8, 4.05)], facecolor=INK))
    _arrow(ax, (7.8, 4.05), (6.4, 4.05), head=False)
    ax.text(8.2, 3.35, "$p_s$  pump", ha="center", color=ALARM)
    return figure


def _box(ax: Axes, x: float, y: float, width: float, text: str, colour: str = INK, height: float = 0.9) -> None:
    ax.add_patch(FancyBboxPatch((x, y), width, height, "round,pad=0.02", facecolor="none", edgecolor=colour))
    ax.text(x + width / 2.0, y + height / 2.0, text, ha="center", va="center", fontsize=8.0, color=INK)


@plot_style()
def figure_3() -> Figure:
    """Draw the closed loop (I) and the diagnostic (II) with its four components and stage 1."""
    figure, ax = _canvas(13.0, 6.6)
    for y, height, words in ((3.9, 2.5, "I  closed loop"), (0.1, 3.5, "II  diagnostic")):
        ax.add_patch(Rectangle((0.1, y), 12.8, height, facecolor="none", edgecolor=RULE))
        ax.text(0.25, y + height - 0.3, words, color=MUTED)
    ax.add_patch(Circle((1.9, 5.2), 0.18, facecolor="none", edgecolor=INK))
    _arrow(ax, (0.5, 5.2), (1.72, 5.2))
    ax.text(0.55, 5.32, "r(k)")
    _arrow(ax, (2.08, 5.2), (2.9, 5.2))
    ax.text(2.3, 5.32, "e(k)")
    _box(ax, 2.9, 4.75, 1.6, "PI controller")
    _arrow(ax, (4.5, 5.2), (5.9, 5.2))
    ax.text(4.75, 5.32, "u(k)")
    ax.add_patch(Circle((6.08, 5.2), 0.18, facecolor="none", edgecolor=INK))
    _arrow(ax, (6.08, 6.0), (6.08, 5.38))
    ax.text(6.2, 5.85, "$n_u$")
    _arrow(ax, (6.26, 5.2), (7.1, 5.2))
    _box(ax, 7.1, 4.75, 2.0, "EHA\n$G(s, κ)$")
    _arrow(ax, (9.1, 5.2), (10.0, 5.2))
    ax.add_patch(Circle((10.18, 5.2), 0.18, facecolor="none", edgecolor=INK))
    _arrow(ax, (10.18, 6.0), (10.18, 5.38))
    ax.text(10.3, 5.85, "$n_y$")
    _arrow(ax, (10.36, 5.2), (12.4, 5.2))
    ax.text(11.7, 5.32, "y(k)")
    _arrow(ax, (11.2, 5.2), (11.2, 4.2), (1.9, 4.2), (1.9, 5.02))
    ax.text(2.0, 4.75, "−")
    _arrow(ax, (0.9, 5.2), (0.9, 2.6), (1.3, 2.6))
    _arrow(ax, (5.0, 5.2), (5.0, 3.35), (2.3, 3.35), (2.3, 3.05))
    _arrow(ax, (11.2, 4.2), (11.2, 3.3), (5.4, 3.3), (5.4, 3.05))
    _box(ax, 1.3, 2.15, 2.0, "stage 1: r → u\nFIR or Laguerre")
    _arrow(ax, (3.3, 2.6), (4.3, 2.6))
    ax.text(3.5, 2.72, "$u_a$(k)")
    _box(ax, 4.3, 2.15, 2.2, "1  inverse model\nAKF, eqs. (4)–(11)")
    _arrow(ax, (6.5, 2.6), (7.4, 2.6))
    ax.text(6.75, 2.72, r"$\hatθ$(k)")
    _box(ax, 7.4, 2.15, 2.2, "2  residual generator\niFRF, eqs. (13), (14)")
    _arrow(ax, (8.5, 2.15), (8.5, 1.3))
    ax.text(8.6, 1.65, "Γ(k)")
    _box(ax, 7.4, 0.4, 2.2, "3  residual evaluator\nthresholds, signatures")
    _arrow(ax, (7.4, 0.85), (6.5, 0.85))
    _box(ax, 4.3, 0.4, 2.2, "4  fault alarm\nfault manager", ALARM)
    _arrow(ax, (4.3, 0.85), (0.5, 0.85), (0.5, 4.45), (3.7, 4.45), (3.7, 4.75), colour=ALARM)
    ax.text(1.0, 0.97, "reconfigured gains", color=ALARM)
    return figure
