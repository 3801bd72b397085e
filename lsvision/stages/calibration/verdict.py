"""The verdict on a calibration: one word for what its n is worth, and the sentences that say why."""

from collections.abc import Sequence
from dataclasses import dataclass

from lsvision.types import Observability, Verdict

# The calibration weighs corners by their covariance, the RMSE does not: it may rise by a little where n is nominal.
_RMSE_GROWTH = 1.1
# The contradiction that errors along the scan are none that the sigma of n allows for.
UNLIKE = (
    "the lines are displaced by errors that are no steady vibration and no encoder error that all scans share: "
    "look for a scan that shook far more than the others, a jolt or a slip"
)


@dataclass(frozen=True)
class Judgement:
    """A verdict and its reasons; a ``determined`` calibration needs none."""

    verdict: Verdict
    reasons: tuple[str, ...] = ()


def judge(not_settled: str | None, contradictions: Sequence[str], observability: Observability) -> Judgement:
    """The verdict on a calibration.

    That the estimate did not settle comes first: boards cannot be said to contradict a result that is none. Which scan
    would show more is said only where nothing contradicts: another scan mends neither a wrong board nor a wrong speed.

    Args:
        not_settled: the sentence that says so; None where the estimate converged.
        contradictions: sentences, one for each way in which the boards contradict each other, the options or the
            model.
    """
    unseen = () if observability.determined or contradictions else (observability.advice,)
    reasons = (*(() if not_settled is None else (not_settled,)), *contradictions, *unseen)
    if not_settled is not None:
        return Judgement("not converged", reasons)
    if contradictions:
        return Judgement("inconsistent", reasons)
    return Judgement("prior-dominated", reasons) if unseen else Judgement("determined")


def not_settled(converged: bool, iterations: int) -> str | None:
    """The sentence about an estimate that did not settle; None for one that did."""
    return None if converged else f"the estimate had not settled after {iterations} iterations"


def rmse_grew(before_mm: float, after_mm: float) -> list[str]:
    """The contradiction that the calibrated motion fits the boards worse than the nominal one, or nothing."""
    if after_mm <= _RMSE_GROWTH * before_mm:
        return []
    return [
        f"the RMSE grew from {before_mm:.4g} to {after_mm:.4g} mm: no motion makes these corners the stated board; "
        "check its squares, the order of the images (left, right) and the rig"
    ]
