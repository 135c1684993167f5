"""Effects of a real bench that its declared model lacks: one small object a cause, sorted by where it acts."""

from typing import Annotated

from pydantic import Field

from simulators.bench.effects.detector import BlackDrift, BlackOffset, Nonlinearity, PixelResponse, ToneCurveFault
from simulators.bench.effects.image import ImageDriftFault, MosaicCrosstalk, StrayLightFault, VeilingGlare
from simulators.bench.effects.motion import AngleJitter, AngleOffset, AnglePlay, AngleScale, AngleSlip, AngleWobble
from simulators.bench.effects.optics import (
    ChannelError,
    ElementError,
    FieldRetardanceFault,
    PlateRetardance,
    PlateTransmission,
    WindowPlate,
)
from simulators.bench.effects.source import DriftFault, FlickerFault, LevelFault, SourceStep, UnevenLight

#: Any of them, told apart by `kind`; docs/effects.md has one for each effect of `diagnose`.
AnyBenchEffect = Annotated[
    AngleOffset
    | AngleScale
    | AngleWobble
    | AngleJitter
    | AngleSlip
    | AnglePlay
    | ElementError
    | WindowPlate
    | PlateRetardance
    | PlateTransmission
    | FieldRetardanceFault
    | ChannelError
    | DriftFault
    | FlickerFault
    | SourceStep
    | LevelFault
    | UnevenLight
    | ImageDriftFault
    | StrayLightFault
    | VeilingGlare
    | MosaicCrosstalk
    | Nonlinearity
    | PixelResponse
    | BlackDrift
    | BlackOffset
    | ToneCurveFault,
    Field(discriminator="kind"),
]
