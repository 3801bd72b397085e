"""How edges differ from the model of their picture, seen in a board's own pixels, and how far that moves its corners.

Where lens and pixels are the same everywhere, the picture of a straight edge is one function of the distance from it.
Pixels that are no boxes (few samples of a renderer, sharpening) have another function than the model. The edges of a
board cross the pixels at all distances, so that the difference is seen, as the edge spread function of ISO 12233 is.

It is odd, and moves no corner whose edges have pixels at all distances. An edge whose slope is a ratio of small numbers
has pixels at few: the corner moves by an amount that depends on where it lies between the pixels. This is not
corrected: pixels that lie on flat parts of the picture do not show how far they are from its steps. Its mean square
over all places between the pixels is added to the covariance.

Chi-square of 3 x 88 corners (2 components) of windows of 17 px with noise of 4 of 180, as the tests simulate them, by
points that a pixel averages over and slope of the edges; in brackets if 2 / 17 of the variance on edges remained:

    points      0.05         0.18         1/3          1/2          0.65         1
    2 x 2       1.5 (3.4)    2.3 (2.6)    1.1 (8.1)    1.6 (24)     1.6 (6.1)    1.3 (58)
    3 x 3       1.5 (1.6)    2.3 (2.4)    1.8 (5.5)    1.7 (12)     1.7 (4.0)    1.4 (25)
    16 x 16     1.7 (1.7)    1.7 (1.7)    1.7 (1.7)    2.0 (2.0)    1.9 (1.9)    1.7 (1.9)
"""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.image.board.correlated_noise import BoardNoise, corner_covariance
from lsvision.image.board.levenberg_marquardt import NormalMatrix
from lsvision.image.board.saddle import SaddleFit
from lsvision.image.board.saddle_model import FULL, PIXEL_VARIANCE, POSITION, Saddle, SaddleParameters

_LARGEST_BLUR_PX = 0.8  # of what repeats with the pixels exp(-π² blur²), 0.002, is left
_KNOTS, _KNOT_SPACING = 50, 0.1  # of the distance from an edge; spacing over the standard deviation of the edge
_KNOWN = len(FULL.free) + 1  # rows of a fit's Jacobian: its parameters, and the square of the brightness, which is even
_MOVES = 264  # over which the mean square is taken: three in each window of a full board
_MOVED_TOGETHER = 66  # windows whose pixels stay in the processor's cache
_PLASTIC = 1.32471795724474602596  # spreads points evenly over a square (Roberts 2018, R2 sequence)
_BEFORE, _PAST = 1, 2  # of the places between knots that a pixel can have, before the first knot and past the last
_LEAST_VARIANCE, _LEAST_RIDGE = 1e-12, 1e-9  # no profile was seen; without noise the matrix is singular


@dataclass(frozen=True)
class EdgeProfile:
    """Difference of the picture of an edge from the model, which goes from -1 to 1: an odd function of the distance.

    It is linear between ``knots``, px; ``amount`` holds its values there for the first edge, then for the second.
    """

    knots: Float[Tensor, " knots"]
    amount: Float[Tensor, " twice_the_knots"]

    @classmethod
    def of(cls, fit: SaddleFit, valid: Bool[Tensor, " corners"]) -> "EdgeProfile":
        """From what the fits of a board have left of its windows, by ridge regression.

        The ridge is the variance of the noise over that of the amounts, which follows from
        ``E‖right‖² = variance ‖normal‖² + noise tr(normal)``.
        """
        width = (fit.parameters.blur[valid].square().mean() + PIXEL_VARIANCE).sqrt()
        knots = _KNOT_SPACING * width * (torch.arange(_KNOTS).to(width) + 0.5)
        shapes = _KnotShapes.of(fit.saddles(valid), fit.residuals.weight[valid], knots)
        known = fit.residuals.jacobian[valid][:, :_KNOWN]
        # The misfit is not orthogonal to the blur where that is at its bound.
        misfit = fit.misfit[valid][..., None]
        seen = shapes.products(torch.cat([known.mT, misfit], dim=-1))
        by_known, by_misfit = seen[..., :-1], seen[..., -1]
        taken = by_known @ NormalMatrix.of(known).inverse()
        normal = shapes.gram() - torch.einsum("cik, cjk -> ij", taken, by_known)
        right = by_misfit.sum(0) - torch.einsum("cik, ck -> i", taken, (known @ misfit)[..., 0])
        noise = fit.residual[valid].square().mean()
        variance = (right.square().sum() - noise * normal.trace()) / normal.square().sum()
        normal.diagonal().add_(noise / variance.clamp(min=_LEAST_VARIANCE) + _LEAST_RIDGE * normal.diagonal().mean())
        return cls(knots, torch.linalg.solve(normal, right))

    def values(self, saddles: Saddle) -> Float[Tensor, "corners pixels"]:
        """Difference of the grey values from the model's."""
        across, steps = saddles.edges.across, saddles.steps()
        near = (across.abs() < self.knots[-1] + 2 * self.knots[0]).nonzero()
        window, edge, pixel = near.unbind(-1)
        values = self._at(across[window, edge, pixel], edge) * steps[window, edge, pixel]
        size = steps.shape[-1]
        whole = values.new_zeros(len(steps) * size).index_add_(0, window * size + pixel, values)
        return whole.unflatten(0, (-1, size))

    def _at(self, across: Float[Tensor, " near"], edge: Int[Tensor, " near"]) -> Float[Tensor, " near"]:
        """The profile of an edge at signed distances; 0 half a spacing before the first knot and past the last."""
        padded = F.pad(self.amount.unflatten(0, (2, -1)), (1, 2))
        place = (across.abs() / (self.knots[1] - self.knots[0]) + 0.5).clamp(max=len(self.knots) + 1)
        before = place.long()
        return across.sign() * torch.lerp(padded[edge, before], padded[edge, before + 1], place - before)

    def moves(self, fit: SaddleFit, valid: Bool[Tensor, " corners"]) -> Float[Tensor, "moves 2"]:
        """How far corners move, px, each with its window at some places between the pixels."""
        corners = valid.nonzero()[:, 0]
        some = corners[torch.arange(_MOVES) % len(corners)]
        columns = fit.parameters.columns[some].clone()
        order = torch.arange(1, _MOVES + 1).to(columns)
        columns[:, POSITION] = torch.stack([order / _PLASTIC, order / _PLASTIC**2], dim=-1) % 1 - 0.5
        weight = fit.residuals.weight[some]
        parts = zip(columns.split(_MOVED_TOGETHER), weight.split(_MOVED_TOGETHER), strict=True)
        return torch.cat(
            [self._moved_by(Saddle.on_grid(SaddleParameters(each), fit.grid), inside) for each, inside in parts]
        )

    def _moved_by(self, saddles: Saddle, weight: Float[Tensor, "corners pixels"]) -> Float[Tensor, "corners 2"]:
        """How far the profile moves corners, px."""
        jacobian = saddles.jacobian(FULL, weight)
        pushed = jacobian @ self.values(saddles)[..., None]
        return (NormalMatrix.of(jacobian).inverse()[:, POSITION] @ pushed)[..., 0]


def board_noise(fit: SaddleFit, valid: Bool[Tensor, " corners"]) -> BoardNoise:
    """Noise of a board's valid fits, where the profile of sharp edges is no noise.

    What the knots do not resolve of a profile is left as noise on the edges. As much of it as of the profile itself
    survives the mean along an edge.
    """
    if not bool(fit.parameters.blur[valid].median() < _LARGEST_BLUR_PX):
        return BoardNoise.of(fit.residuals, valid)
    profile = EdgeProfile.of(fit, valid)
    difference = torch.zeros_like(fit.misfit)
    difference[valid] = profile.values(fit.saddles(valid)) * fit.residuals.weight[valid]
    noise = BoardNoise.of(fit.residuals.without(difference), valid)
    moves = profile.moves(fit, valid)
    aliased = moves.mT @ moves / len(moves)
    share = aliased.trace() / _moved_by_independent_noise(noise, difference, valid)
    return replace(noise, aliased=aliased, surviving=float(share.nan_to_num(1.0).clamp(max=1)))


def _moved_by_independent_noise(noise: BoardNoise, difference: Tensor, valid: Tensor) -> Tensor:
    """Mean square, px², by which noise on the edges, as large as a difference, moves corners."""
    seen = noise.residuals.of(valid)
    strength = torch.zeros_like(noise.strength)
    strength[-1] = difference[valid].square().sum() / (seen.steepness * seen.weight).square().sum()
    return corner_covariance(seen, seen, strength).mean(0).trace()


@dataclass(frozen=True)
class _KnotShapes:
    """Change of the grey values by the value of the profile at each knot of either edge: four numbers a pixel.

    A pixel lies between two knots of each edge, or farther from it than all. ``knot`` and ``change`` have a row for
    each pixel of any window that is near an edge. Each edge's knots are counted with some before the first and past the
    last, which are left out in the end.
    """

    windows: int
    knots: int
    window: Int[Tensor, " near"]
    pixel: Int[Tensor, " near"]
    knot: Int[Tensor, "near 4"]
    change: Float[Tensor, "near 4"]

    @classmethod
    def of(
        cls, saddles: Saddle, weight: Float[Tensor, "windows pixels"], knots: Float[Tensor, " knots"]
    ) -> "_KnotShapes":
        """Shapes of saddles in weighted pixels, for knots at some distances from the edges."""
        across = saddles.edges.across
        place = across.abs() / (knots[1] - knots[0]) - 0.5
        window, pixel = ((place < len(knots)).any(1) & (weight > 0)).nonzero().unbind(-1)
        change = across.sign() * saddles.steps() * weight[:, None]
        place, change = (each[window, :, pixel] for each in (place, change))
        before = place.floor().clamp(max=len(knots))
        after = (place - before).clamp(max=1) * change
        first = before.long() + _BEFORE + (len(knots) + _BEFORE + _PAST) * torch.arange(2, device=before.device)
        return cls(
            windows=len(weight),
            knots=len(knots),
            window=window,
            pixel=pixel,
            knot=torch.cat([first, first + 1], dim=-1),
            change=torch.cat([change - after, after], dim=-1),
        )

    def products(
        self, images: Float[Tensor, "windows pixels images"]
    ) -> Float[Tensor, "windows twice_the_knots images"]:
        """Each shape times images of its window."""
        parts = self.change[:, :, None] * images[self.window, self.pixel][:, None]
        row = self.window[:, None] * self._counted + self.knot
        summed = images.new_zeros(self.windows * self._counted, images.shape[-1])
        summed.scatter_add_(0, row.flatten()[:, None].expand(-1, images.shape[-1]), parts.flatten(0, 1))
        return self._inner(summed.unflatten(0, (self.windows, -1)), 1)

    def gram(self) -> Float[Tensor, "twice_the_knots twice_the_knots"]:
        """Products of the shapes with one another, summed over the windows."""
        parts = self.change[:, :, None] * self.change[:, None]
        place = self.knot[:, :, None] * self._counted + self.knot[:, None]
        summed = parts.new_zeros(self._counted**2).index_add_(0, place.flatten(), parts.flatten())
        return self._inner(self._inner(summed.unflatten(0, (self._counted, -1)), 0), 1)

    @property
    def _counted(self) -> int:
        return 2 * (self.knots + _BEFORE + _PAST)

    def _inner(self, summed: Tensor, dim: int) -> Tensor:
        """Without what lies before the first knot or past the last."""
        return summed.unflatten(dim, (2, -1)).narrow(dim + 1, _BEFORE, self.knots).flatten(dim, dim + 1)
