"""The border that campaigns leave out is as wide as the default demosaicing reaches."""

from processing.campaign import run as campaign
from processing.maps import material_fit as material_fit_images
from processing.reduction.mosaic.demosaic import method_of
from processing.reduction.stokes import DEFAULT_METHOD


def test_campaigns_leave_out_what_demosaicing_mixes() -> None:
    assert campaign.BORDER_PX == material_fit_images.BORDER_PX == method_of(DEFAULT_METHOD).reach
