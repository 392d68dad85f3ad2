"""The headline of a diagnosis with dates in the place of seconds since its recording began."""

from __future__ import annotations

from servoscope.core.messages import Message, message

DATED = {  # parts of the headline of a timeline: in seconds, and as dates
    "diagnosis.healed": "diagnosis.healed_date",
    "diagnosis.stretch_when": "diagnosis.stretch_when_date",
    "diagnosis.stretch_since": "diagnosis.stretch_since_date",
    "diagnosis.stretch_until": "diagnosis.stretch_until_date",
    "diagnosis.stretch_start": "diagnosis.stretch_start_date",
}


def date_headline(
    headline: Message, began: float, at_s: float | None, onset: float | None, *, from_start: bool
) -> Message:
    """Return a headline with dates; `began`, `onset`: of recording and change [UTC s]; `at_s`: onset since `began`.

    `from_start`: whether the change may be older than the recording.
    """
    if headline.key == "diagnosis.timeline":
        return _dated_timeline(headline, began)
    since = headline.values.get("since")
    if at_s is None or not isinstance(since, Message):
        return headline
    if from_start and onset is None:
        since = message("diagnosis.since_start_date", t=began)
    else:
        since = message(
            "diagnosis.since_date", t=began + at_s if onset is None else onset, growth=since.values.get("growth")
        )
    return headline.model_copy(update={"values": {**headline.values, "since": since}})


def _dated_timeline(headline: Message, began: float) -> Message:
    """Return the headline of a timeline with dates instead of seconds since `began` [UTC s]."""

    def dated(given: Message) -> Message:
        times = {name: began + given.values[name] for name in ("t", "from_s", "to_s") if given.values.get(name)}
        return message(DATED[given.key], began=began, **times)

    stretches = tuple(
        one.model_copy(update={"values": {**one.values, "when": dated(one.values["when"])}})
        for one in headline.values["stretches"]
    )
    now = headline.values["now"]
    values = {**headline.values, "stretches": stretches, "now": None if now is None else dated(now)}
    return headline.model_copy(update={"values": values})
