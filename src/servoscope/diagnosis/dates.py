"""The headline of a timeline with dates in the place of seconds."""

from __future__ import annotations

from servoscope.core.messages import Message, message

TIMELINES = "diagnosis.timeline", "diagnosis.repaired"  # headlines that say from when to when
DATED = {  # parts of the headline of a timeline: in seconds, and as dates
    "diagnosis.healed": "diagnosis.healed_date",
    "diagnosis.stretch_when": "diagnosis.stretch_when_date",
    "diagnosis.stretch_since": "diagnosis.stretch_since_date",
    "diagnosis.stretch_until": "diagnosis.stretch_until_date",
    "diagnosis.stretch_start": "diagnosis.stretch_start_date",
}


def date_timeline(headline: Message, began: float) -> Message:
    """Return the headline of a timeline with dates instead of seconds since `began` [UTC s]."""

    def dated(given: Message) -> Message:
        times = {name: began + given.values[name] for name in ("t", "from_s", "to_s") if given.values.get(name)}
        return message(DATED[given.key], began=began, **times)

    stretches = tuple(
        stretch.model_copy(update={"values": {**stretch.values, "when": dated(stretch.values["when"])}})
        for stretch in headline.values["stretches"]
    )
    now = headline.values["now"]
    values = {**headline.values, "stretches": stretches, "now": None if now is None else dated(now)}
    return headline.model_copy(update={"values": values})
