"""Arm, sample holder and whatever else could collide, as simple solids in the rig file's `solids` section.

Lengths are in mm, in the frame of the instrument: the origin is the centre of rotation, y points up, the camera stands
on +z. A solid that turns with an axis is given as it stands at that axis's angle 0; it turns about the vertical
through the origin, from +z towards +x, as the arm does.
"""

from typing import Annotated, Literal

from pydantic import Field

from processing.section import FiniteSection

Length = Annotated[float, Field(gt=0, le=10_000)]
Coordinate = Annotated[float, Field(ge=-10_000, le=10_000)]


class _Solid(FiniteSection):
    name: str = Field(description="name that messages and other files use")
    centre_mm: tuple[Coordinate, Coordinate, Coordinate] = Field(description="centre from the centre of rotation, mm")
    turns_with: str | None = Field(default=None, description="axis that carries it; without one it stands still")


class Box(_Solid):
    """A box with its edges along x, y and z."""

    shape: Literal["box"] = Field(description="box, cylinder or disc")
    size_mm: tuple[Length, Length, Length] = Field(description="edges, mm")


class Cylinder(_Solid):
    """An upright cylinder."""

    shape: Literal["cylinder"] = Field(description="box, cylinder or disc")
    radius_mm: Length = Field(description="radius, mm")
    height_mm: Length = Field(description="height, mm")


class Disc(_Solid):
    """A disc on edge that faces along z, for instance a mount in the beam."""

    shape: Literal["disc"] = Field(description="box, cylinder or disc")
    radius_mm: Length = Field(description="radius, mm")
    thickness_mm: Length = Field(description="thickness, mm")


Solid = Annotated[Box | Cylinder | Disc, Field(discriminator="shape")]


class Solids(FiniteSection):
    """Solids that must keep their distance from each other at every instant of every move."""

    margin_mm: float = Field(ge=0, le=1000, description="smallest distance allowed")
    parts: tuple[Solid, ...] = Field(description="boxes, cylinders and discs that must keep apart")
