"""Cameras that play a GenICam description written here, feature by feature."""

from contextlib import ExitStack
from pathlib import Path

from drivers.cameras import aravis
from simulators.camera.exposure import PixelSource
from simulators.camera.genicam.formula import Number
from simulators.camera.gige_camera import GigeCamera
from simulators.clock import patient_clock

#: A description without features.
EMPTY = (
    '<?xml version="1.0" encoding="utf-8"?><RegisterDescription ModelName="List" VendorName="Public" '
    'StandardNameSpace="GEV" SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" '
    'MinorVersion="0" SubMinorVersion="0" ProductGuid="0" VersionGuid="0" '
    'xmlns="http://www.genicam.org/GenApi/Version_1_1"><Category Name="Root"></Category><Port Name="Device"/>'
    "</RegisterDescription>"
)


class DescribedCamera:
    """Plays the description with further features, and opens the driver on it."""

    def __init__(self, folder: Path, stack: ExitStack, text: str, size: tuple[int, int], source: PixelSource) -> None:
        self._path, self._stack = folder / "camera.xml", stack
        self._size, self._source = size, source
        self.text = text
        self._next = 0x0080_0000

    def add(
        self, name: str, node: str, access: str = "RW", kind: str = "IntReg", length: int = 4, index: str = ""
    ) -> None:
        """Add a feature: `node` is its element, in which VALUE stands for the register behind it."""
        self._next += 0x100
        sign = "<Sign>Unsigned</Sign>" if kind == "IntReg" else ""
        order = "" if kind == "StringReg" else "<Endianess>BigEndian</Endianess>"
        register = (
            f'<{kind} Name="{name}At"><Address>{self._next:#x}</Address>{index}<Length>{length}</Length><AccessMode>'
            f"{access}</AccessMode><pPort>Device</pPort><Cachable>NoCache</Cachable>{sign}{order}</{kind}>"
        )
        node = node.replace("VALUE", f"<pValue>{name}At</pValue>")
        self.text = self.text.replace("</Category>", f"<pFeature>{name}</pFeature></Category>", 1)
        self.text = self.text.replace("</RegisterDescription>", f"{node}{register}</RegisterDescription>")

    def choice(
        self, name: str, *entries: str, access: str = "RW", codes: dict[str, int] | None = None, index: str = ""
    ) -> None:
        """Add an enumeration; `codes` are values of entries that do not count from zero."""
        listed = "".join(
            f'<EnumEntry Name="{entry}"><Value>{(codes or {}).get(entry, k)}</Value></EnumEntry>'
            for k, entry in enumerate(entries)
        )
        self.add(name, f'<Enumeration Name="{name}">{listed}VALUE</Enumeration>', access, index=index)

    def flag(self, name: str, access: str = "RW") -> None:
        """Add a Boolean."""
        self.add(name, f'<Boolean Name="{name}">VALUE<OnValue>1</OnValue><OffValue>0</OffValue></Boolean>', access)

    def play(self, bits: int = 12, **features: Number | str) -> GigeCamera:
        """Start the camera, with the named features as another program left them."""
        self._path.write_text(self.text)
        camera = self._stack.enter_context(
            GigeCamera("LEFT-1", *self._size, self._source, description=self._path, bits=bits, complete=False)
        )
        for name, value in features.items():
            camera.leave(name, value)
        return camera

    def open(self, **config: object) -> aravis.AravisCamera:
        """Open the driver on it."""
        settings = aravis.Config(device="127.0.0.1", **config)  # type: ignore[arg-type]
        return self._stack.enter_context(aravis.open("camera", settings, patient_clock()))
