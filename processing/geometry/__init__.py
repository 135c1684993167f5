"""From pixels to scattering geometry: cameras, surfaces, instrument frames and Rusinkiewicz angles."""
