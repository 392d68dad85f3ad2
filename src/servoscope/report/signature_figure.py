"""The picture of a motion signature: u over position and over speed, before a change and after it; imported late."""

from __future__ import annotations

from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from servoscope.diagnosis.motion_signature import MotionSignature
from servoscope.report.format_values import axis_scale
from servoscope.report.plotting import COLOURS, create_panels, plot_style


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
