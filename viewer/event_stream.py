"""What something looks like, sent to a page whenever it has changed (server-sent events)."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import StreamingResponse

#: Seconds between two looks.
EVERY_S = 0.5
#: Looks without a change after which a line is sent, so that a closed page is noticed.
ALIVE_EVERY = 20


def event_stream(
    request: Request, look: Callable[[], dict[str, Any]], last: Callable[[dict[str, Any]], bool] = lambda now: False
) -> StreamingResponse:
    """Send what `look` tells until the page goes away, or `last` says that no more will come."""
    return StreamingResponse(_changes(request, look, last), media_type="text/event-stream")


async def _changes(
    request: Request, look: Callable[[], dict[str, Any]], last: Callable[[dict[str, Any]], bool]
) -> AsyncIterator[str]:
    before, looks = "", 0
    while not await request.is_disconnected():
        now = await run_in_threadpool(look)
        if (text := json.dumps(now)) != before:
            yield f"data: {text}\n\n"
            before = text
        elif looks % ALIVE_EVERY == 0:
            yield ": still here\n\n"
        if last(now):
            return
        looks += 1
        await asyncio.sleep(EVERY_S)
