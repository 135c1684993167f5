"""The public interface: every name is there, five lines to a Mueller image, xarray in and out."""

import inspect
import re
import runpy
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import acquisition
import processing
import umov
from processing.errors import ProcessError
from tests.rig_files import write_rig


@pytest.mark.parametrize("package", [processing, acquisition], ids=lambda p: p.__name__)
def test_every_public_name_is_there_and_documented(package):
    assert len(package.__all__) > 5
    for name in package.__all__:
        thing = getattr(package, name)
        if inspect.isclass(thing) or inspect.isfunction(thing):
            assert thing.__doc__, name
    assert dir(package) == package.__all__
    with pytest.raises(AttributeError, match="has no public name 'nonsense'"):
        _ = package.nonsense


@pytest.mark.parametrize("package", [processing, acquisition], ids=lambda p: p.__name__)
def test_every_public_name_is_on_the_page_of_its_package(package):
    root = Path(__file__).parents[2]
    page = (root / f"docs/api-{package.__name__}.md").read_text(encoding="utf-8")
    shown = runpy.run_path(str(root / ".ci/names.py"))["on_page_markdown"](page)
    for name in package.__all__:
        assert f"::: {package._PUBLIC[name]}.{name}" in shown
        assert f"| [`{name}`]" in shown


def test_importing_a_package_loads_nothing_heavy():
    code = "import sys, processing, acquisition; print({'numba', 'scipy', 'xarray', 'h5py'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


@pytest.fixture(scope="module")
def capture(configs, tmp_path_factory):
    """Taken with the ten lines of the docstring."""
    from acquisition import MeasurementPlan, load_rig, take_capture

    folder = tmp_path_factory.mktemp("interface")
    plan = MeasurementPlan(omega_deg=35, wavelength_nm=662)
    return take_capture(plan, load_rig(write_rig(configs, folder / "rig.yaml")), folder / "captures")


def test_from_capture_to_labelled_mueller_image_and_back(capture, tmp_path):
    from processing import Capture, MuellerImage, Product, Reduction, open_dataset, reduce_to_dataset, write_dataset

    image = reduce_to_dataset(capture)
    assert image.mueller.dims == ("row", "column", "y", "x")
    assert image.mueller.units == image.mueller_errors.units == "count"
    assert (image.attrs["kind"], image.attrs["simulated"]) == ("mueller", 1)
    # File names may come as text, as glob gives them.
    file = MuellerImage.load(Reduction(str(capture)).make(str(tmp_path / "m.h5")))
    np.testing.assert_array_equal(image.mueller.values, file.values)
    raw = open_dataset(capture)
    assert raw.counts.dims == ("state", "channel", "y", "x")
    light = raw.where(raw.role == "sample", drop=True)
    assert light.psa_deg.values % 360 == pytest.approx(4.91 * 9 * np.arange(40) % 360, abs=0.01)
    copied = write_dataset(raw, tmp_path / "copy.h5")
    copy = reduce_to_dataset(copied)
    np.testing.assert_array_equal(copy.mueller.values, image.mueller.values)
    with pytest.raises(ProcessError, match="exists and is not replaced"):
        write_dataset(raw, copied)
    with Capture(capture) as opened, Product(tmp_path / "m.h5") as product:
        for ask in (opened.column, product.get, product.units, product.array):
            with pytest.raises(ProcessError, match=r"has no .*'nonsense'"):
                ask("nonsense")
        with pytest.raises(IndexError):
            opened.frames(99)
    with pytest.raises(ProcessError, match="dimensions"):
        write_dataset(raw.drop_vars("counts"), tmp_path / "none.h5")


def test_a_campaign_is_one_array_over_angle_and_wavelength(capture, tmp_path):
    folder = tmp_path / "products"
    folder.mkdir()
    first = umov.Reduction(capture).make(folder / "a.h5")
    shutil.copy(first, folder / "b.h5")
    changed = umov.open_dataset(capture)
    changed.attrs["header"] = changed.attrs["header"].replace('"omega_deg":35.0', '"omega_deg":50.0')
    umov.Reduction(umov.write_dataset(changed, tmp_path / "at_50.h5")).make(folder / "c.h5")
    stack = umov.open_campaign(folder)
    assert stack.mueller.dims == ("sample", "wavelength", "omega", "repeat", "row", "column", "y", "x")
    assert stack.omega.values.tolist() == [35, 50]
    assert stack.sizes["repeat"] == 2
    image = umov.open_dataset(first).mueller.values
    at_35 = stack.mueller.sel(omega=35, wavelength=662).isel(sample=0, repeat=1)
    np.testing.assert_array_equal(at_35.values, image)
    region = stack.mueller.isel(y=slice(20, 30), x=[3, 5, 40], repeat=0, sample=0, wavelength=0).sel(row=1, column=1)
    np.testing.assert_array_equal(region.values[0], image[1, 1, 20:30][:, [3, 5, 40]])
    # The second repeat was measured at one angle only.
    assert np.isnan(stack.mueller.sel(omega=50).isel(repeat=1, row=0, column=0, y=7).values).all()
    with pytest.raises(ProcessError, match="no product of kind 'stokes'"):
        umov.open_campaign(folder, "stokes")


def test_the_docstrings_run_as_they_stand(small_rig, default_rig, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    default_rig(small_rig())
    blocks = {}
    for package in (acquisition, processing):
        lines = (package.__doc__ or "").splitlines()
        blocks[package.__name__] = "\n".join(line[4:] for line in lines if line.startswith("    ") or not line.strip())
    exec(compile(blocks["acquisition"], "acquisition", "exec"), {})
    capsys.readouterr()
    exec(compile(blocks["processing"], "processing", "exec"), {})
    assert "[[" in capsys.readouterr().out


def test_a_diagnosis_takes_names_of_files_as_text_and_refuses_none(tmp_path):
    from processing import InstrumentModel, diagnose_captures

    model = InstrumentModel.load(acquisition.CONFIGS / "instruments" / "rgb950.yaml")
    with pytest.raises(ProcessError, match="no capture"):
        diagnose_captures([], model)
    with pytest.raises(ProcessError, match=re.escape("absent.h5")):
        diagnose_captures([str(tmp_path / "absent.h5")], model)
