"""Which corners of a board are those that images show of it: the board laid on a lattice that is partly seen."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.image.board.lattice import SeenLattice
from lsvision.image.missing import missing_near

_SEEN_SHARE = 0.4  # of the board's corners
_STRAY_SHARE = 0.1  # of the lattice's corners that may lie beyond the board


@dataclass(frozen=True)
class LatticeView:
    """A lattice in one image, the ``(lines, width)`` of that image, and how near its rim corners are found, px.

    On ``hidden`` lines there is nothing to be seen, as beyond the rim; None where there are no such lines.
    """

    lattice: SeenLattice
    shape: tuple[int, int]
    rim_px: int
    hidden: Bool[Tensor, " lines"] | None = None

    def shows(self, position: Float[Tensor, "rows columns 2"]) -> Bool[Tensor, "rows columns"]:
        """Whether a corner at (u, v) px would have been found."""
        far = position.new_tensor(self.shape[::-1]) - 1 - self.rim_px
        inside = ((position >= self.rim_px) & (position <= far)).all(-1)
        if self.hidden is not None:
            near = missing_near(self.hidden, self.rim_px)
            inside &= ~near[position[..., 1].round().long().clamp(0, len(near) - 1)]
        return inside


@dataclass(frozen=True)
class _Evidence:
    """The board in one of its two directions, laid where it agrees best: corners seen on it less those missing."""

    score: float
    seen: int
    origin: Int[Tensor, "2"]
    inner: tuple[int, int]
    turned: bool


def place_board(views: Sequence[LatticeView], inner: tuple[int, int]) -> list[Float[Tensor, "rows columns 2"]] | None:
    """Corners of a board as a grid of (u, v) px for each image; the same place of all grids is the same corner.

    A lattice of which a part is beyond the image does not say by itself which corners it shows. Where the board ends
    within an image, corners that it would have further on are missing there: the board lies where most corners are seen
    and fewest are missing. If that leaves a choice (the board goes beyond the image on both sides), any is taken: the
    board's pose then differs by whole squares and the motion that is measured with it is the same.

    Args:
        views: lattices that count from the same corner along the same axes.
        inner: corners along the longer side and along the shorter.

    Returns:
        A grid for each view, columns along the longer side, in which unseen corners are where the lattice continues.
        None where too few corners of a board are seen or too many beyond it.
    """
    best = max((_best_evidence(views, inner, turned) for turned in (False, True)), key=lambda found: found.score)
    if best.seen < _SEEN_SHARE * inner[0] * inner[1]:
        return None
    size = torch.tensor(best.inner)
    grids = []
    for view in views:
        node = view.lattice.node - best.origin
        on_board = ((node >= 0) & (node < size)).all(-1)
        if int((~on_board).sum()) > _STRAY_SHARE * len(node):
            return None
        grid = _continued(SeenLattice(node[on_board], view.lattice.position[on_board]), best.inner)
        grids.append(grid.transpose(0, 1) if best.turned else grid)
    return grids


def _best_evidence(views: Sequence[LatticeView], inner: tuple[int, int], turned: bool) -> _Evidence:
    columns, rows = inner[::-1] if turned else inner
    nodes = torch.cat([view.lattice.node for view in views])
    # Wide enough for every place of the board that has a seen corner.
    margin = torch.tensor([columns - 1, rows - 1])
    first, last = nodes.amin(0) - margin, nodes.amax(0) + margin
    of_each = torch.stack([_seen_and_missing(view, first, last) for view in views])
    seen, missing = of_each[:, 0], of_each[:, 1]
    by_place = torch.stack([(seen - missing).sum(0), seen.amax(0)])
    score, count = F.avg_pool2d(by_place[:, None], (rows, columns), 1)[:, 0] * (rows * columns)
    row, column = divmod(int(score.argmax()), score.shape[1])
    origin = first + torch.tensor([column, row])
    return _Evidence(float(score.max()), round(float(count[row, column])), origin, (columns, rows), turned)


def _seen_and_missing(view: LatticeView, first: Tensor, last: Tensor) -> Float[Tensor, "2 rows columns"]:
    """1 at the nodes, from the first to the last, that are seen, and at those that are in the image but are not."""
    x = torch.arange(int(first[0]), int(last[0]) + 1)
    y = torch.arange(int(first[1]), int(last[1]) + 1)
    node = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    seen = torch.zeros(node.shape[:2])
    place = view.lattice.node - first
    seen[place[:, 1], place[:, 0]] = 1
    position = view.lattice.to_image()(node.double())
    return torch.stack([seen, view.shows(position) * (1 - seen)])


def _continued(lattice: SeenLattice, size: tuple[int, int]) -> Tensor:
    """Grid (rows, columns, 2) of a lattice whose nodes count from the board's corner."""
    y, x = torch.meshgrid(torch.arange(size[1]), torch.arange(size[0]), indexing="ij")
    grid = lattice.to_image()(torch.stack([x, y], dim=-1).double())
    grid[lattice.node[:, 1], lattice.node[:, 0]] = lattice.position
    return grid
