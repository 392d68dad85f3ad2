"""The commands of the pages: serve them, and who may log in."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.cli.app import app
from servoscope.cli.exit import print_json
from servoscope.cli.service import check_web_extra
from servoscope.core.errors import ConfigError
from servoscope.core.messages import say, translate
from servoscope.service.access import ROLES, Role, Users, WebSettings

if TYPE_CHECKING:
    from servoscope.service.config import ServiceFile

users_app = typer.Typer(no_args_is_help=True, help="Who may log in to the pages: names, roles and passwords in a file.")
app.add_typer(users_app, name="users")

UsersOption = Annotated[Path, typer.Option("--users", metavar="FILE", help="File of users.")]
NameArgument = Annotated[str, typer.Argument(metavar="NAME", help="Name of the user.")]
DEFAULT_USERS_FILE = Path("users.json")


@app.command()
def serve(
    config: Annotated[
        Path | None, typer.Argument(metavar="[CONFIG]", help="Service file (TOML).", show_default=False)
    ] = None,
    store: Annotated[
        str | None, typer.Option(metavar="STORE", help="SQLite file, or URL of a PostgreSQL database, without CONFIG.")
    ] = None,
    listen: Annotated[str | None, typer.Option(metavar="HOST:PORT", help="Where; default 127.0.0.1:8080.")] = None,
    host: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Name that the server is reached by; repeatable.")
    ] = None,
    users: Annotated[
        str | None, typer.Option("--users", metavar="FILE", help="File of users; required beyond loopback.")
    ] = None,
    folder: Annotated[str | None, typer.Option(metavar="DIR", help="Where uploads and baselines are kept.")] = None,
    certificate: Annotated[str | None, typer.Option(metavar="PEM", help="Certificate: serve HTTPS.")] = None,
    key: Annotated[str | None, typer.Option(metavar="PEM", help="Key of the certificate.")] = None,
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
) -> None:
    """Serve pages and HTTP interface over a store, with nothing a new one; on loopback without login, by default."""
    if config is not None and store is not None:
        raise typer.BadParameter("give a service file or --store, and not both")
    check_web_extra()
    from servoscope.service.config import ServiceFile, StoreSettings
    from servoscope.service.store import Store
    from servoscope.web.server import STORE_TIMEOUT_S, run_server

    service = ServiceFile.load(config) if config is not None and not _is_empty(config) else None
    # paths on the command line are relative to the current folder, those in the service file to its own
    paths = {"users": users, "folder": folder, "certificate": certificate, "key": key}
    given = {name: None if path is None else str(Path(path).absolute()) for name, path in paths.items()}
    settings = merge_web_settings(service, {**given, "listen": listen, "hosts": host or None})
    here = Path.cwd() if config is None else config.absolute().parent
    url = service.store.url if service is not None else store or StoreSettings().url
    # a store that exists is only read; one that does not is made, so that files can be diagnosed at once
    missing = "://" not in url and not (here / url).exists()
    opened = Store.open(url, here, write=missing, lock_timeout_s=STORE_TIMEOUT_S)
    if missing:
        typer.echo(say("cli.new_store", name=opened.name), err=True)
    run_server(settings, opened, service, here, with_parent=with_parent)


def _is_empty(config: Path) -> bool:
    """Tell whether a service file says nothing yet: then the pages lead to the first machine."""
    from servoscope.core.settings import parse_toml, read_toml_text

    return not parse_toml(read_toml_text(config, "service file", ConfigError), config, ConfigError)


def merge_web_settings(config: ServiceFile | None, given: dict[str, object]) -> WebSettings:
    """Return the section ``[web]`` with the options of the command line in place of its own."""
    from pydantic import ValidationError

    from servoscope.core.settings_errors import describe_error

    base = config.web.model_dump() if config is not None and config.web is not None else {}
    try:
        return WebSettings.model_validate({**base, **{key: value for key, value in given.items() if value is not None}})
    except ValidationError as error:
        raise ConfigError(describe_error(error, WebSettings, "web")) from None


@users_app.command()
def add(
    name: NameArgument,
    role: Annotated[
        str, typer.Option(metavar="ROLE", help=f"{', '.join(ROLES)}: each may do what those before it may.")
    ] = "viewer",
    file: UsersOption = DEFAULT_USERS_FILE,
    password_stdin: Annotated[
        bool, typer.Option("--password-stdin", help="Read the password from stdin instead of asking.")
    ] = False,
) -> None:
    """Add a user, or give one a new role and password."""
    chosen: Role | None = next((known for known in ROLES if known == role), None)
    if chosen is None:
        raise typer.BadParameter(f"--role {role}: choose from {', '.join(ROLES)}")
    known = Users(file)
    known.all()
    if password_stdin:
        password = sys.stdin.readline().rstrip("\n")
    else:
        password = typer.prompt(translate("Password"), hide_input=True, confirmation_prompt=True)
    known.add(name, chosen, password)
    typer.echo(say("cli.user", file=str(file), name=name, role=chosen))


@users_app.command("list")
def print_users(
    file: UsersOption = DEFAULT_USERS_FILE, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False
) -> None:
    """List users and roles."""
    users = Users(file).all()
    if as_json:
        print_json(users, lines=False)
    else:
        for name, role in sorted(users.items()):
            typer.echo(f"{name}  {translate(role)}")


@users_app.command()
def remove(name: NameArgument, file: UsersOption = DEFAULT_USERS_FILE) -> None:
    """Remove a user; its sessions end."""
    Users(file).remove(name)
    typer.echo(say("cli.no_user", file=str(file), name=name))
