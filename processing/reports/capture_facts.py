"""What a capture is, in words: for its section of a report and for its page in the browser."""

import numpy as np

from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader


def facts_of(capture: Capture) -> list[tuple[str, str]]:
    """Names and texts: sample, mode, wavelength, Omega, states, exposure, frame."""
    header, (rows, columns) = capture.header, capture.frame_shape
    roles = ", ".join(f"{capture.role.count(role)} {role}" for role in dict.fromkeys(capture.role))
    done = f"{len(capture.role)} of {capture.planned_states}, {capture.status}"
    kind = "" if header.sample.kind == "unknown" else f" ({header.sample.kind})"
    return [
        ("sample", header.sample.name + kind if header.sample.name else header.sample.kind),
        ("mode", header.mode),
        ("wavelength", f"{header.wavelength_nm:g} nm"),
        ("Omega", "not stated" if header.omega_deg is None else f"{header.omega_deg:g} degrees"),
        ("states", f"{done}: {roles}" if roles else done),
        ("exposure", _exposure(capture)),
        ("frame", f"{columns} x {rows}, channels: {capture.channels}, {capture.dtype}"),
    ]


def _exposure(capture: Capture) -> str:
    exposures = np.unique(capture.column("exposure_s"))
    if not np.all(exposures > 0):
        return "not stated"
    if len(exposures) > 4:
        return f"{exposures[0]:.4g} to {exposures[-1]:.4g} s"
    return ", ".join(f"{value:.4g}" for value in exposures) + " s"


def papers_of(header: CaptureHeader) -> list[tuple[str, str]]:
    """Names and texts of the files that the capture was made from, those that it holds."""
    papers = (("plan", header.plan_yaml), ("rig", header.rig_yaml), ("instrument model", header.instrument_yaml))
    return [(name, text) for name, text in papers if text.strip()]
