"""Serves the application on this machine alone."""

import resource
import secrets
import socket
import sys
import tempfile
import webbrowser
from pathlib import Path

import typer
import uvicorn

from processing.commands.progress_bar import progress_line
from processing.errors import ProcessError
from viewer.application import application


def serve(folder: Path, port: int, browser: bool) -> None:
    """Serve a folder until Ctrl-C; prints the address. Raises ProcessError where folder or port cannot be had."""
    if not folder.is_dir():
        reason = "is a file, and no folder" if folder.exists() else "no such folder"
        raise ProcessError(f"{folder}: {reason}. `view FOLDER` shows what is in it.")
    token = secrets.token_urlsafe(18)
    try:
        listener = socket.create_server(("127.0.0.1", port), backlog=64)
    except OSError as error:
        raise ProcessError(f"port {port} cannot be had ({error.strerror}); leave --port away for any other.") from error
    app = application(folder, token)
    # Thousands of new captures take a minute, in which the first page would be blank.
    with progress_line("reading new files", verbose=False) as say:
        app.state.pages.library.entries(say)
    address = f"http://127.0.0.1:{listener.getsockname()[1]}/{token}/"
    typer.echo(f"view: {address}")
    typer.echo("Ctrl-C ends it; runs started from the page continue.", err=True)
    sys.stdout.flush()
    # A browser that sends no request holds a connection; other requests need one more.
    limit = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (limit if limit != resource.RLIM_INFINITY else 1 << 16, limit))
    way_in = open_in_browser(address) if browser else None
    # Addresses hold the token, so no request is ever logged.
    settings = uvicorn.Config(app, log_level="warning", access_log=False, timeout_graceful_shutdown=1, lifespan="off")
    try:
        uvicorn.Server(settings).run(sockets=[listener])
    finally:
        if way_in is not None:
            way_in.unlink(missing_ok=True)


def open_in_browser(address: str) -> Path:
    """Open the address by way of a page that this user alone can read: every user sees the words of a command."""
    with tempfile.NamedTemporaryFile("w", prefix="umov-view-", suffix=".html", delete=False) as file:
        file.write(f'<!doctype html><meta http-equiv="refresh" content="0; url={address}"><title>view</title>')
    webbrowser.open(Path(file.name).as_uri())
    return Path(file.name)
