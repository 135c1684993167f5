"""Constants by which the diagnosis decides, shared by instrument and surface."""

from __future__ import annotations

#: Sine of the angle between two signatures from which on a capture tells them apart.
APART = 0.3
