"""The verdict on a calibration, and the reasons that it gives."""

import pytest

from lsvision.stages.calibration.verdict import judge, not_settled, rmse_grew
from lsvision.types import Observability, ObservedDirection

SEEN = Observability((ObservedDirection((0.0, 0.0, 1.0), 0.05, 1e-4, True),), "n is determined")
UNSEEN = Observability((ObservedDirection((0.0, 0.0, 1.0), 0.05, 0.05, False),), "the boards do not show n3")


@pytest.mark.parametrize(
    ("converged", "contradictions", "observability", "verdict", "reasons"),
    [
        (True, [], SEEN, "determined", 0),
        (True, [], UNSEEN, "prior-dominated", 1),
        (True, ["scan b ran faster"], SEEN, "inconsistent", 1),
        (True, ["scan b ran faster"], UNSEEN, "inconsistent", 2),
        (False, ["scan b ran faster"], UNSEEN, "not converged", 3),
    ],
)
def test_the_worst_that_holds_is_the_verdict_and_all_reasons_are_given(
    converged, contradictions, observability, verdict, reasons
):
    judged = judge(not_settled(converged, 20), contradictions, observability)
    assert judged.verdict == verdict
    assert len(judged.reasons) == reasons
    assert set(contradictions) <= set(judged.reasons)


def test_a_larger_rmse_is_a_contradiction_beyond_what_the_weights_explain():
    assert rmse_grew(1.0, 1.05) == []
    (sentence,) = rmse_grew(3.5, 6.3)
    assert "grew from 3.5 to 6.3 mm" in sentence
