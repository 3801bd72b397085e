"""Corners of a board, reduced once to a few rows on which the calibration's kernels work: exact, whatever their number.

Both reductions are the triangular root of rows over all corners, so that sums of squares of anything linear in those
rows stay the same. They buy speed: an iteration costs the same for 88 corners as for 10.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import upper_root
from lsvision.estimation.linalg import forward_substitute

# Boards whose whitened corners are reduced at once: some 2 MB, as much as stays near a processor.
_BOARDS_IN_CACHE = 64


@dataclass(frozen=True)
class CorrelatedNoise:
    """``feature_rows`` whitened by a noise that is correlated between a board's corners, and its log-determinant.

    ``further`` is how many values the rows stand for besides the corners'.
    """

    rows: Float[Tensor, "*batch boards rows rows"]
    log_det: Float[Tensor, "*batch"]
    further: float = 0.0

    def at(self, place: Bool[Tensor, "*batch"] | tuple[int | None, ...]) -> "CorrelatedNoise":
        """That of the problems where a mask is true, in a row; of the one at a tuple of indices."""
        return replace(self, rows=self.rows[place], log_det=self.log_det[place])


def affine_rows(
    noise_chol: Float[Tensor, "*batch boards corners 3 3"],
    points: Float[Tensor, "*batch boards corners 3"],
    body_points: Float[Tensor, "*batch boards corners 3"],
    valid: Bool[Tensor, "*batch boards corners"],
) -> Float[Tensor, "*batch boards 13 13"]:
    """Whitened rows ``[S | q]`` on the affine map from board points to measured ones.

    For the map's twelve coefficients c, its three values at p = 0, then its derivatives by each component of p,
    ‖q - S c‖² is the squared whitened error of all valid corners.

    Args:
        noise_chol: Cholesky factor of the covariance of ``points``, mm.
    """
    return feature_rows(noise_chol, points, affine_features(body_points), valid)


def affine_features(body_points: Float[Tensor, "*batch corners 3"]) -> Float[Tensor, "*batch corners 4"]:
    """The features (1, p) of a corner, in which an affine map is linear."""
    return torch.cat([torch.ones_like(body_points[..., :1]), body_points], dim=-1)


def feature_rows(
    noise_chol: Float[Tensor, "*batch boards corners 3 3"],
    points: Float[Tensor, "*batch boards corners 3"],
    features: Float[Tensor, "*batch boards corners features"],
    valid: Bool[Tensor, "*batch boards corners"],
) -> Float[Tensor, "*batch boards rows rows"]:
    """Whitened rows ``[S | q]`` on a map to measured points that is linear in features of a corner.

    For the map's coefficients c, three of each feature in turn, ‖q - S c‖² is the squared whitened error of all valid
    corners; the last row, in which S is zero, is the error that no coefficients remove.
    """
    parts = (noise_chol, points, features, valid)
    if valid.ndim < 3:
        return _feature_rows(*parts)
    step = max(1, _BOARDS_IN_CACHE // points.shape[-3])
    return torch.cat([_feature_rows(*pieces) for pieces in zip(*(part.split(step) for part in parts), strict=True)])


def rows_with_latents(
    noise_chol: Float[Tensor, "boards corners 3 3"],
    points: Float[Tensor, "boards corners 3"],
    features: Float[Tensor, "boards corners features"],
    valid: Bool[Tensor, "boards corners"],
    latents: Float[Tensor, "boards corners 3 latents"],
    further: Float[Tensor, "boards rows columns"] | None = None,
) -> CorrelatedNoise:
    """``feature_rows`` of corners that err by ``latents`` @ ξ too, ξ ~ N(0, I) of each board.

    ξ are unknowns with a unit prior, eliminated by the same QR: no covariance between corners is ever formed. The
    log-determinant is that of the whole noise less that of ``noise_chol``.

    Args:
        further: whitened rows on the latents, the map and 1 of whatever else was measured of the boards.
    """
    count = latents.shape[-1]
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    by_map = (features[..., None, :, None] * eye[:, None, :]).flatten(-2)
    columns = torch.cat([latents, by_map, points[..., None]], dim=-1)
    whitened = torch.linalg.solve_triangular(noise_chol, columns, upper=False)
    whitened = torch.where(valid[..., None, None], whitened, 0.0).flatten(-3, -2)
    unit = torch.eye(count, columns.shape[-1], dtype=points.dtype, device=points.device)
    rows = [unit.expand(*valid.shape[:-1], -1, -1), whitened, *([] if further is None else [further])]
    root = upper_root(torch.cat(rows, dim=-2))
    by_latents = root[..., :count, :count].diagonal(dim1=-2, dim2=-1).abs().log().sum((-2, -1))
    return CorrelatedNoise(root[..., count:, count:], 2.0 * by_latents)


def residual_rows(
    points: Float[Tensor, "*batch boards corners 3"],
    body_points: Float[Tensor, "*batch boards corners 3"],
    valid: Bool[Tensor, "*batch boards corners"],
) -> Float[Tensor, "*batch boards 7 7"]:
    """Rows of (1, p, x, y, z) of the valid corners, on which the sum of their squared residuals depends alone."""
    rows = torch.cat([torch.ones_like(points[..., :1]), body_points, points], dim=-1)
    return upper_root(torch.where(valid[..., None], rows, 0.0))


def _feature_rows(noise_chol: Tensor, points: Tensor, features: Tensor, valid: Tensor) -> Tensor:
    eye = torch.eye(3, dtype=points.dtype, device=points.device)
    eye = eye.reshape(3, 3, *(1,) * valid.ndim).expand(3, 3, *valid.shape)
    right = torch.cat([eye, points.movedim(-1, 0)[:, None]], dim=1)
    whitened = forward_substitute(noise_chol.movedim((-2, -1), (0, 1)), right)
    # Whitener and whitened points as (*batch, boards, column, row, corner): corners side by side in memory.
    whitened = torch.where(valid, whitened, 0.0).movedim((1, 0), (-3, -2))
    count = features.shape[-1]
    columns = points.new_empty(*whitened.shape[:-3], 3 * count + 1, *whitened.shape[-2:])
    columns[..., 3 * count, :, :] = whitened[..., 3, :, :]
    for k, feature in enumerate(features.unbind(-1)):
        by_feature = columns[..., 3 * k : 3 * k + 3, :, :]
        torch.mul(whitened[..., :3, :, :], feature[..., None, None, :], out=by_feature)
    # In one layout whatever comes before: the order of sums, and so their last bits, follows it.
    return upper_root(columns.flatten(-2).mT).contiguous()
