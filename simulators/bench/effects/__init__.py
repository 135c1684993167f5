"""What a real bench does that its declared model does not: one small object a cause, sorted by where it acts."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from simulators.bench.effects.detector import BlackDrift, BlackOffset, Nonlinearity, PixelResponse, ToneCurve
from simulators.bench.effects.image import ImageDrift, MosaicCrosstalk, StrayLight, VeilingGlare
from simulators.bench.effects.motion import AngleJitter, AngleOffset, AnglePlay, AngleScale, AngleSlip, AngleWobble
from simulators.bench.effects.optics import (
    ChannelError,
    ElementError,
    FieldRetardance,
    PlateRetardance,
    PlateTransmission,
    Window,
)
from simulators.bench.effects.source import SourceDrift, SourceFlicker, SourceLevel, SourceStep, UnevenLight

#: Any of them, told apart by `kind`; docs/effects.md has one for each effect of `diagnose`.
AnyBenchEffect = Annotated[
    AngleOffset
    | AngleScale
    | AngleWobble
    | AngleJitter
    | AngleSlip
    | AnglePlay
    | ElementError
    | Window
    | PlateRetardance
    | PlateTransmission
    | FieldRetardance
    | ChannelError
    | SourceDrift
    | SourceFlicker
    | SourceStep
    | SourceLevel
    | UnevenLight
    | ImageDrift
    | StrayLight
    | VeilingGlare
    | MosaicCrosstalk
    | Nonlinearity
    | PixelResponse
    | BlackDrift
    | BlackOffset
    | ToneCurve,
    Field(discriminator="kind"),
]
