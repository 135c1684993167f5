"""Mitsuba's side of benchmarks/renderer_check.py: runs in an environment that has mitsuba.

Reads one JSON line a question: "bsdf" (dictionary), "wavelength_nm", and the files "to_source", "to_camera" and "out",
and writes M (N, 4, 4) and the reference axes x_in, x_out (N, 3) of its Stokes vectors.
"""

from __future__ import annotations

import json
import sys

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_spectral_polarized")


def evaluate(question: dict[str, object]) -> None:
    bsdf = mi.load_dict(question["bsdf"])
    to_source, to_camera = np.load(question["to_source"]), np.load(question["to_camera"])
    m, x_in, x_out = (np.empty((len(to_source), *shape)) for shape in ((4, 4), (3,), (3,)))
    context, si = mi.BSDFContext(mi.TransportMode.Radiance), mi.SurfaceInteraction3f()
    si.sh_frame = mi.Frame3f([0, 0, 1])
    si.wavelengths = [float(question["wavelength_nm"])] * 4
    for k, (source, camera) in enumerate(zip(to_source, to_camera, strict=True)):
        # Its paths start at the camera: wi looks back to it, wo goes on to the light.
        si.wi = camera
        value = bsdf.eval(context, si, mi.Vector3f(source))
        m[k] = [[value[i, j][0] for j in range(4)] for i in range(4)]
        x_in[k], x_out[k] = mi.mueller.stokes_basis(-mi.Vector3f(source)), mi.mueller.stokes_basis(mi.Vector3f(camera))
    np.savez(question["out"], m=m, x_in=x_in, x_out=x_out)


print(json.dumps({"mitsuba": mi.__version__}), flush=True)
for line in sys.stdin:
    evaluate(json.loads(line))
    print(json.dumps({"done": True}), flush=True)
