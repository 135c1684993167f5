"""One capture from Python: plan and rig in, path of the sealed capture out."""

from collections.abc import Sequence
from pathlib import Path

from acquisition.capture import session
from acquisition.capture.checks import refuse_failed
from acquisition.capture.free_name import free_name
from acquisition.capture.header import default_name
from acquisition.capture.job import check_with_devices, prepare
from acquisition.capture.plan import MeasurementPlan
from acquisition.errors import AcquisitionError
from acquisition.rig.config import RigConfig
from acquisition.rig.open_rig import open_rig
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest


def take_capture(
    plan: MeasurementPlan, rig: RigConfig, folder: Path | str, home: bool = False, *, observers: Sequence[Observer] = ()
) -> Path:
    """Check everything, take the capture, seal it; Ctrl-C ends it after the state that is being taken.

    The guard of `acquire` (docs/safety.md) watches from the first light on.

    Parameters
    ----------
    plan : MeasurementPlan
    rig : RigConfig
    folder : path or str
        For the file, which is named as `acquire` names it.
    home : bool
        Home axes without a reference before the first move; nothing homes unless asked here or by the rig file.
    observers : sequence of Observer
        Hear of each step, as the progress bar of `acquire` does.

    Returns
    -------
    Path
        The sealed capture.

    Raises
    ------
    AcquisitionError, DeviceError
        It was refused, failed or was stopped; the message names the file that can be resumed.

    Examples
    --------
    >>> from acquisition import MeasurementPlan, load_rig, take_capture
    >>> plan = MeasurementPlan.load("plans/stokes.yaml").with_changes(exposure_s=0.001)
    >>> with Capture(take_capture(plan, load_rig("rig.yaml"), "captures")) as capture:
    ...     capture.header.mode, capture.simulated, len(capture.role)
    ('stokes', True, 12)
    """
    job = prepare(plan, rig)
    with StopRequest() as stop, open_rig(rig) as devices:
        refuse_failed(check_with_devices(job, devices, Path(folder)))
        with free_name(Path(folder) / default_name(plan)) as path:
            result = session.take(job, devices, path, stop, observers=observers, home=home)
    if result.status != "complete":
        raise AcquisitionError(f"{result.path} was stopped ({result.status}); `acquire --resume` continues it.")
    return result.path
