"""NeXus and netCDF conventions in our HDF5 files: classes, units, dimension scales, the default plot.

A dimension scale (HDF5) gives a dimension its name and its coordinate, so that xarray and any netCDF reader sees
(state, channel, y, x). The attributes of NXdata (signal, axes, NAME_indices) say the same to NeXus readers.
"""

from collections.abc import Mapping, Sequence

import h5py
import numpy as np

#: Nearest application definition, and the release of the definitions that it was read in.
DEFINITION = "NXoptical_spectroscopy"
DEFINITION_VERSION = "v2026.01"
DEFINITION_URL = f"https://manual.nexusformat.org/classes/applications/{DEFINITION}.html"
#: The two dimensions of a picture; the first pixel of the first row is (0, 0).
PIXEL_AXES = ("y", "x")
LONG_NAMES = {
    "state": "number of the state in the plan",
    "channel": "number of the channel; channel_name has its name",
    "y": "row of the picture, from the top",
    "x": "column of the picture, from the left",
    "row": "row of the Mueller matrix",
    "column": "column of the Mueller matrix",
    "quantity": "number of the quantity; quantity_name has its name",
}
_PIXEL = "pixel"


def add_group(parent: h5py.Group, name: str, nx_class: str) -> h5py.Group:
    """A new group of a NeXus class."""
    group = parent.create_group(name)
    group.attrs["NX_class"] = nx_class
    return group


def declare(entry: h5py.Group) -> None:
    """Say which application definition an entry follows, and what kind of experiment it is."""
    entry["definition"] = DEFINITION
    entry["definition"].attrs.update({"version": DEFINITION_VERSION, "URL": DEFINITION_URL})
    # The definition names spectroscopies and lets others be named, if they say that they are others.
    entry["experiment_type"] = "polarimetry"
    entry["experiment_type"].attrs["custom"] = True
    entry["experiment_sub_type"] = "imaging"


def describe_light(entry: h5py.Group, wavelength_nm: float, sample: str) -> h5py.Group:
    """Add instrument, beam, detector and sample with what the definition asks for; returns the instrument."""
    instrument = add_group(entry, "instrument", "NXinstrument")
    beam = add_group(instrument, "beam_light", "NXbeam")
    beam["incident_wavelength"] = float(wavelength_nm)
    beam["incident_wavelength"].attrs["units"] = "nm"
    beam["parameter_reliability"] = "nominal"
    add_group(instrument, "detector", "NXdetector")["detector_channel_type"] = "multichannel"
    # The definition wants a name behind "detector_"; programs know the short one.
    instrument["detector_camera"] = h5py.SoftLink(f"{instrument.name}/detector")
    instrument["detector"].attrs["target"] = f"{instrument.name}/detector"
    add_group(entry, "sample", "NXsample")["name"] = sample
    return instrument


def add_scales(group: h5py.Group, sizes: Mapping[str, int]) -> None:
    """Add a dimension scale 0, 1, 2, ... for each name."""
    for name, size in sizes.items():
        scale = group.create_dataset(name, data=np.arange(size, dtype=float if name in PIXEL_AXES else int))
        scale.make_scale(name)
        scale.attrs["units"] = _PIXEL if name in PIXEL_AXES else ""
        scale.attrs["long_name"] = LONG_NAMES.get(name, f"number along {name}")


def attach(dataset: h5py.Dataset, scales: h5py.Group, names: Sequence[str]) -> None:
    """Name the first dimensions of a dataset by scales of a group."""
    for dimension, name in zip(dataset.dims, names, strict=False):
        dimension.attach_scale(scales[name])


def default_plot(data: h5py.Group, signal: str, axes: Sequence[str], title: str) -> None:
    """Make a group the plot that viewers show first: its signal over its axes, under a title."""
    data["title"] = title
    data.attrs.update({"signal": signal, "axes": list(axes)})
    for position, name in enumerate(axes):
        data.attrs[f"{name}_indices"] = position


def link_coordinate(data: h5py.Group, name: str, target: str, dimension: int) -> None:
    """Show a dataset of elsewhere in a plot, as a further coordinate along one dimension of the signal."""
    data[name] = h5py.SoftLink(target)
    data[name].attrs["target"] = target
    data.attrs[f"{name}_indices"] = dimension
