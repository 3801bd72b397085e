"""What the corners say of themselves beside n, in sentences: contradictions, their causes, and corners left out."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.estimation import chi_square_tail
from lsvision.stages.calibration.along_scan import COMPONENTS
from lsvision.stages.calibration.causes import NONE, Candidate, candidates
from lsvision.stages.calibration.departure_fit import fit
from lsvision.stages.calibration.departures import KINDS, ReducedCorners, placement
from lsvision.stages.calibration.hypotheses import Assumed, Explanation, explain
from lsvision.stages.calibration.misplaced import doubts, left_out
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.types import BoardCorners

# A misfit that chance brings less often than this is looked into.
_LOOKED_INTO = 1e-2
# One that chance brings less often than this is a contradiction even where no cause is found.
_CONTRADICTION = 1e-6


@dataclass(frozen=True)
class Findings:
    """``contradictions`` make a calibration inconsistent; ``notes`` do not, nor does ``shake``, of errors of lines."""

    contradictions: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    shake: tuple[str, ...] = ()


def find_flaws(
    boards: Sequence[BoardCorners],
    problem: BoardProblem,
    start: Tensor,
    outlying: Tensor,
    assumed: Assumed,
    shaken: bool,
) -> Findings:
    """What the corners of one problem say of themselves.

    Args:
        problem: of batch shape (), without outlying corners. start: its state.
        outlying: ``(boards, corners)``, the corners left out.
        shaken: whether errors along the scan were found.
    """
    between = contradictions_between(problem, start, [board.scan for board in boards], assumed, shaken)
    off = [left_out(board, outlying[i, : len(board.valid)]) for i, board in enumerate(boards)]
    return Findings((*doubts(off, True), *between.contradictions), doubts(off, False), between.shake)


def contradictions_between(
    problem: BoardProblem, start: Tensor, scans: Sequence[str], assumed: Assumed, shaken: bool
) -> Findings:
    """Whether the boards of one problem fit one motion and the stated board, and what explains it where they do not.

    Of planar boards alone; others are taken to fit.
    """
    if bool(problem.body_points[..., 2].any()):
        return Findings()
    only = problem.at((None,))  # a batch of one
    reduced, at = ReducedCorners.of(only).scaled(), placement(problem, start).expanded((1,))
    plain = fit(reduced, at, assumed.hypothesis(at), assumed.motion_sigma)
    freedom = float(problem.boards * (reduced.smooth_freedom - 6) - 3)
    if not shaken and float(chi_square_tail(plain.chi_square, freedom)) > _LOOKED_INTO:
        return Findings()
    explanation = explain(only, reduced, at, assumed)
    words = _Words(scans, candidates(problem.boards, reduced.curved, at.n), explanation, _square_mm(problem))
    causes = words.causes()
    if float(chi_square_tail(explanation.chi_square, freedom)) < _CONTRADICTION:
        causes = (*causes, _unexplained(float(explanation.chi_square), freedom, bool(causes)))
    return Findings(causes, shake=words.shake())


@dataclass(frozen=True)
class _Words:
    """An explanation of one problem put into words."""

    scans: Sequence[str]
    candidates: Sequence[Candidate]
    explanation: Explanation
    square_mm: float

    def causes(self) -> tuple[str, ...]:
        """A sentence of each cause."""
        numbers = [number for number in self.explanation.causes[:, 0].tolist() if number != NONE]
        return tuple(self._cause(self.candidates[number], first=i == 0) for i, number in enumerate(numbers))

    def shake(self) -> tuple[str, ...]:
        """The sentence on what all corners of a line share."""
        (errors,) = self.explanation.along_scan
        if errors is None:
            return ()
        rms = errors.rms_mm
        size = f"about {float(rms.max()):.1g} mm"
        if COMPONENTS[int(rms.argmax())] == "travel":
            return (f"the travel of the lines is wrong by {size}: the encoder does not agree with the board's rows",)
        return (
            f"the corners of each line are displaced together by {size}: the object shakes or does not run straight",
        )

    def _cause(self, cause: Candidate, first: bool) -> str:
        kind = KINDS.index(cause.kind) if cause.kind in KINDS else KINDS.index("bend_xx")
        departure = self.explanation.departure[0, :, kind]
        covariance = self.explanation.covariance[0, kind]
        if cause.kind == "scale":
            sentence = self._scale(float(departure[0]), math.sqrt(float(covariance[0, 0])))
        elif cause.kind == "bend":
            sentence = self._bend()
        else:
            sentence = self._motion(cause, departure, covariance)
        rivals = self._rivals(cause) if first else []
        return f"{sentence} (or {', or '.join(rivals)})" if rivals else sentence

    def _scale(self, scale: float, sigma: float) -> str:
        value, digits = _with_sigma(100 * abs(scale), 100 * sigma)
        how = "larger" if scale > 0 else "smaller"
        measure = f"{self.square_mm * (1 + scale):.4g} mm"
        return (
            f"the board looks {value} ± {digits} % {how} than its {self.square_mm:g} mm squares: they measure {measure}"
        )

    def _bend(self) -> str:
        height = self.explanation.departure[0, 0, KINDS.index("bend_xx") :]
        largest = int(height.abs().argmax())
        where = ("along its longer side", "across its diagonals", "along its shorter side")[largest]
        return f"the board is not flat: it is bent by {abs(float(height[largest])):.3g} mm {where}"

    def _motion(self, cause: Candidate, departure: Tensor, covariance: Tensor) -> str:
        """Of one scan against all others, or of all scans against the first."""
        if cause.scan != NONE:
            others = [scan for i, scan in enumerate(self.scans) if i != cause.scan]
            sigma = math.sqrt(float(covariance[cause.scan, cause.scan]))
            moved = _moved(cause.kind, float(departure[cause.scan]), sigma)
            return f"scan {self.scans[cause.scan]} {moved} than {_listed(others)}"
        difference, variance = _against_first(cause.kind, departure, covariance)
        each = [
            f"scan {scan} {_moved(cause.kind, float(value), math.sqrt(max(float(v), 0.0)))}"
            for scan, value, v in zip(self.scans[1:], difference[1:], variance[1:], strict=True)
        ]
        return f"{', '.join(each)} than {self.scans[0]}"

    def _rivals(self, cause: Candidate) -> list[str]:
        """Other kinds of causes that would have served nearly as well."""
        kinds: dict[str, str] = {}
        for number in self.explanation.rivals[:, 0].nonzero().flatten().tolist():
            rival = self.candidates[number]
            if rival.kind != cause.kind and rival.kind not in kinds:
                whose = "the scans" if rival.scan == NONE else f"scan {self.scans[rival.scan]}"
                kinds[rival.kind] = _RIVALS[rival.kind].format(whose)
        return list(kinds.values())


_RIVALS = {
    "speed": "{} ran at another speed",
    "sideways": "{} drifted sideways",
    "depth": "{} drifted in depth",
    "scale": "the squares have another size",
    "bend": "the board is not flat",
}


def _moved(kind: str, value: float, sigma: float) -> str:
    if kind == "speed":
        size, digits = _with_sigma(100 * abs(value), 100 * sigma)
        return f"ran {size} ± {digits} % {'faster' if value > 0 else 'slower'}"
    size, digits = _with_sigma(1000 * abs(value), 1000 * sigma)
    where = {"sideways": "sideways", "depth": "in depth"}[kind]
    return f"drifts {size} ± {digits} mm per metre {'more' if value > 0 else 'less'} {where}"


def _against_first(kind: str, departure: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Departures of all scans relative to that of the first, and their variances; speeds by their ratio."""
    if kind != "speed":
        return departure - departure[0], covariance.diagonal() + covariance[0, 0] - 2 * covariance[0]
    ratio = (1 + departure) / (1 + departure[0])
    variance = covariance.diagonal() + ratio.square() * covariance[0, 0] - 2 * ratio * covariance[0]
    return ratio - 1, variance / (1 + departure[0]).square()


def _with_sigma(value: float, sigma: float) -> tuple[str, str]:
    """A value and its sigma to the sigma's first digit."""
    digits = max(0, min(6, -math.floor(math.log10(sigma)))) if sigma > 0 else 6
    return f"{value:.{digits}f}", f"{sigma:.{digits}f}"


def _listed(names: Sequence[str]) -> str:
    """Names as a list, the longer ones by their number."""
    if len(names) > 3:
        return f"the other {len(names)} scans"
    return " and ".join([", ".join(names[:-1]), names[-1]]) if len(names) > 1 else names[0]


def _unexplained(chi_square: float, freedom: float, partly: bool) -> str:
    what = "what is left of the misfit" if partly else "the scans contradict each other: the misfit"
    return (
        f"{what} has a chi-square of {chi_square:.0f} where {freedom:.0f} is expected, and no single cause explains it"
    )


def _square_mm(problem: BoardProblem) -> float:
    """The board's stated spacing: the smallest distance of a corner from the first."""
    away = torch.linalg.vector_norm(problem.body_points[0] - problem.body_points[0, :1], dim=-1)
    return float(away[away > 1e-6].min())
