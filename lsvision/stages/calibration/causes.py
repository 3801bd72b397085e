"""Causes that may make boards contradict each other, as priors on their departures, and wanders of the scans."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.calibration.departures import KINDS, KNOTS

NONE = -1  # instead of the number of a scan or of a cause
# Prior sigma of each departure: relative speed; drift per mm; relative size; mm at the board's end.
_SIGMA = {"speed": 0.05, "sideways": 0.02, "depth": 0.02, "scale": 0.05, "bend": 0.3}
_AMPLITUDES_MM = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
_LENGTHS_KNOTS = (0.3, 1.0, 2.0, 4.0)
STILL_MM = 1e-5  # wander of the components that do not wander
_WHITE_SHARE = 1e-4  # of a wander's variance that is independent between knots: keeps its covariance invertible


@dataclass(frozen=True)
class Candidate:
    """A cause: departures of one kind, of one scan or of all of them (scan ``NONE``)."""

    kind: str
    scan: int
    pattern: Float[Tensor, "boards 7 parameters"]

    @property
    def sigma(self) -> Float[Tensor, " parameters"]:
        """Prior sigma of its parameters."""
        return self.pattern.new_full((self.pattern.shape[-1],), _SIGMA[self.kind])


@dataclass(frozen=True)
class Wander:
    """A wander of all scans: of x and z (``shake``) or of the travel (``encoder``), its rms and its length in knots."""

    kind: str
    amplitude_mm: float
    length_knots: float

    def information(self, like: Tensor) -> Float[Tensor, "knots3 knots3"]:
        """Inverse of the covariance of the knots' three components."""
        steps = torch.arange(KNOTS, dtype=like.dtype, device=like.device)
        eye = torch.eye(KNOTS).to(like)
        smooth = torch.exp(-((steps[:, None] - steps) / self.length_knots).square() / 2)
        wanders = torch.linalg.inv(self.amplitude_mm**2 * (smooth + _WHITE_SHARE * eye))
        still = eye / STILL_MM**2
        by_axis = [still, wanders, still] if self.kind == "encoder" else [wanders, still, wanders]
        joined = torch.einsum("ckl,cd->kcld", torch.stack(by_axis), torch.eye(3).to(like))
        return joined.reshape(3 * KNOTS, 3 * KNOTS)


def candidates(boards: int, curved: bool, like: Tensor) -> list[Candidate]:
    """The causes that are compared: of all scans alike, of all scans apart, and of each scan alone."""

    def pattern(kind: str, scan: int) -> Tensor:
        """A departure of every scan on its own, or that of one scan: ``(boards, kinds, 1 or boards)``."""
        empty = like.new_zeros(boards, len(KINDS), boards)
        for board in range(boards):
            empty[board, KINDS.index(kind), board] = 1.0
        return empty if scan == NONE else empty[..., scan : scan + 1]

    everywhere = like.new_zeros(boards, len(KINDS), 1)
    everywhere[:, KINDS.index("scale"), 0] = 1.0
    found = [Candidate("scale", NONE, everywhere)]
    if boards > 1:
        for kind in KINDS[:3]:
            found += [Candidate(kind, scan, pattern(kind, scan)) for scan in range(boards)]
            found += [Candidate(kind, NONE, pattern(kind, NONE))] if boards > 2 else []
    if curved:
        bend = like.new_zeros(boards, len(KINDS), 3)
        for k in range(3):
            bend[:, KINDS.index("bend_xx") + k, k] = 1.0
        found.append(Candidate("bend", NONE, bend))
    return found


def wanders(curved: bool) -> list[Wander]:
    """The wanders that are compared."""
    if not curved:
        return []
    grid = [(a, length) for a in _AMPLITUDES_MM for length in _LENGTHS_KNOTS]
    return [Wander(kind, *values) for kind in ("shake", "encoder") for values in grid]
