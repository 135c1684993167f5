"""The border that campaigns leave out is as wide as the default demosaicing reaches."""

from processing import campaign, material_fit_images
from processing.mosaic.methods import REACH
from processing.reduce_stokes import DEFAULT_METHOD


def test_campaigns_leave_out_what_demosaicing_mixes() -> None:
    assert campaign.BORDER_PX == material_fit_images.BORDER_PX == REACH[DEFAULT_METHOD]
