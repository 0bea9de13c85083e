"""Cluster-robust least squares with few bunches: the intervals hold the truth as often as they say."""

import numpy as np
import pytest
from scipy.special import stdtrit

from frictid_hil.friction.clustered import solve

ROWS = 30


def drawn(random, bunches, few):
    """A level that every bunch sees and a slope that only the last ones see; rows of a bunch err together."""
    bunch = np.repeat(np.arange(bunches), ROWS)
    along = np.tile(np.linspace(0.0, 1.0, ROWS), bunches)
    x = np.column_stack([np.ones(bunch.size), along * (bunch >= bunches - few)])
    together = random.normal(size=(bunches, 1)) * np.linspace(0.5, 1.5, ROWS)
    y = x @ [2.0, 0.7] + together.ravel() + 0.3 * random.normal(size=bunch.size)
    return x, y, bunch


@pytest.mark.parametrize(("bunches", "few"), [(8, 3), (8, 8), (20, 4)])
def test_intervals_of_few_bunches_hold_the_truth_by_their_own_freedom(bunches, few):
    random, held, held_by_eight = np.random.default_rng(bunches + few), 0, 0
    for _ in range(400):
        x, y, bunch = drawn(random, bunches, few)
        solved = solve(x, y[:, None], bunch, [], "test")
        off = abs(solved.values[1] - 0.7) / np.sqrt(solved.covariance[1, 1])
        held += off < stdtrit(solved.freedom[1], 0.975)
        held_by_eight += off < stdtrit(8, 0.975)
    assert held / 400 > 0.91
    if few < 8:
        assert held_by_eight < held - 8, "a slope that three or four bunches saw has not eight degrees of freedom"


def test_freedom_is_that_of_the_bunches_that_saw_a_coefficient():
    random = np.random.default_rng(1)
    x, y, bunch = drawn(random, 24, 4)
    level, slope = solve(x, y[:, None], bunch, [], "test").freedom
    assert 15 < level < 24 and 1.5 < slope < 5


def test_two_groups_give_the_freedom_of_bell_and_mccaffrey():
    """Means of two groups of 3 and 12 single rows: Welch's freedom under equal variances, worked by hand."""
    group = np.repeat([0, 1], [3, 12])
    x = np.column_stack([np.ones(15), group])
    y = np.random.default_rng(2).normal(size=15)
    freedom = solve(x, y[:, None], np.arange(15), [], "test").freedom[1]
    a, b = 1 / 3, 1 / 12
    assert freedom == pytest.approx((a + b) ** 2 / (a**2 / 2 + b**2 / 11), rel=1e-6)
