"""A study before deployment as one self-contained HTML page: what can be seen and told apart, in words and pictures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from servoscope.design import Study
from servoscope.output import atomic_write
from servoscope.report.document import framed
from servoscope.report.sheets import section, table
from servoscope.report.wording import DASH, change, clock_time, number, symbol

__all__ = ["page", "write"]


def write(path: str | Path, study: Study) -> None:
    """Write the page on a study; nothing half-written stays behind.

    Raises
    ------
    OutputError
        If the file cannot be written.
    """
    atomic_write(path, page(study).encode("utf-8", errors="replace"))


def page(study: Study) -> str:
    """Return the page that `write` writes; it needs nothing from outside, no script and no network."""
    sections = (
        _header(study),
        _faults(study),
        *_pictures(study),
        _cosines(study),
        _mimics(study),
        _frequencies(study),
        _dither(study),
    )
    return framed(f"Before deployment: {study.loop}", "healthy", sections)


def _header(study: Study) -> str:
    name = f"<strong>{escape(study.loop)}</strong> before deployment"
    facts = (
        f"reference {escape(study.reference)}, {clock_time(study.after_s, 0)} after the onset",
        f"noise of u {number(study.noise_u_std, 3)}, of y {number(study.noise_y_std, 3)}",
        f"{study.false_alarms_per_year:g} false alarms per year",
    )
    return f"<header><span>{name}</span><span>{', '.join(facts)}</span></header>"


def _faults(study: Study) -> str:
    rows = []
    for fault in study.faults.values():
        for direction, side in (("up", fault.up), ("down", fault.down)):
            again = ", ".join(
                f"{change(low)} to {change(high) if high else 'the end'}" for low, high in side.unclear[1:]
            )
            cells = (
                change(side.detectable),
                change(side.first_isolable),
                change(side.bound),
                escape(side.nearest),
                again or DASH,
            )
            rows.append(_row(f"{escape(fault.name)} {direction} <small>{symbol(fault.parameter)}</small>", cells))
    head = ("Change", "*Detected from", "*Named from", "*Linear bound", "*Else taken for", "*Unclear again")
    why = (
        "Detected: announced in time with 90 % probability. Named: called by its own name with 99.5 % probability by"
        " the refit of the seconds since the onset. Unclear again: larger sizes at which it looks like another fault"
        " once more."
    )
    return section("Which faults, from which size on", why, table(head, rows))


def _pictures(study: Study) -> Iterator[str]:
    from servoscope.report import canvas, study_figures  # late: matplotlib takes half a second to import

    drawn = (
        ("Radii", "Grey: sizes at which a fault is not named rightly.", study_figures.radii(study)),
        ("Time to detection", "Half of all changes of a size are announced by then.", study_figures.delays(study)),
        (
            "How sure a size becomes",
            "Cramér-Rao bound with the healthy parameters as well known as they are; dotted: all parameters may have"
            " changed.",
            study_figures.sizes(study),
        ),
    )
    for i, (name, why, figure) in enumerate(drawn):
        yield section(name, why, f'<figure aria-label="{name}">{canvas.svg(figure, f"f{i}")}</figure>')


def _cosines(study: Study) -> str:
    names = list(study.faults)
    if len(names) < 2:
        return ""
    rows = [_row(escape(one), [number(study.cosines[one][other], 3) for other in names]) for one in names]
    why = (
        "Cosine between what small changes do to the innovations: 1 or −1 cannot be told apart, 0 is as different as"
        " can be."
    )
    return section("How alike they look", why, table(("Change", *(f"*{escape(name)}" for name in names)), rows))


def _mimics(study: Study) -> str:
    rows = []
    for each in study.mimics:
        told = _amount(each.told_apart, each.unit) if each.told_apart is not None else "never"
        cosine = number(each.cosines[each.imitates], 3)
        cells = (escape(each.imitates), cosine, _amount(each.amount, each.unit), change(each.looks_like), told)
        rows.append(_row(f"{escape(each.words)} <small>{escape(each.name)}</small>", cells))
    head = ("Change", "*Is most like", "*Cosine", "*So much", "*Looks like", "*Told apart from")
    why = (
        "Changes that are no fault of the list, the fault that each looks like, and from where on they are told apart."
    )
    return section("What else it could be", why, table(head, rows))


def _frequencies(study: Study) -> str:
    names = list(study.faults)
    rows = []
    for what, several in (("monitored", study.frequencies.own), ("best", study.frequencies.best)):
        for each in several:
            shown = [each.apart[name] for name in names]
            cells = [f"{100.0 * x:.3g} %" if x is not None and x < 10.0 else DASH for x in shown]
            rows.append(_row(f"{each.frequency_hz:g} Hz <small>{what}</small>", cells))
    why = (
        "Standard deviation of each size as the iFRF of one frequency shows it, as far as no other fault could explain"
        f" it. With the best frequencies the faults are {number(study.frequencies.gain, 3)} times as far apart, on"
        " average."
    )
    return section("Frequencies to monitor", why, table(("Frequency", *(f"*{escape(n)}" for n in names)), rows))


def _dither(study: Study) -> str:
    names = list(study.faults)
    rows = []
    for each in study.dither:
        name = f"{100.0 * each.share:g} % at {each.frequency_hz:g} Hz" if each.share else "none"
        rows.append(_row(name, [number(each.extra_u_rms, 3), *(change(each.radius[n]) for n in names)]))
    why = (
        "Sizes from which on each fault is named, of linear sensitivities; amplitude as a share of the reference's rms."
    )
    head = ("Sine on the reference", "*Adds to u (rms)", *(f"*{escape(n)} from" for n in names))
    return section("What a dither would buy", why, table(head, rows))


def _row(name: str, cells: Sequence[str]) -> str:
    numbers = "".join(f'<td class="n">{cell}</td>' for cell in cells)
    return f'<tr><th scope="row">{name}</th>{numbers}</tr>'


def _amount(value: float, unit: str) -> str:
    return f"{100.0 * value:.3g} %" if unit == "relative" else f"{value:.2g} samples"
