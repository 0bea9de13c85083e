import numpy as np
import pytest

from frictid_hil.errors import IdentificationError
from frictid_hil.friction import trajectory
from frictid_hil.friction.onset import cycles_start_s
from frictid_hil.friction.trajectory import Procedure

P = Procedure(np.radians(20), np.radians(115))


@pytest.mark.parametrize("lead_s", [0.0, 0.4, 3.21])
def test_the_start_is_found_on_a_shifted_clock(lead_s):
    time = 100.0 + np.arange(0, lead_s + P.duration_s + 0.5, 0.001)
    path = 0.7 + trajectory.position(P, time - 100.0 - lead_s)
    path += 1e-5 * np.random.default_rng(1).normal(size=path.size)
    assert cycles_start_s(time, path, P) == pytest.approx(100.0 + lead_s, abs=2e-3)


def test_another_motion_is_refused():
    time = np.arange(0, 20, 0.001)
    for path in (np.zeros_like(time), 0.2 * np.sin(3 * time), 0.01 * time):
        with pytest.raises(IdentificationError, match="does not hold 10 cycles"):
            cycles_start_s(time, path, P)
