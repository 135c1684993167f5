"""Access control: browsers on this machine that have the address with its token, and no page of another site."""

import secrets

from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

LOCAL = frozenset({"127.0.0.1", "localhost"})

#: The plotting library sets styles on its elements and makes pictures of them to save.
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; "
    "connect-src 'self'; frame-src 'self'; base-uri 'none'; form-action 'self'; frame-ancestors 'self'"
)


class PageGuard:
    """Refuses every request whose address lacks the token, or that another site has caused.

    Parameters
    ----------
    token : first part of the path of every address.
    """

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app = app
        self._token = token.encode()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        refusal = self._refusal(scope["method"], scope["path"], Headers(scope=scope))
        if refusal is not None:
            await PlainTextResponse(refusal, 403)(scope, receive, send)
            return

        async def send_guarded(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = MutableHeaders(scope=message)
                headers["Content-Security-Policy"] = POLICY
                headers["Referrer-Policy"] = "no-referrer"
                headers["X-Content-Type-Options"] = "nosniff"
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        await self._app(scope, receive, send_guarded)

    def _refusal(self, method: str, path: str, headers: Headers) -> str | None:
        host = headers.get("host", "")
        # A site whose name resolves to this machine sends its own name.
        if host.partition(":")[0] not in LOCAL:
            return "only for a browser on this machine"
        if not secrets.compare_digest(path.removeprefix("/").partition("/")[0].encode(), self._token):
            return "the token in the address is missing or wrong; `view` prints the whole address"
        origin = headers.get("origin")
        if origin is None and method not in ("GET", "HEAD"):
            return "what changes something must come from a page of this program"
        if origin is not None and origin.partition("://")[2] != host:
            return "asked for by a page of another site"
        return None
