"""An axis and the camera of a rig as bluesky devices."""

from pathlib import Path
from typing import Any

import numpy as np

from acquisition.bluesky_devices.device import BlueskyDevice, Readings, data_key, readings
from acquisition.bluesky_devices.frames_in_files import FRAME, Documents, asset_documents, external_key, write_frame
from acquisition.bluesky_devices.status import MoveStatus, in_background
from acquisition.errors import AcquisitionError
from processing.storage.captures.schema import position_column


class AxisDevice(BlueskyDevice):
    """An axis of the rig; `set` goes to an angle in degrees, `read` tells where it is at rest."""

    @property
    def hints(self) -> dict[str, Any]:
        """What live tables show."""
        return {"fields": [self.name]}

    @property
    def position(self) -> float:
        """Angle as read back, degrees."""
        return self.rig.axes[self.name].read_position().deg

    #: Where a plan has sent it since the rig was opened.
    target_deg: float | None = None

    def _configuration(self) -> dict[str, tuple[Any, str]]:
        identity = self.rig.axes[self.name].describe()
        return {"serial_number": (identity.serial_number, ""), "model": (identity.model, "")}

    def set(self, value: float) -> MoveStatus:
        """Go to an angle, degrees. The status fails if it is forbidden, out of limits, or not reached."""

        def move() -> None:
            with self.turn:
                self.rig.move({self.name: float(value)})
                self.target_deg = float(value)

        return in_background(move)

    def stop(self, *, success: bool = False) -> None:
        """Stop the axis where it is."""
        self.rig.axes[self.name].stop()

    def read(self) -> Readings:
        """Angle as read back."""
        return readings({self.name: self.position})

    def describe(self) -> Readings:
        """Unit and source of the position."""
        _, unit = position_column(self.name, self.rig.axes[self.name].config.unit == "V")
        return {self.name: data_key(f"axis {self.name}, as read back", (), unit)}


class CameraDevice(BlueskyDevice):
    """The camera; `trigger` takes a frame, `read` gives it with its mean. The light is on while it is staged.

    Attributes
    ----------
    exposure_s : of the next frames; a plan sets it by `Bench.exposure`, or by `configure`.
    sample : sample that an emulated rig shows.
    folder : where frames are put, each in a file of its own that documents point to, as Tiled and everybody else who
        takes no images in events wants it; None: the events hold the frames.
    tells_frames : False for the mean alone.
    frame : (rows, columns) in counts, taken last.
    """

    frame: np.ndarray[Any, np.dtype[np.uint16]]
    _path: Path
    folder: Path | str | None = None
    exposure_s = 0.02
    sample = "red_sphere"
    tells_frames = True

    def _configuration(self) -> dict[str, tuple[Any, str]]:
        camera = self.rig.require_camera()
        identity = camera.describe()
        configuration = {
            "exposure_s": (self.exposure_s, "s"),
            "serial_number": (identity.serial_number, ""),
            "model": (identity.model, ""),
        }
        gain_db = None if camera.configured is None else camera.configured.gain_db
        return configuration | ({} if gain_db is None else {"gain_db": (gain_db, "dB")})

    def configure(self, values: dict[str, float]) -> tuple[Readings, Readings]:
        """Change the exposure (`exposure_s`); returns the configuration before and after."""
        before = self.read_configuration()
        if unknown := values.keys() - {"exposure_s"}:
            raise AcquisitionError(f"{self.name} has no setting {', '.join(sorted(unknown))}, only exposure_s.")
        with self.turn:
            self.change_exposure(values.get("exposure_s", self.exposure_s))
        return before, self.read_configuration()

    def change_exposure(self, exposure_s: float) -> None:
        """Set the exposure of the next frames, as the camera takes it."""
        self.exposure_s = self.rig.set_exposure(exposure_s, 1).exposure_s or exposure_s

    def stage(self) -> list[BlueskyDevice]:
        """Set the exposure, let light through."""
        with self.turn:
            self.rig.show(self.sample)
            self.rig.set_exposure(self.exposure_s, 1)
            if self.rig.source is not None:
                self.rig.source.set_light(True)
        return [self]

    def unstage(self) -> list[BlueskyDevice]:
        """Shut the light."""
        if self.rig.source is not None:
            self.rig.source.set_light(False)
        return [self]

    @property
    def hints(self) -> dict[str, Any]:
        """What live tables show."""
        return {"fields": [f"{self.name}_mean"]}

    def trigger(self) -> MoveStatus:
        """Take one frame."""

        def expose() -> None:
            with self.turn:
                self.frame = self.rig.require_camera().capture(1)[0].pixels
                if self._writes_files:
                    self._path = write_frame(Path(self.folder or ""), self.name, self.frame, self.exposure_s)

        return in_background(expose)

    @property
    def _writes_files(self) -> bool:
        return self.tells_frames and self.folder is not None

    def read(self) -> Readings:
        """The frame that was taken last, unless it is in a file, and its mean in counts."""
        has_frame = self.tells_frames and not self._writes_files
        frame = {f"{self.name}_frame": self.frame} if has_frame else {}
        return readings(frame | {f"{self.name}_mean": float(self.frame.mean())})

    def describe(self) -> Readings:
        """Shapes and units."""
        settings = self.rig.require_camera().settings
        shape = (settings.height or 0, settings.width or 0)
        keys = {f"{self.name}_mean": data_key("camera, mean of the frame", (), "count")}
        if self._writes_files:
            keys[f"{self.name}_frame"] = external_key(data_key("camera, counts (1, row, column)", (1, *shape), "count"))
        elif self.tells_frames:
            keys[f"{self.name}_frame"] = data_key("camera, counts (row, column)", shape, "count")
        return keys

    def collect_asset_docs(self, index: int | None = None) -> Documents:
        """Where the frame that was taken last is."""
        if self._writes_files:
            yield from asset_documents(f"{self.name}_frame", self._path, FRAME, (1, *self.frame.shape))
