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
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.image.board.correlated_noise import BoardNoise, corner_covariance
from lsvision.image.board.levenberg_marquardt import NormalMatrix
from lsvision.image.board.saddle import SaddleFit
from lsvision.image.board.saddle_model import FULL, PIXEL_VARIANCE, POSITION, Saddle, SaddleParameters

_LARGEST_BLUR_PX = 0.8  # of what repeats with the pixels exp(-π² blur²), 0.002, is left
_KNOTS, _KNOT_SPACING = 50, 0.1  # of the distance from an edge; spacing over the standard deviation of the edge
_KNOWN = len(FULL.free) + 1  # rows of a fit's Jacobian: its parameters, and the square of the brightness, which is even
_MOVES = 264  # over which the mean square is taken: three in each window of a full board
_PLASTIC = 1.32471795724474602596  # spreads points evenly over a square (Roberts 2018, R2 sequence)
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
        # Seven digits are plenty, and half the time.
        shapes = _odd_shapes(fit.saddles(valid), knots).float() * fit.residuals.weight[valid][:, None].float()
        # The misfit is not orthogonal to the blur where that is at its bound.
        known = torch.linalg.qr(fit.residuals.jacobian[valid][:, :_KNOWN].mT).Q.float()
        left = shapes - (shapes @ known) @ known.mT
        normal = (left @ shapes.mT).sum(0).to(knots)
        right = (left @ fit.misfit[valid][..., None].float()).sum(0)[:, 0].to(knots)
        noise = fit.residual[valid].square().mean()
        variance = (right.square().sum() - noise * normal.trace()) / normal.square().sum()
        normal.diagonal().add_(noise / variance.clamp(min=_LEAST_VARIANCE) + _LEAST_RIDGE * normal.diagonal().mean())
        return cls(knots, torch.linalg.solve(normal, right))

    def values(self, saddles: Saddle) -> Float[Tensor, "corners pixels"]:
        """Difference of the grey values from the model's."""
        edges = zip(saddles.edges, self.amount.unflatten(0, (2, -1)), saddles.steps().unbind(1), strict=True)
        return torch.stack([self._at(edge.across, amount) * step for edge, amount, step in edges]).sum(0)

    def _at(self, across: Float[Tensor, "corners pixels"], amount: Float[Tensor, " knots"]) -> Tensor:
        """One edge's profile at signed distances from it; 0 half a spacing before the first knot and past the last."""
        padded = F.pad(amount, (1, 2))
        place = (across.abs() / (self.knots[1] - self.knots[0]) + 0.5).clamp(max=len(amount) + 1)
        before = place.long()
        return across.sign() * torch.lerp(padded[before], padded[before + 1], place - before)

    def moves(self, fit: SaddleFit, valid: Bool[Tensor, " corners"]) -> Float[Tensor, "moves 2"]:
        """How far corners move, px, each with its window at some places between the pixels."""
        corners = valid.nonzero()[:, 0]
        some = corners[torch.arange(_MOVES) % len(corners)]
        columns = fit.parameters.columns[some].clone()
        order = torch.arange(1, _MOVES + 1).to(columns)
        columns[:, POSITION] = torch.stack([order / _PLASTIC, order / _PLASTIC**2], dim=-1) % 1 - 0.5
        saddles = Saddle.on_grid(SaddleParameters(columns), fit.grid)
        jacobian = saddles.jacobian(FULL) * fit.residuals.weight[some][:, None]
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


def _odd_shapes(saddles: Saddle, knots: Float[Tensor, " knots"]) -> Float[Tensor, "corners twice_the_knots pixels"]:
    """Change of the grey values by the value of the profile at each knot, of either edge."""
    across = torch.stack([edge.across for edge in saddles.edges], dim=1)
    hats = (1 - (across.abs()[:, :, None] - knots[:, None]).abs() / (knots[1] - knots[0])).clamp(min=0)
    return (hats * (across.sign() * saddles.steps())[:, :, None]).flatten(1, 2)
