"""Where each pixel looks: camera, shapes, scattering angles."""
