"""Two nominal files, plates 40 to 260 degrees apart: the same M, the same signs, the same standard errors."""

import numpy as np
import pytest

from benchmarks import instrument_chain as chain

#: What no capture of air can show: the sign of circular light.
OTHER_SIGN = np.diag([1.0, 1.0, 1.0, -1.0])


@pytest.mark.long
@pytest.mark.parametrize(("instrument", "by_deg"), list(zip(chain.TWO_PLATES, (100, 80, 40, 260, 130), strict=True)))
def test_the_start_decides_nothing(instrument, by_deg, tmp_path):
    found = chain.two_starts(instrument, tmp_path, by_deg=by_deg)
    assert found.apart < 1
    assert found.same_signs
    assert found.ratio < 1.2
    assert found.mueller[0] == pytest.approx((chain.SAMPLE / chain.SAMPLE[0, 0]).ravel(), abs=0.02)
    assert found.branch is not None
    assert "The instrument file decides" in found.branch


@pytest.mark.long
def test_a_file_that_is_wrong_for_every_plate_decides_for_the_other_sign(tmp_path):
    found = chain.two_starts("rgb950", tmp_path, chain.PLATES)
    first, second = (m.reshape(4, 4) for m in found.mueller)
    assert OTHER_SIGN @ second @ OTHER_SIGN == pytest.approx(first, abs=3e-3)
    assert "row 3 and column 3 of M have the other sign" in found.branch
    assert found.ratio < 1.2
