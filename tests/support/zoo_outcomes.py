"""What becomes of a log of the zoo, as a user meets it."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path

import numpy as np
from zoo import Exhibit, motion

from servoscope.core.errors import ServoscopeError
from servoscope.learning.proposal import propose_columns, propose_loop
from servoscope.models.loop import Columns, TextLayout
from servoscope.signals import Recording
from servoscope.signals.readers import list_channels, read


class Outcome(StrEnum):
    """What became of a log."""

    AT_ONCE = "right at once"
    ONE_LINE = "right with the line that the message names"
    REFUSED = "refused, without a way in"
    WRONG = "wrong in silence"
    TRACEBACK = "traceback"


# what the message has to name, by the option that a log needs, and the columns with it
REMEDIES = {
    "names": "--columns 't=..., r=..., u=..., y=...'",
    "unit": "--columns 't=",
    "header_row": "--header-row",
    "comment": "--comment",
}


def find_outcome(one: Exhibit, path: Path) -> Outcome:
    """Write a log to a path, read it as `init` proposes, and with the option that it needs."""
    one.write(path)
    try:
        return _outcome(one, path)
    except ServoscopeError:
        return Outcome.REFUSED
    except Exception:  # which one is the same to a user
        return Outcome.TRACEBACK


def _outcome(one: Exhibit, path: Path) -> Outcome:
    try:
        columns = guess(path)
        if is_right(read(path, columns=columns)):
            return Outcome.AT_ONCE
        said = " ".join(str(line.why) for line in propose_loop([path], columns).lines if line.doubtful)
        failed = Outcome.WRONG
    except ServoscopeError as error:
        columns, said, failed = Columns(), str(error), Outcome.REFUSED
    if not one.options:
        return failed
    ((option, value),) = one.options.items()
    if REMEDIES[option] not in said:
        return failed
    if option == "names":
        columns = Columns(time="c0", reference="c1", input="c2", output="c3")
    elif option == "unit":
        columns = columns.model_copy(update={"time_unit": value})
    else:
        columns = guess(path, TextLayout.model_validate(one.options))
    return Outcome.ONE_LINE if is_right(read(path, columns=columns)) else Outcome.WRONG


def guess(path: Path, text: TextLayout | None = None) -> Columns:
    """Return the columns as they are proposed for a file."""
    return propose_columns(path, list_channels(path, text)).model_copy(update={"text": text})


def is_right(found: Recording) -> bool:
    """Tell whether a recording holds the motion of the zoo, at its rate."""
    expected = motion()
    return (
        found.samples == len(expected["t"])
        and np.isclose(found.sample_rate, 100.0, rtol=1e-6)
        and np.allclose(found.t - found.t[0], expected["t"], atol=2e-6)
        and all(np.allclose(getattr(found, name), expected[name], rtol=1e-7, atol=1e-9) for name in "ruy")
    )
