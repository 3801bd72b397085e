"""Causes that may make boards contradict each other, as priors on their departures."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lsvision.stages.calibration.departures import KINDS

NONE = -1  # instead of the number of a scan or of a cause
# Prior sigma of each departure: relative speed; drift per mm; relative size; mm at the board's end.
_SIGMA = {"speed": 0.05, "sideways": 0.02, "depth": 0.02, "scale": 0.05, "bend": 0.3}


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
