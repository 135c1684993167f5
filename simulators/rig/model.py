"""The `simulator` section of a rig file: emulators, the scene, and the truth that the declared rig may not know."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from pydantic import Field

from processing.instrument.model import InstrumentModel
from processing.section import Section
from processing.storage.captures.schema import Detector
from simulators.bench.bench import DARK_CURRENT_E_PER_S, DETECTOR
from simulators.bench.effects import AnyBenchEffect
from simulators.bench.scene import Scene
from simulators.camera.genicam.description_file import is_description

#: A device whose port reads `sim:NAME` stands at the emulator of that name.
SCHEME = "sim:"


class SimulatedPort(Section):
    """An emulated controller behind a pseudo-terminal; `faults` as in `simulate serve`, e.g. "garbled@12x1"."""

    kind: str
    axes: int | None = Field(
        default=None, ge=1, le=99, description="number of its axes; the kind's own number without it"
    )
    speed_deg_s: float = Field(default=300.0, gt=0, description="speed, degrees a second")
    acceleration_deg_s2: float = Field(default=1500.0, gt=0, description="acceleration, degrees a second squared")
    limits_deg: tuple[float | None, float | None] | None = Field(default=None, description="travel, degrees")
    homed: bool = Field(default=False, description="whether its axes have their reference from the start")
    faults: tuple[str, ...] = Field(
        default=(), description="what it does wrong, as in `simulate serve`, for example garbled@12x1"
    )


class SimulatedAxis(Section):
    """Where an axis of the rig is emulated: which port, and which axis of that controller, from 0."""

    port: str = Field(description="name of the emulated controller")
    index: int = Field(default=0, ge=0, description="which axis of that controller, from 0")


class SimulatorConfig(Section):
    """What stands behind a simulated rig.

    `truth` names, for each mode, the instrument that the bench really has where it differs from the declared one;
    `detector` the same for the detector. `stamp` writes the true axis angles into the first pixels of each frame.
    """

    seed: int = Field(default=1, ge=0, lt=1 << 63, description="of the simulated noise")
    clock_speed: float = Field(default=10.0, gt=0, description="simulated seconds for a real second")
    rows: int = Field(default=600, gt=0, description="pixels from top to bottom")
    columns: int = Field(default=600, gt=0, description="pixels from left to right")
    ports: dict[str, SimulatedPort] = Field(description="emulated controllers by the name of their port")
    axes: dict[str, SimulatedAxis] = Field(description="which axis of which emulated controller is which")
    samples: dict[str, Path] = Field(description="scene file of each sample by its name")
    truth: dict[str, Path] = Field(
        default={}, description="instrument file that the bench really is, by mode; the declared one without it"
    )
    detector: Detector = Field(default=DETECTOR, description="what the detector really is, where it is not as declared")
    flux_e_per_s: float = Field(gt=0, description="electrons a second where a . M . g is 1")
    dark_current_e_per_s: float = Field(
        default=DARK_CURRENT_E_PER_S, ge=0, description="dark current of a pixel, electrons a second"
    )
    effects: tuple[AnyBenchEffect, ...] = Field(default=(), description="faults of the bench that nobody declared")
    camera: str = Field(
        default="loopback",
        description="feature table of a maker's camera: a name in simulators/camera/node_maps, or a file (.yaml); or "
        "the GenICam description of a camera itself (.xml, .zip), which is played as it is",
    )
    camera_address: str = Field(
        default="127.0.0.1",
        description="loopback address of the camera; any other of this machine where another camera has it",
    )
    camera_wait_s: float = Field(default=10.0, ge=0, description="wait for that address while another run has it")
    packet_loss: float = Field(default=0.0, ge=0, lt=1, description="part of the camera's packets that are lost")
    stamp: bool = Field(default=False, description="write the true angles into the pixels, for tests")

    def files(self, samples: Iterable[str] | None = None) -> Iterator[tuple[str, Path, Callable[[Path], object]]]:
        """Title, path and reader of each file of the bench: scenes of these samples or of all, and `truth`."""
        for name in dict.fromkeys(self.samples if samples is None else samples):
            if name in self.samples:
                yield f"scene {name}", self.samples[name], Scene.load
        for mode, path in self.truth.items():
            yield f"truth of {mode}", path, InstrumentModel.load

    def below(self, folder: Path) -> "SimulatorConfig":
        """The same with its relative paths made absolute, from `folder`."""
        own_file = self.camera.endswith(".yaml") or is_description(self.camera)
        return self.model_copy(
            update={
                "camera": str(folder / self.camera) if own_file else self.camera,
                "samples": {name: folder / path for name, path in self.samples.items()},
                "truth": {name: folder / path for name, path in self.truth.items()},
            }
        )
