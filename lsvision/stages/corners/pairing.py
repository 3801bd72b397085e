"""Which corner of the right image is which of the left, where each camera may see another part of a board.

Three things are asked of a pairing: both cameras see a corner on the same line, its square has the same colours in
both, and the corners that follow have the spacing of the board. A shift by whole squares along the lines changes
nothing but the depth, and with it the scale: by two squares over the baseline.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.errors import BoardNotFoundError
from lsvision.geometry import Rectification, travel_at, triangulate
from lsvision.image.board.detect import SeenBoard
from lsvision.image.board.lattice import SeenLattice
from lsvision.image.board.placement import place_board
from lsvision.stages.corners.ideal import ideal_lattice, lines_apart
from lsvision.types import Board, Scan

_FEWEST_SHARED = 12  # corners that both images show
_LINES_APART = 3.0  # of the same corner in both images, lines
_COPY_PX = 0.5  # error of a corner on the reduced copy
_COMPLETE = 0.95  # of a board: then there is nothing to choose
_LARGEST_MISFIT = 0.04  # of the scale; the next candidate of a GP400 is off by 0.16
_CLEARLY = 2.0  # times better than the next
_UNTURNED = torch.eye(2, dtype=torch.long)


@dataclass(frozen=True)
class _Candidate:
    """A right lattice counted from some corner, and by what factor the board then looks too large (logarithm)."""

    lattice: SeenLattice
    misfit: float


def pair_lattices(scan: Scan, board: Board, left: SeenBoard, right: SeenBoard) -> SeenLattice:
    """The right image's lattice, counted from the same corner along the same axes as the left one's.

    Raises:
        BoardNotFoundError: the images do not agree, or agree in several ways; names the scan.
    """
    rectification = Rectification.of(scan.raw_rig)
    seen = ideal_lattice(left.in_image(), rectification)
    turned = ideal_lattice(_along_the_same_axes(left, right), rectification, right=True)
    lines = lines_apart(seen.position, turned.position, rectification, scan.travel)
    apart = max(_LINES_APART, _COPY_PX * left.factor)
    shifted = [turned.turned(_UNTURNED, shift) for shift in _shifts_on_the_same_lines(seen, turned, lines, apart)]
    fitting = [lattice for lattice in shifted if _fits_on_board(left, right, lattice, board)]
    candidates = [_Candidate(lattice, _scale_misfit(scan, board, seen, lattice)) for lattice in fitting]
    candidates = [candidate for candidate in candidates if math.isfinite(candidate.misfit)]  # not behind the cameras
    if not candidates:
        raise BoardNotFoundError(f"{scan.path}: no board in both images: they share no part of one on the same lines")
    best, *others = sorted(candidates, key=lambda candidate: abs(candidate.misfit))
    whole = _COMPLETE * math.prod(board.inner)
    if not others and min(len(seen.node), len(turned.node)) >= whole:
        return best.lattice  # a board of another size than was said is not for this stage to find out
    unclear = any(abs(other.misfit) < _CLEARLY * abs(best.misfit) for other in others)
    if abs(best.misfit) > _LARGEST_MISFIT or unclear:
        raise BoardNotFoundError(
            f"{scan.path}: the images show parts of a board, and which corners they share is not clear: at best its "
            f"squares look {board.square_mm * math.exp(best.misfit):.1f} mm wide, not {board.square_mm:g} mm"
        )
    return best.lattice


def _along_the_same_axes(left: SeenBoard, right: SeenBoard) -> SeenLattice:
    """The right lattice along the left one's axes, from a corner whose squares have the same colours."""
    axes = _turns()
    steps, right_steps = left.in_image().steps(), right.in_image().steps()
    # A step along the new axis is the old step that the turn takes there: columns permuted, some reversed.
    apart = (right_steps @ axes.double().mT - steps).square().sum((1, 2))
    turned = right.in_image().turned(axes[apart.argmin()], torch.zeros(2, dtype=torch.long))
    odd = (right.with_nodes(turned).black_parity() - left.black_parity()) % 2
    return turned.turned(_UNTURNED, torch.tensor([odd, 0]))


def _turns() -> Tensor:
    """The eight ways (8, 2, 2) to turn and mirror a square."""
    signs = torch.cartesian_prod(torch.tensor([1, -1]), torch.tensor([1, -1]))
    straight = torch.diag_embed(signs)
    return torch.cat([straight, straight.flip(-1)])


def _shifts_on_the_same_lines(left: SeenLattice, right: SeenLattice, lines: Tensor, apart: float) -> Tensor:
    """Shifts (shifts, 2) of the right nodes by which enough corners coincide, on lines that are hardly apart."""
    shift = (left.node[:, None] - right.node[None]).flatten(0, 1)
    shifts, of_pair, shared = shift.unique(dim=0, return_inverse=True, return_counts=True)
    mean = torch.zeros(len(shifts), dtype=lines.dtype).index_add_(0, of_pair, lines.flatten()) / shared
    same_colours = shifts.sum(-1) % 2 == 0
    return shifts[(shared >= _FEWEST_SHARED) & (mean <= apart) & same_colours]


def _fits_on_board(left: SeenBoard, right: SeenBoard, lattice: SeenLattice, board: Board) -> bool:
    """Whether both lattices, counted together, are no larger than a board."""
    return place_board([left.view(), right.with_nodes(lattice).view()], board.inner) is not None


def _scale_misfit(scan: Scan, board: Board, left: SeenLattice, right: SeenLattice) -> float:
    """Logarithm of the measured over the true length of the board along a line, where the motion does not enter."""
    of_left, of_right = (left.node[:, None] == right.node[None]).all(-1).nonzero().unbind(-1)
    column, line = left.position[of_left].unbind(-1)
    x, z = triangulate(scan.rig, column, column - right.position[of_right, 0])
    points = torch.stack([x, travel_at(scan.travel, line), z], dim=-1)
    plane = torch.cat([left.node[of_left].double(), torch.ones_like(points[:, :1])], dim=-1)
    along_x, along_y, _ = torch.linalg.lstsq(plane, points).solution  # mm per square
    # The direction on the board that stays on its line.
    level = torch.stack([along_y[1], -along_x[1]])
    measured = (level[0] * along_x + level[1] * along_y).norm()
    return float((measured / (level.norm() * board.square_mm)).log())
