"""Absolute scale of a Mueller image: counts of a white plaque with a certificate, taken on the same bench."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import NamedTuple

import numpy as np
from pydantic import Field

from processing.arrays import Array
from processing.doors import one_line, read_text
from processing.errors import ProcessError
from processing.geometry.frames import GeometryImage, dot
from processing.geometry.viewing import ViewingGeometry
from processing.section import FiniteSection
from processing.storage.products.product import Product
from processing.yaml_file import load_yaml

#: Name of this input among those that are uncertain.
SCALE = "absolute scale"


class Certified(FiniteSection):
    """Reflectance factor at one wavelength: radiance over that of a perfect diffuser, for unpolarized light."""

    value: float = Field(gt=0, description="reflectance factor")
    u: float = Field(ge=0, description="its standard uncertainty, k = 1")


class Certificate(FiniteSection):
    """What a calibration laboratory states of a white plaque."""

    incidence_deg: float = Field(ge=0, lt=90, description="angle of incidence, degrees")
    viewing_deg: float = Field(ge=0, lt=90, description="viewing angle, degrees")
    tolerance_deg: float = Field(default=1.0, gt=0, description="how far both angles of a capture may be off, degrees")
    reflectance: dict[float, Certified] = Field(description="by wavelength in nm")

    @classmethod
    def load(cls, path: Path) -> Certificate:
        """Read YAML, or CSV with the columns wavelength_nm, reflectance, u, incidence_deg, viewing_deg.

        Raises ProcessError: the file is neither.
        """
        if path.suffix.lower() != ".csv":
            return load_yaml(path, cls)
        text = read_text(path)
        try:
            rows = [{k: float(v) for k, v in row.items()} for row in csv.DictReader(text.splitlines())]
            (angles,) = {(row["incidence_deg"], row["viewing_deg"]) for row in rows}
            values = {row["wavelength_nm"]: Certified(value=row["reflectance"], u=row["u"]) for row in rows}
            return cls(incidence_deg=angles[0], viewing_deg=angles[1], reflectance=values)
        except (KeyError, TypeError, ValueError) as error:
            raise ProcessError(
                f"{path} cannot be read as a certificate ({one_line(error)}). Give the columns wavelength_nm, "
                "reflectance, u, incidence_deg and viewing_deg, with one pair of angles."
            ) from error


class WhiteReference(NamedTuple):
    """Scale of one camera under one source.

    Attributes
    ----------
    brdf : BRDF in 1/sr that makes one count a second at normal incidence.
    u : its standard uncertainty over itself.
    alike : wavelength, detector, flat and origin that a sample has to share.
    """

    brdf: float
    u: float
    alike: tuple[object, ...]

    @classmethod
    def of(cls, plaque: Path, geometry_file: Path, certificate_file: Path) -> WhiteReference:
        """From a Mueller product of the plaque, averaged over all of its good pixels.

        The uncertainty has that of the certificate, and the spread of the pixels: the light is not uniform. Raises
        ProcessError: exposure, wavelength or geometry of the plaque are unknown or not those of the certificate.
        """
        certificate = Certificate.load(certificate_file)
        with Product(plaque) as product:
            product.require("mueller")
            exposure, nm = exposure_of(product), product.header.wavelength_nm
            entries = [c for key, c in certificate.reflectance.items() if abs(key - nm) <= 0.5]
            if not entries:
                stated = ", ".join(f"{key:g}" for key in certificate.reflectance)
                raise ProcessError(f"{certificate_file} is for {stated} nm and {plaque} at {nm:g} nm.")
            if product.header.omega_deg is None:
                raise ProcessError(f"{plaque}: the capture does not say its arm angle.")
            image = ViewingGeometry.load(geometry_file).at(product.header.omega_deg, *product.shape)
            good = (product.get("pixel_flags")[image.mask] == 0) if image.mask.any() else np.zeros(0, dtype=bool)
            if not good.any():
                raise ProcessError(f"{plaque}: no good pixel sees the plaque. Check {geometry_file}.")
            m00 = product.get("mueller")[0, 0][image.mask][good].astype(float)
            noise = product.get("mueller_errors")[0, 0][image.mask][good].astype(float)
            alike = _conditions(product)
        points = image.points[good]
        cosines = dot(points.normal, points.to_source), dot(points.normal, points.to_camera)
        for name, cosine in zip(("incidence_deg", "viewing_deg"), cosines, strict=True):
            angle, stated_deg = float(np.rad2deg(np.arccos(cosine.mean()))), getattr(certificate, name)
            if abs(angle - stated_deg) > certificate.tolerance_deg:
                raise ProcessError(
                    f"{plaque} has {name} {angle:.1f} and {certificate_file} {stated_deg:g}. Take the plaque in the "
                    "geometry of its certificate."
                )
        # Of each pixel, for light along its normal.
        level = m00 / cosines[0] / exposure
        spread = np.var(level) - np.nanmean(np.square(noise / cosines[0] / exposure))
        brdf, of_certificate = entries[0].value / np.pi / level.mean(), entries[0].u / entries[0].value
        return cls(brdf, float(np.sqrt(of_certificate**2 + max(spread, 0.0) / level.mean() ** 2)), alike)

    def factor(self, product: Product, image: GeometryImage) -> Array:
        """BRDF in 1/sr of one count in each pixel (N,) of an object.

        Raises ProcessError: the product was not taken and reduced like the plaque, or does not know its exposure.
        """
        names = ("wavelength", "detector", "flat field", "origin (simulated or measured)")
        differ = [n for n, a, b in zip(names, self.alike, _conditions(product), strict=True) if a != b]
        if differ:
            raise ProcessError(f"{product.path} and the white reference differ in: {', '.join(differ)}.")
        cosine = dot(image.points.normal, image.points.to_source)
        return np.asarray(self.brdf / exposure_of(product) / cosine)


def exposure_of(product: Product) -> float:
    """Seconds in which the counts of a Mueller product are collected. Raises ProcessError where it is not known."""
    exposure = product.facts.get("exposure_s")
    if exposure is None:
        raise ProcessError(
            f"{product.path} does not say its exposure, so it has no absolute scale. Reduce the capture again; if "
            "that does not help, the capture has no exposure_s."
        )
    return float(exposure)


def _conditions(product: Product) -> tuple[object, ...]:
    header = product.header
    return round(header.wavelength_nm), header.detector, product.facts["flat"] != "none", product.simulated
