"""Serves the application on this machine alone."""

from __future__ import annotations

import secrets
import socket
import sys
import webbrowser
from pathlib import Path

import typer
import uvicorn

from processing.errors import ProcessError
from viewer.application import application


def serve(folder: Path, port: int, browser: bool) -> None:
    """Serve a folder until Ctrl-C; prints the address. Raises ProcessError where folder or port cannot be had."""
    if not folder.is_dir():
        why = "is a file, and no folder" if folder.exists() else "no such folder"
        raise ProcessError(f"{folder}: {why}. `view FOLDER` shows what is in it.")
    token = secrets.token_urlsafe(18)
    try:
        listener = socket.create_server(("127.0.0.1", port), backlog=64)
    except OSError as error:
        raise ProcessError(f"port {port} cannot be had ({error.strerror}); leave --port away for any other.") from error
    address = f"http://127.0.0.1:{listener.getsockname()[1]}/{token}/"
    typer.echo(f"view: {address}")
    typer.echo("Ctrl-C ends it; runs started from the page go on.", err=True)
    sys.stdout.flush()
    if browser:
        webbrowser.open(address)
    # Addresses hold the token, so no request is ever logged.
    settings = uvicorn.Config(
        application(folder, token), log_level="warning", access_log=False, timeout_graceful_shutdown=1, lifespan="off"
    )
    uvicorn.Server(settings).run(sockets=[listener])
