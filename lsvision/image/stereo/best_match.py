"""The best disparity of each pixel so far, and searches around a known surface that improve it."""

from dataclasses import dataclass

import cv2
import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from lsvision.image.stereo.sgbm import GrayPair, Search, match_sgbm
from lsvision.image.stereo.warp import warp_linear

_ROOM_PX = 64  # beside the marked columns of a search
_COST_BLOCK, _COST_LIMIT, _NO_MATCH = 5, 60, 255.0


@dataclass
class BestMatch:
    """The best disparity of each pixel so far and its cost; ``search_around`` improves both in place."""

    pair: GrayPair
    disparity: Float[Tensor, "lines width"]
    cost: Float[Tensor, "lines width"]

    @classmethod
    def of(cls, pair: GrayPair, disparity: Float[Tensor, "lines width"]) -> "BestMatch":
        """A first disparity of every pixel, px."""
        return cls(pair, disparity, matching_cost(pair, disparity, slice(0, disparity.shape[1])))

    def search_around(
        self, surface: Float[Tensor, "lines width"], where: Bool[Tensor, "lines width"], search: Search
    ) -> None:
        """Search around the disparities of a surface; of the pixels marked, those of less cost take what is found."""
        for columns in stretches(where.any(0)):
            found = _match_around(self.pair, surface, columns, search)
            cost, best = matching_cost(self.pair, found, columns), self.cost[:, columns]
            better = (cost < best).logical_and_(where[:, columns])
            self.disparity[:, columns] = torch.where(better, found, self.disparity[:, columns])
            self.cost[:, columns] = torch.where(better, cost, best)


def matching_cost(
    pair: GrayPair, disparity: Float[Tensor, "lines columns"], columns: slice
) -> Float[Tensor, "lines columns"]:
    """Mean absolute difference over the block around each pixel, for the disparity of some columns.

    Returns:
        Whole numbers 0..60, or 255 where the disparity is NaN.
    """
    partner = torch.arange(columns.start, columns.stop, dtype=torch.float32) - disparity
    warped = warp_linear(pair.right, torch.nan_to_num(partner))
    difference = cv2.absdiff(warped.numpy(), pair.left[:, columns].numpy()).clip(max=_COST_LIMIT)
    cost = torch.from_numpy(cv2.blur(difference, (_COST_BLOCK, _COST_BLOCK))).to(torch.float32)
    return torch.where(disparity.isnan(), _NO_MATCH, cost)


def stretches(marked: Bool[Tensor, " columns"], room: int = _ROOM_PX) -> list[slice]:
    """Stretches of marked columns, with ``room`` more columns on either side."""
    wide = F.max_pool1d(marked.float()[None], 2 * room + 1, 1, room)[0]
    bounds = F.pad(wide, (1, 1)).diff().nonzero()[:, 0].view(-1, 2)
    return [slice(start, stop) for start, stop in bounds.tolist()]


def _match_around(pair: GrayPair, surface: Tensor, columns: slice, search: Search) -> Tensor:
    """Disparity in some columns by a search whose range is counted from a surface."""
    surface = surface[:, columns]
    column = torch.arange(columns.start, columns.stop, dtype=torch.float32)
    warped: UInt8[Tensor, "lines columns"] = warp_linear(pair.right, column - surface)
    disparity = surface + match_sgbm(GrayPair(pair.left[:, columns], warped), search)
    partner = column - disparity
    return torch.where((partner > -0.5) & (partner < pair.right.shape[1] - 0.5), disparity, torch.nan)
