"""The commands `servoscope alarms ...`: what operators ask of alarms; the running service carries it out."""

from __future__ import annotations

import getpass
import time
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.moments import duration
from servoscope.cli.options import AsJson
from servoscope.cli.service import OfAsset, StoreText, known, open_store
from servoscope.cli.shell import print_json
from servoscope.errors import AlarmError

alarms = typer.Typer(no_args_is_help=True, help="List alarms, and ask for what operators may do with them.")
app.add_typer(alarms, name="alarms")

Asset = Annotated[str, typer.Argument(metavar="ASSET", help="Whose alarm; the service's name for its own.")]
Alarm = Annotated[str, typer.Argument(metavar="ALARM", help="Name of the alarm, for example fault.")]
Who = Annotated[str | None, typer.Option(metavar="NAME", help="Who asks; default: the user of this terminal.")]
Why = Annotated[str, typer.Option(metavar="TEXT", help="Why; kept in the history.")]

PATIENCE_S = 5.0
LONGEST_S = 366 * 86400.0  # shelving has an end
COLUMNS = ("asset", "alarm", "state", "since", "until", "priority")


@alarms.command("list")
def list_(store: StoreText, asset: OfAsset = None, as_json: AsJson = False) -> None:
    """List the alarms that are not normal."""
    from servoscope.cli import terminal, watching

    opened = open_store(store)
    known(opened, asset or ())
    found = watching.alarm_rows(opened.statuses(asset))
    if as_json:
        print_json(found, lines=False)
    else:
        terminal.console().print(watching.rows(found, COLUMNS))


@alarms.command()
def ack(store: StoreText, asset: Asset, alarm: Alarm, who: Who = None, why: Why = "") -> None:
    """Acknowledge: somebody has seen it."""
    ask(store, asset, alarm, "acknowledge", who, {"why": why})


@alarms.command()
def reset(store: StoreText, asset: Asset, alarm: Alarm, who: Who = None, why: Why = "") -> None:
    """Reset a latched alarm that was acknowledged, and whose cause has gone."""
    ask(store, asset, alarm, "reset", who, {"why": why})


@alarms.command()
def shelve(
    store: StoreText,
    asset: Asset,
    alarm: Alarm,
    time_: Annotated[str, typer.Option("--for", metavar="TIME", help="For how long: 30min, 8h, 2d.")],
    who: Who = None,
    why: Why = "",
) -> None:
    """Put it on the shelf for a time: it is not announced until that has passed."""
    for_s = duration(time_, "--for")
    if for_s > LONGEST_S:
        raise typer.BadParameter(f"--for {time_!r}: at most 366d; what is to stay silent longer is out-of-service")
    ask(store, asset, alarm, "shelve", who, {"why": why, "for_s": for_s})


@alarms.command()
def unshelve(store: StoreText, asset: Asset, alarm: Alarm, who: Who = None, why: Why = "") -> None:
    """Take it from the shelf."""
    ask(store, asset, alarm, "unshelve", who, {"why": why})


@alarms.command("out-of-service")
def out_of_service(store: StoreText, asset: Asset, alarm: Alarm, who: Who = None, why: Why = "") -> None:
    """Take it out of service, for maintenance, until it is returned."""
    ask(store, asset, alarm, "remove_from_service", who, {"why": why})


@alarms.command("return")
def return_(store: StoreText, asset: Asset, alarm: Alarm, who: Who = None, why: Why = "") -> None:
    """Return it to service."""
    ask(store, asset, alarm, "return_to_service", who, {"why": why})


def ask(store: str, asset: str, alarm: str, command: str, who: str | None, document: dict[str, str | float]) -> None:
    """Write a command into the store, and wait a little for the service to carry it out."""
    opened = open_store(store)
    known(opened, [asset])
    row = {"who": who or getpass.getuser(), "asset": asset, "alarm": alarm, "command": command, "document": document}
    asked = opened.ask(row)
    deadline = time.monotonic() + PATIENCE_S
    while (outcome := opened.outcome(asked)) is None and time.monotonic() < deadline:
        time.sleep(0.1)
    if outcome is None:
        typer.echo(f"{asset}: {alarm}: asked for; servoscope run will carry it out when it runs")
    elif outcome.startswith("refused: "):
        raise AlarmError(outcome.removeprefix("refused: "))
    else:
        typer.echo(f"{asset}: {alarm}: {outcome}")
