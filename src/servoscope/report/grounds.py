"""The sections of a report on what a verdict rests on: why, refit beside recursion, what else it could be; as HTML."""

from __future__ import annotations

from collections.abc import Mapping
from html import escape

from servoscope.diagnosis import UNKNOWN, Candidate, Diagnosis, FoundFault, Mimic, Refit
from servoscope.refit import APART, apart
from servoscope.report.sheets import cell, section, table
from servoscope.report.wording import DASH, clock_time, correlation, number, probability, ratios, symbol, with_symbols

__all__ = ["beside", "mimics", "why"]


def why(diagnosis: Diagnosis) -> str:
    """Return the explanation, sentence by sentence; nothing where there is none."""
    if not diagnosis.explanation:
        return ""
    items = "".join(f"<li>{with_symbols(sentence)}</li>" for sentence in diagnosis.explanation)
    return section("Why", "", f'<ul class="why">{items}</ul>')


def beside(diagnosis: Diagnosis, drawing: str) -> str:
    """Return the refit's answer beside the recursion's, with a drawing of both; nothing where there is no refit."""
    refit = diagnosis.refit
    if refit is None:
        return ""
    best, other = diagnosis.candidates[0], refit.recursive[0]
    rows = [
        _row("Answer", _answer(best), _answer(other)),
        *(_size(fault, _same(fault, best, refit)) for fault in best.faults),
    ]
    if best.covariance is not None:
        rows.append(_row("Correlation of the sizes", number(correlation(best.covariance), 2), DASH))
    decimals = 1 if refit.to_s - refit.from_s > 10.0 else 2
    seen = f"{clock_time(refit.from_s, decimals)} to {clock_time(refit.to_s, decimals)}"
    rows += [
        _row("What it looked at", seen, "the last memory of the estimator"),
        _row("Noise, relative to the baseline's", f"× {number(refit.noise, 3)}", DASH),
        _row("Misfit, and what noise leaves at most", f"{number(refit.misfit, 3)}, {number(refit.limit, 3)}", DASH),
    ]
    lead = "The refit weighs every second around the onset on the exact sampled plant; the recursion ran along."
    found = table(("What", "*Refit", "*Recursion", "*Apart"), rows)
    return section("Refit beside recursion", f"{lead} {_agreement(best, other)}", found + drawing)


def mimics(diagnosis: Diagnosis, words: Mapping[str, str]) -> str:
    """Return the causes outside the list of faults that explain the recording; nothing where there is no refit.

    Parameters
    ----------
    diagnosis
        Whose causes they are.
    words
        Name of a fault -> its words, which may say in brackets what it cannot be told from.
    """
    refit, title = diagnosis.refit, "What else it could be"
    if refit is None:
        return ""
    unknown = diagnosis.candidates[0].name == UNKNOWN
    if not refit.mimics:
        what = "explains the change" if unknown else "explains the recording as well"
        tried = "another plant parameter, sensor gain, delay, backlash, dry friction, offset"
        return section(title, f"Of the causes outside the list of faults none {what}. Tried: {tried}.", "")
    lead = "Outside the list of faults, this would explain what no fault does, the likeliest first."
    if not unknown:
        named = escape(diagnosis.candidates[0].name)
        lead = f"Nothing in r, u and y tells {named} from these causes outside the list of faults: look at the machine."
    rows = [
        f'<tr><th scope="row">{escape(mimic.words[:1].upper() + mimic.words[1:])}</th>{cell(_value(mimic))}</tr>'
        for mimic in refit.mimics
    ]
    return section(title, lead, table(("Cause", "*Size"), rows))


def _row(name: str, one: str, other: str, difference: str = "") -> str:
    return f'<tr><th scope="row">{name}</th>{cell(one)}{cell(other)}{cell(difference)}</tr>'


def _answer(candidate: Candidate) -> str:
    return f"{escape(candidate.name.replace('_', ' '))}, {probability(candidate.probability)}"


def _size(fault: FoundFault, other: FoundFault | None) -> str:
    difference = f"{number(apart(fault, other), 2)} σ" if other is not None else ""
    return _row(f"{symbol(fault.parameter)}, 95 % interval", _told(fault), _told(other) if other else DASH, difference)


def _told(fault: FoundFault) -> str:
    ratio, low, high = ratios(fault.ratio, *fault.interval)
    return f"× {ratio} ({low} to {high})"


def _same(fault: FoundFault, best: Candidate, refit: Refit) -> FoundFault | None:
    """Return the recursion's size of a fault; it means the same only where the fault is alone."""
    found = next((c for c in refit.recursive if c.name == best.name), None)
    return found.faults[0] if found is not None and len(best.faults) == 1 else None


def _agreement(best: Candidate, other: Candidate) -> str:
    if best.name == other.name == UNKNOWN:
        return "Both find no fault that explains the change."
    if best.name == other.name:
        agree = apart(best.faults[0], other.faults[0]) <= APART
        return f"Both say {escape(best.name)}, and their sizes {'agree' if agree else 'do not agree'}."
    if len(best.faults) > 1:
        found = "finds none that explains the change" if other.name == UNKNOWN else f"says {escape(other.name)}"
        return f"The recursion compares single faults only, and {found}."
    return f"They do not agree: the refit says {escape(best.name)}, the recursion {escape(other.name)}."


def _value(mimic: Mimic) -> str:
    if mimic.unit == "ratio":
        return f"× {number(mimic.value)}"
    return f"{number(mimic.value, 3)} {escape(mimic.unit)}"
