"""The next experiment: expected evidence against recordings that are then really made."""

from __future__ import annotations

import gap_sets
import numpy as np
import pytest

from frictid_hil.gap.diagnose import diagnose
from frictid_hil.gap.next_experiment import _evidence
from frictid_hil.gap.posterior import Known


def test_expected_evidence_is_the_mean_log_odds_of_recordings_that_are_drawn() -> None:
    random = np.random.default_rng(3)
    rows, floor = 40, 0.7
    x_first, x_second = random.standard_normal((rows, 2)), random.standard_normal((rows, 1))
    first = Known((), np.array([0.6, -0.3]), np.diag([0.3, 0.1]))
    second = Known((), np.array([0.4]), np.array([[0.2]]))

    def log_density(y: np.ndarray, x: np.ndarray, known: Known) -> np.ndarray:
        covariance = x @ known.root @ known.root.T @ x.T + floor**2 * np.eye(rows)
        rest = y - x @ known.mean
        square = np.einsum("ni,ni->n", rest, np.linalg.solve(covariance, rest.T).T)
        return -0.5 * (square + np.linalg.slogdet(covariance)[1])

    odds = []
    for x, known, sign in ((x_first, first, 1.0), (x_second, second, -1.0)):
        drawn = known.mean + random.standard_normal((4000, known.mean.size)) @ known.root.T
        y = drawn @ x.T + floor * random.standard_normal((4000, rows))
        odds.append(sign * (log_density(y, x_first, first) - log_density(y, x_second, second)))
    told = _evidence(x_first, first, x_second, second, floor)
    assert told == pytest.approx(float(np.mean(odds)), rel=0.05)


@pytest.mark.slow
def test_a_known_load_is_what_parts_a_wrong_friction_from_a_wrong_torque_constant() -> None:
    faulty = {"friction_level_error": {"error_share": 0.15}}
    found = diagnose(gap_sets.make(faulty, only=("sines_small",)))
    assert found.verdict == "ambiguous" and found.next_experiment is not None
    assert set(found.next_experiment.separates) == {"friction_level_error", "torque_constant_error"}
    (asked,) = found.next_experiment.plan["experiments"]
    assert asked in ("sines_payload", "chirp_payload") and "20 to 1" in found.next_experiment.description
    # It keeps its word: with that recording the level stands out and the torque constant does not.
    then = {c.effect: c for c in diagnose(gap_sets.make(faulty, only=("sines_small", asked))).causes}
    gain = then.get("torque_constant_error")
    assert then["friction_level_error"].parameters["error_share"].low > 0.1
    assert gain is None or abs(gain.parameters["error_share"].value) < 0.02
