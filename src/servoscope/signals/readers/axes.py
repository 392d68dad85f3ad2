"""Which columns of a file are signals, and to which of its axes they belong."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import replace

from servoscope.signals.readers.column_words import describe_name
from servoscope.signals.readers.guess_columns import TIME_UNITS, guess_columns
from servoscope.signals.readers.recording_file import ChannelInfo
from servoscope.signals.readers.units import split_unit

# what tells axes apart in names: a number, or a letter that stands alone or ends a word as in AxisX
MARK = re.compile(
    r"\d+|(?<![A-Za-z0-9])[XYZABCxyzabc](?![A-Za-z0-9])|(?<=[a-z])[XYZABC](?![A-Za-z])"
    r"|(?<![A-Za-z])(?:roll|pitch|yaw)(?![A-Za-z])"
)
ROTATIONS = {"roll": "x", "pitch": "y", "yaw": "z"}  # which axis each turns about

MAX_AXES = 32  # numbers in more names than that count something else, samples for example
MAX_SUPPLY_RATIO = 1.05  # largest over smallest value of a positive column, no motion, that is a supply or temperature


def signal_names(channels: Sequence[ChannelInfo]) -> list[str]:
    """Return the names of columns that may be signals: without those that hardly vary, as a supply or temperature.

    Those are among them where none of the others may be u or y. Text is time only, and a constant is r only.
    """
    stamps = {channel.clock for channel in channels if channel.clock}
    if stamps:  # of several rasters, the time is that of the one that y is of
        names = signal_names([replace(channel, clock="") for channel in channels if channel.name not in stamps])
        measured = guess_columns(names).get("y")
        own = next((channel.clock for channel in channels if channel.name == measured), min(stamps))
        return [own, *names]
    likely = guess_columns([channel.name for channel in channels])
    clocks = {channel.name for channel in channels if guess_columns([channel.name]).keys() == {"t"}}
    named = [
        channel
        for channel in channels
        if channel.name in clocks or channel.min < channel.max or channel.name == likely.get("r")
    ]
    names = [
        channel_info.name for channel_info in named if channel_info.name in clocks or not math.isnan(channel_info.min)
    ]
    supplies = {
        channel.name
        for channel in channels
        if 0.0 < channel.min < channel.max < MAX_SUPPLY_RATIO * channel.min
        and describe_name(channel.name).quantity not in ("position", "speed")
    } - clocks
    moving = [name for name in names if name not in supplies]
    lost = {"u", "y"} & guess_columns(names).keys() - guess_columns(moving).keys()
    return names if lost else moving


def own_clock(channels: Sequence[ChannelInfo], output: object) -> dict[str, str]:
    """Return time and unit of the raster that a channel of the output is of, where a file has several."""
    told = str(output or "")
    clock = next((channel.clock for channel in channels if channel.clock and channel.name in told), "")
    return {"time": clock, "time_unit": TIME_UNITS.get(split_unit(clock)[1], "s")} if clock else {}


def find_axes(names: Sequence[str]) -> dict[str, list[str]]:
    """Return the columns that each axis can take, by the axis's mark; none where a file has one axis.

    Columns are of several axes where their names differ in one number or letter only, and where for at least two
    of them both u and y are found. Columns without a mark, such as the time, belong to all.
    """
    groups: dict[str, dict[str, str]] = defaultdict(dict)  # mark -> name with a blank in its place -> name
    for name in names:
        for match in MARK.finditer(name):
            blank = f"{name[: match.start()]}\0{name[match.end() :]}"
            if blank.strip("\0 _[]()"):  # a name that is nothing but its mark tells nothing: x, y
                groups[ROTATIONS.get(match[0], match[0])][blank] = name
    shared = {blank for group in groups.values() for blank in group}
    shared = {blank for blank in shared if sum(blank in group for group in groups.values()) > 1}
    own = {mark: [group[blank] for blank in group if blank in shared] for mark, group in groups.items()}
    marked = {name for marks in own.values() for name in marks}
    axes = {}
    for mark, mine in own.items():
        columns = [name for name in names if name in mine or name not in marked]
        found_columns = guess_columns(columns)
        if all(found_columns.get(letter) in mine for letter in "uy"):
            axes[mark] = columns
    return axes if 1 < len(axes) <= MAX_AXES else {}


def axes_of(channels: Sequence[ChannelInfo]) -> dict[str, list[str]]:
    """Return the columns that each axis can take, by the axis's mark, those at rest among them, but no time stamps."""
    stamps = {channel.clock for channel in channels}
    return find_axes([channel.name for channel in channels if channel.name not in stamps])


def moving_axes(channels: Sequence[ChannelInfo]) -> dict[str, list[str]]:
    """Return the signals of each axis that moves; of one at rest the input, the output or the reference is constant."""
    by_name = {channel.name: channel for channel in channels}
    moving = {}
    for axis, names in axes_of(channels).items():
        guessed = guess_columns(names)
        if all(by_name[guessed[letter]].min < by_name[guessed[letter]].max for letter in "ruy" if letter in guessed):
            moving[axis] = signal_names([by_name[name] for name in names])
    return moving


def signals_of_one_axis(channels: Sequence[ChannelInfo], used: Collection[str] = ()) -> list[str]:
    """Return the signals among which t, r, u and y are guessed: all, or those of one axis of several.

    That is the axis of the columns that are `used`, else the first that moves.
    """
    axes = axes_of(channels)
    common = set.intersection(*map(set, axes.values())) if axes else set()
    for names in axes.values():
        if ({*names} - common) & {*used}:
            return signal_names([channel for channel in channels if channel.name in names])
    return next(iter(moving_axes(channels).values()), None) or signal_names(channels)
