"""Headings of `process --help`: what its commands are for, in the order of the work."""

DATA = "Bring data in"
IMAGES = "Images and quantities"
CALIBRATION = "Calibrate and design"
REFLECTANCE = "Reflectance"
REPORTS = "Campaigns and reports"
EXPORT = "Write for other programs"
#: Commands that come first in their list, as they are used; the others follow by name.
FIRST = ("init", "import", "reduce", "quantities", "mean", "check", "calibrate", "fit-material", "campaign", "export")
#: In this order.
PURPOSES = (DATA, IMAGES, CALIBRATION, REFLECTANCE, REPORTS, EXPORT)
