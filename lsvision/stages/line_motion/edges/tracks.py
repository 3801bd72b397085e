"""Tracks of edges that run along a scan: as chains of steep brightness through blocks of lines, by dynamic programming.

Lines of a block are shifted by a few slopes and averaged: an edge along the travel stays, texture averages out. A track
goes from block to block by no more than the steepest slope, where the sum of its steepness is greatest; the best one is
taken, what lies about it is left out, and the next one looked for.

Source: Canny 1986 (derivative of a Gaussian); Viterbi 1967.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

from lsvision.stages.line_motion.edges.cells import Cells

_SIGMA_CELLS, _RADIUS = 1.2, 4  # of the Gaussian
_BLOCK_CELLS = 16.0  # of travel
_STEEPEST = 0.25  # cells per cell of travel
_MOST_TRACKS = 8
_APART_CELLS = 8  # of two tracks, at least
_RIM_CELLS = 8  # beside the ends of a line, where nothing is looked for


@dataclass(frozen=True)
class Tracks:
    """Places of edges on some lines, in cells of the left image."""

    lines: range
    place: Float[Tensor, "tracks lines"]


def find_tracks(cells: Cells, lines: range, advance_mm: float) -> Tracks:
    """The tracks of the steepest edges along some lines of a scan.

    Args:
        advance_mm: of the object by line.
    """
    size = max(2, round(_BLOCK_CELLS * cells.pitch_mm / advance_mm))
    blocks = range(lines.start // size, -(-lines.stop // size))
    reach = max(1, round(_STEEPEST * size * advance_mm / cells.pitch_mm))
    steepness = torch.stack([_steepness(cells, block * size, size, reach, lines) for block in blocks], 1)
    middle = (torch.tensor(blocks).double() + 0.5) * size - 0.5
    found = [_between(middle, path, lines) for path in _best_paths(steepness, reach)]
    return Tracks(lines, torch.stack(found))


def _steepness(cells: Cells, start: int, size: int, reach: int, lines: range) -> Float[Tensor, "2 cells"]:
    """Greatest mean slope of brightness over the lines of a block along paths of some slopes, rising and falling."""
    offset = torch.arange(-_RADIUS, _RADIUS + 1, dtype=torch.float32)
    kernel = offset * torch.exp(-0.5 * (offset / _SIGMA_CELLS).square())
    kernel = kernel / (kernel * offset).sum()
    first, stop = max(start, lines.start), min(start + size, lines.stop)
    rise = F.conv1d(cells.read(0, first, stop)[:, None], kernel[None, None], padding=_RADIUS)[:, 0]
    line = torch.arange(first, stop) - (start + (size - 1) / 2)
    slopes = torch.arange(-reach, reach + 1) / size
    moved = (slopes[:, None] * line).round().long()[..., None] + torch.arange(cells.count)
    paths = rise[torch.arange(stop - first)[:, None], moved.clamp(0, cells.count - 1)].mean(1)
    paths[:, :_RIM_CELLS] = paths[:, cells.count - _RIM_CELLS :] = 0.0
    return torch.stack([paths.amax(0), (-paths).amax(0)])


def _best_paths(steepness: Float[Tensor, "2 blocks cells"], reach: int) -> list[Float[Tensor, " blocks"]]:
    """Cells of the best paths, one after the other, by block."""
    left, found = steepness.clone(), []
    cell = torch.arange(left.shape[-1])
    for _ in range(_MOST_TRACKS):
        path = _best_path(left, reach)
        found.append(path.double())
        left.masked_fill_((cell - path[:, None]).abs() <= _APART_CELLS, 0.0)
    return found


def _best_path(steepness: Float[Tensor, "2 blocks cells"], reach: int) -> Tensor:
    """The path of one sign with the greatest sum."""
    total, back = steepness[:, 0], []
    for block in steepness.unbind(1)[1:]:
        best, where = F.max_pool1d(total[:, None], 2 * reach + 1, 1, reach, return_indices=True)
        back.append(where[:, 0])
        total = block + best[:, 0]
    sign = int(total.amax(1).argmax())
    path = [int(total[sign].argmax())]
    for where in reversed(back):
        path.append(int(where[sign, path[-1]]))
    return torch.tensor(path[::-1])


def _between(middle: Float[Tensor, " blocks"], path: Tensor, lines: range) -> Float[Tensor, " lines"]:
    """Places on lines, linear between the middles of blocks; half a block on beyond the first and last."""
    line = torch.tensor(lines).double()
    if len(middle) == 1:
        return path.expand(len(line)).clone()
    after = torch.searchsorted(middle, line).clamp(1, len(middle) - 1)
    part = (line - middle[after - 1]) / (middle[after] - middle[after - 1])
    return torch.lerp(path[after - 1], path[after], part)
