"""Alarms of the guard on every page, and the button that acknowledges one."""

from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse

from acquisition.rig import alarms
from viewer.library import NotHere
from viewer.pages import fields_of, pages_of


def alarms_now(request: Request) -> HTMLResponse:
    """The part of a page that shows the alarms that are not acknowledged."""
    return pages_of(request).draw("alarms.html")


async def acknowledge(request: Request) -> JSONResponse:
    """End an alarm, as `acquire acknowledge` does. Raises NotHere for one that is over."""
    name = (await fields_of(request)).get("name", "")
    alarm = next((alarm for alarm in alarms.unacknowledged() if alarm.path.name == name), None)
    if alarm is None:
        raise NotHere(f"{name}: this alarm is over, or there is none of that name")
    alarms.acknowledge(alarm)
    return JSONResponse({})
