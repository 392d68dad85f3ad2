"""The commands of the pages: serve them, and who may log in."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from servoscope.access import ROLES, Role
from servoscope.cli.app import app
from servoscope.cli.shell import print_json

if TYPE_CHECKING:
    from servoscope.access import WebSettings
    from servoscope.live.config import Config

users = typer.Typer(no_args_is_help=True, help="Who may log in to the pages: names, roles and passwords in a file.")
app.add_typer(users, name="users")

UsersFile = Annotated[Path, typer.Option("--users", metavar="FILE", help="File of users.")]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of the user.")]
DEFAULT = Path("users.json")


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
    """Serve pages and HTTP interface over a store; on loopback, without login, unless told otherwise."""
    if (config is None) == (store is None):
        raise typer.BadParameter("give a service file or --store, and not both")
    try:
        import fastapi  # noqa: F401  # the first of what the extra brings
        import uvicorn  # noqa: F401
    except ModuleNotFoundError as error:
        from servoscope.errors import ConfigError

        raise ConfigError(f"{error.name} is missing, pip install 'servoscope[web]'") from None
    from servoscope.live.config import Config
    from servoscope.store import Store
    from servoscope.web.serving import STORE_PATIENCE
    from servoscope.web.serving import serve as run

    found = Config.load(config) if config is not None else None
    # what is said here is relative to where it is said, and what the service file says to that file
    paths = {"users": users, "folder": folder, "certificate": certificate, "key": key}
    given = {name: None if path is None else str(Path(path).absolute()) for name, path in paths.items()}
    settings = settings_of(found, {**given, "listen": listen, "hosts": host or None})
    here = found.folder if found is not None else Path.cwd()
    url = found.store.url if found is not None else str(store)
    # a store that is there is never changed; one that is not is made, so that files can be diagnosed at once
    missing = "://" not in url and not (here / url).exists()
    opened = Store.open(url, here, write=missing, patience=STORE_PATIENCE)
    if missing:
        typer.echo(f"servoscope: {opened.name} is new, and empty until servoscope run follows assets", err=True)
    run(settings, opened, found, here, with_parent=with_parent)


def settings_of(config: Config | None, given: dict[str, object]) -> WebSettings:
    """Return the section ``[web]`` with what the command line says laid over it.

    Raises
    ------
    ConfigError
        If they do not go together.
    """
    from pydantic import ValidationError

    from servoscope.access import WebSettings
    from servoscope.complaints import describe
    from servoscope.errors import ConfigError

    base = config.web.model_dump() if config is not None and config.web is not None else {}
    try:
        return WebSettings.model_validate({**base, **{key: value for key, value in given.items() if value is not None}})
    except ValidationError as error:
        raise ConfigError(describe(error, WebSettings, "web")) from None


@users.command()
def add(
    name: Name,
    role: Annotated[
        str, typer.Option(metavar="ROLE", help=f"{', '.join(ROLES)}: each may do what those before it may.")
    ] = "viewer",
    file: UsersFile = DEFAULT,
    password_stdin: Annotated[
        bool, typer.Option("--password-stdin", help="Read the password from stdin instead of asking.")
    ] = False,
) -> None:
    """Add a user, or give one a new role and password."""
    from servoscope.access import Users

    chosen: Role | None = next((one for one in ROLES if one == role), None)
    if chosen is None:
        raise typer.BadParameter(f"--role {role}: choose from {', '.join(ROLES)}")
    known = Users(file)
    known.all()
    if password_stdin:
        password = sys.stdin.readline().rstrip("\n")
    else:
        password = typer.prompt("Password", hide_input=True, confirmation_prompt=True)
    known.add(name, chosen, password)
    typer.echo(f"{file}: {name} is {chosen}")


@users.command("list")
def list_(file: UsersFile = DEFAULT, as_json: Annotated[bool, typer.Option("--json", help="As JSON.")] = False) -> None:
    """List users and roles."""
    from servoscope.access import Users

    found = Users(file).all()
    if as_json:
        print_json(found, lines=False)
    else:
        for name, role in sorted(found.items()):
            typer.echo(f"{name}  {role}")


@users.command()
def remove(name: Name, file: UsersFile = DEFAULT) -> None:
    """Remove a user; its sessions end."""
    from servoscope.access import Users

    Users(file).remove(name)
    typer.echo(f"{file}: {name} is removed")
