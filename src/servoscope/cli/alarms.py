"""The commands ``servoscope alarms ...``: operators' commands on alarms, which the running service executes."""

from __future__ import annotations

import getpass
import time
from typing import Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.arguments import parse_duration
from servoscope.cli.exit import print_json
from servoscope.cli.options import JsonOption, ReasonOption, UserOption
from servoscope.cli.service import AssetOption, StoreArgument, open_store
from servoscope.core.errors import AlarmError
from servoscope.core.messages import message
from servoscope.core.settings_errors import suggest_name

alarms_app = typer.Typer(no_args_is_help=True, help="List alarms, and ask for what operators may do with them.")
app.add_typer(alarms_app, name="alarms")

AssetArgument = Annotated[str, typer.Argument(metavar="ASSET", help="Whose alarm; the service's name for its own.")]
AlarmArgument = Annotated[str, typer.Argument(metavar="ALARM", help="Name of the alarm, for example fault.")]

COMMAND_TIMEOUT_S = 5.0
MAX_SHELVING_S = 366 * 86400.0  # shelving has an end
COLUMNS = ("asset", "alarm", "state", "since", "until", "priority", "cause")


@alarms_app.command("list")
def print_alarms(store: StoreArgument, asset: AssetOption = None, as_json: JsonOption = False) -> None:
    """List the alarms that are not normal."""
    from servoscope.cli.render import history, results

    active = history.active_alarms(open_store(store, asset or ()).statuses(asset))
    if as_json:
        print_json(active, lines=False)
    else:
        results.create_console().print(history.row_table(active, COLUMNS))


def add_command(name: str, command: str, words: str) -> None:
    """Add a command that takes nothing but the alarm, the user and the reason."""

    @alarms_app.command(name, help=words)
    def send(
        store: StoreArgument, asset: AssetArgument, alarm: AlarmArgument, who: UserOption = None, why: ReasonOption = ""
    ) -> None:
        send_command(store, asset, alarm, command, who, why)


add_command("ack", "acknowledge", "Acknowledge: somebody has seen it.")
add_command("reset", "reset", "Reset a latched alarm that was acknowledged, and whose cause has gone.")


@alarms_app.command()
def shelve(
    store: StoreArgument,
    asset: AssetArgument,
    alarm: AlarmArgument,
    time_: Annotated[str, typer.Option("--for", metavar="TIME", help="For how long: 30min, 8h, 2d.")],
    who: UserOption = None,
    why: ReasonOption = "",
) -> None:
    """Put it on the shelf for a time: it is not announced until that has passed."""
    for_s = parse_duration(time_, "--for")
    if for_s > MAX_SHELVING_S:
        raise typer.BadParameter(f"--for {time_!r}: at most 366d; what is to stay silent longer is out-of-service")
    send_command(store, asset, alarm, "shelve", who, why, for_s)


add_command("unshelve", "unshelve", "Take it from the shelf.")
add_command("out-of-service", "remove_from_service", "Take it out of service, for maintenance, until it is returned.")
add_command("return", "return_to_service", "Return it to service.")


def send_command(
    store: str, asset: str, alarm: str, command: str, who: str | None, reason: str, for_s: float | None = None
) -> None:
    """Write a command into the store, and wait a little for the service to execute it.

    Raises AlarmError if the service file has no such alarm, whether the service runs or not.
    """
    from servoscope.service.config import ServiceFile

    opened = open_store(store, [asset])
    kind, _, _ = alarm.partition(".")  # a connection's alarm has the name of its source behind a dot
    known = ServiceFile.load(store).alarms.definitions if store.endswith(".toml") else (kind,)
    if kind not in known:
        raise AlarmError(f"{asset}: has no alarm {alarm!r}, {suggest_name(alarm, known)}")
    number = opened.add_command(who or getpass.getuser(), asset, alarm, command, reason=reason, for_s=for_s)
    deadline = time.monotonic() + COMMAND_TIMEOUT_S
    while (outcome := opened.command_outcome(number)) is None and time.monotonic() < deadline:
        time.sleep(0.1)
    if outcome is None:
        typer.echo(f"{asset}: {alarm}: {message('cli.asked_for')}")
    elif not outcome.accepted:
        raise AlarmError(outcome.refusal)
    else:
        typer.echo(f"{asset}: {alarm}: {outcome.text}")
