"""A checkerboard's grid from the saddles of an image: for boards partly hidden, cut off, or strongly sheared."""

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Float
from torch import Tensor

_BLUR_PX = 1.5
_PEAK_PX = 7  # saddles lie further apart
_FAINTEST = 0.1  # response of a saddle over that of the board's median one
_CANDIDATES = 4  # times the board's corners
_SEEDS = 8
_RADII = (1.6, 2.6, 3.6, 5.0, 7.0, 10.0, 15.0, 25.0, 40.0)  # squares around the seed, from which the grid grows
_OFF_GRID = 0.25  # squares
_EVEN = (0.65, 1.5)  # of the median corner
_SEEN_SHARE = 0.5  # of the board's corners
_STRAY_SHARE = 0.1  # of the grid's saddles that may lie beyond the board


def find_saddle_grid(
    brightness: Float[Tensor, "lines width"], inner: tuple[int, int]
) -> Float[Tensor, "rows columns 2"] | None:
    """Inner corners of a board of which at least half are seen, as (u, v) px; the others where the grid continues.

    Saddles are linked to a lattice: neighbours along the squares' edges have opposite curvatures, which no texture has.
    From a few seeds the lattice is fitted to ever more of its surroundings. Where a part of the board is beyond the
    image, the grid may be shifted by whole squares; every such grid is one of the same lattice.

    Args:
        brightness: of an image in which squares have eight pixels or more.
        inner: corners along the longer side and along the shorter.
    """
    points, curvature, evenness = _saddles(brightness, _CANDIDATES * inner[0] * inner[1])
    if len(points) < _SEEN_SHARE * inner[0] * inner[1]:
        return None
    lattices = [lattice for seed in range(_SEEDS) if (lattice := _lattice(points, curvature, seed)) is not None]
    if not lattices:
        return None
    node, on_grid = max(lattices, key=lambda lattice: int(lattice[1].sum()))
    # Where squares end at the board's rim three quadrants are white, which is half as even as a corner of four squares;
    # saddles of noise and of fine texture are more even than any.
    share = evenness / evenness[on_grid].median()
    corner = on_grid & (share > _EVEN[0]) & (share < _EVEN[1])
    return _placed(points[corner], node[corner], inner)


def _saddles(brightness: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (n, 2) of the strongest saddles, their normalised curvatures (xx, xy, yy), and how even they are.

    All float64. Evenness is the response over the square of the variance around: it does not depend on the light.
    """
    # Takes a second to import and is needed for few images.
    from kornia.filters import gaussian_blur2d, spatial_gradient

    smooth = gaussian_blur2d((brightness - brightness.mean())[None, None], (9, 9), (_BLUR_PX, _BLUR_PX))
    xx, xy, yy = spatial_gradient(smooth, mode="diff", order=2)[0, 0]
    response = (xy * xy - xx * yy).clamp(min=0)
    # Minus the determinant of the Hessian is positive at saddles alone.
    peak = F.max_pool2d(response[None], _PEAK_PX, 1, _PEAK_PX // 2)[0]
    found = ((response == peak) & (response > 0)).nonzero()
    strength, order = response[found[:, 0], found[:, 1]].sort(descending=True)
    order = order[:count]
    strong = strength[:count] > _FAINTEST * strength[: max(count // (2 * _CANDIDATES), 1)].median()
    line, column = found[order[strong]].unbind(-1)
    curvature = torch.stack([field[line, column] for field in (xx, xy, yy)], dim=-1).double()
    mean, power = F.avg_pool2d(torch.cat([smooth, smooth * smooth]), _PEAK_PX, 1, _PEAK_PX // 2)[:, 0]
    variance = (power - mean * mean)[line, column].double()
    evenness = response[line, column].double() / variance.square().clamp(min=1e-6)
    return torch.stack([column, line], dim=-1).double(), F.normalize(curvature, dim=-1), evenness


def _lattice(points: Tensor, curvature: Tensor, seed: int) -> tuple[Tensor, Tensor] | None:
    """Lattice node (n, 2) of each point, counted from a seed, and which points lie on the lattice."""
    offset = points - points[seed]
    # Of (xx, xy, yy) the mixed derivative counts twice in the Hessian.
    likeness = (curvature * curvature[seed] * curvature.new_tensor([1.0, 2.0, 1.0])).sum(-1)
    likeness = likeness / likeness[seed]
    opposite = (likeness < -0.5).nonzero()[:, 0]
    opposite = opposite[offset[opposite].norm(dim=-1).argsort()]
    if len(opposite) < 2:
        return None
    first = offset[opposite[0]]
    crossing = first[0] * offset[opposite, 1] - first[1] * offset[opposite, 0]
    aside = crossing.abs() > 0.3 * first.norm() * offset[opposite].norm(dim=-1)
    if not bool(aside.any()):
        return None
    step = torch.stack([first, offset[opposite[aside][0]]], dim=-1)
    scaled = offset / step.norm()
    model = torch.cat([torch.zeros(1, 2).double(), torch.linalg.inv(step).mT * step.norm(), torch.zeros(3, 2).double()])
    for radius in _RADII:
        position = _polynomial(scaled) @ model
        node = position.round()
        even = node.sum(-1).remainder(2) == 0
        on_grid = ((position - node).abs() < _OFF_GRID).all(-1) & (torch.where(even, likeness, -likeness) > 0.3)
        on_grid &= (position.abs() <= radius).all(-1)
        terms = 6 if int(on_grid.sum()) >= 24 else 3
        if int(on_grid.sum()) < 3:
            return None
        model = torch.zeros(6, 2).double()
        model[:terms] = torch.linalg.lstsq(
            _polynomial(scaled[on_grid])[:, :terms], node[on_grid], driver="gelsd"
        ).solution
    return node, on_grid


def _polynomial(position: Tensor) -> Tensor:
    x, y = position.unbind(-1)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], dim=-1)


def _placed(points: Tensor, node: Tensor, inner: tuple[int, int]) -> Tensor | None:
    """The board's grid on a lattice: where most of its nodes were seen, along either of the lattice's axes."""
    node = (node - node.amin(0)).long()
    best: tuple[int, Tensor] | None = None
    for flipped in (node, node.flip(-1)):
        columns, rows = inner
        seen = torch.zeros(int(flipped[:, 1].max()) + 1, int(flipped[:, 0].max()) + 1)
        seen[flipped[:, 1], flipped[:, 0]] = 1
        padded = F.pad(seen, (columns - 1, columns - 1, rows - 1, rows - 1))
        counts = F.avg_pool2d(padded[None], (rows, columns), 1)[0] * rows * columns
        row, column = divmod(int(counts.argmax()), counts.shape[1])
        shifted = flipped - flipped.new_tensor([column - columns + 1, row - rows + 1])
        if best is None or int(counts.max().round()) > best[0]:
            best = int(counts.max().round()), shifted
    assert best is not None
    count, node = best
    enough = count >= _SEEN_SHARE * inner[0] * inner[1]
    within = ((node >= 0) & (node < node.new_tensor(inner))).all(-1)
    if not enough or int((~within).sum()) > _STRAY_SHARE * len(node):
        return None
    model = torch.linalg.lstsq(_polynomial(node[within].double()), points[within]).solution
    y, x = torch.meshgrid(torch.arange(inner[1]), torch.arange(inner[0]), indexing="ij")
    grid = (_polynomial(torch.stack([x, y], dim=-1).double()) @ model).clone()
    grid[node[within][:, 1], node[within][:, 0]] = points[within]
    return grid
