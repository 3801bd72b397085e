"""Disparity -> depth: the depth of a stereo scan, matched where it is read."""

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property

import torch

from lsvision.geometry import depth_at, depth_sigma
from lsvision.image.levels import PairLevels
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_block
from lsvision.types import Depth, DepthSource, DepthView, Rig, Scan, StereoPair, StoredDepth


@dataclass
class MatchedDepth:
    """The depth of a stereo scan; the last blocks stay in memory, since neighbouring reads overlap.

    ``levels`` of the images are read from them where they are not given. The sigma is None where the matcher does not
    refine: nothing is known about it then.
    """

    images: StereoPair
    rig: Rig
    config: DisparityConfig = field(default_factory=DisparityConfig)
    kept_blocks: int = 3
    levels: PairLevels | None = None
    _blocks: OrderedDict[int, Depth] = field(default_factory=OrderedDict, init=False, repr=False)

    @property
    def lines(self) -> int:
        """Number of lines of the scan."""
        return self.images.left.shape[0]

    def read(self, start: int, stop: int) -> Depth:
        """Depth of lines ``start..stop-1``."""
        size = self.config.block_lines
        first, last = start // size, (stop - 1) // size
        blocks = [self._block(index) for index in range(first, last + 1)]
        lines = slice(start - first * size, stop - first * size)
        if len(blocks) == 1:
            z, sigma = blocks[0].z, blocks[0].sigma
        else:
            z = torch.cat([block.z for block in blocks])
            sigmas = [block.sigma for block in blocks if block.sigma is not None]
            sigma = torch.cat(sigmas) if sigmas else None
        return Depth(z[lines], None if sigma is None else sigma[lines])

    def _block(self, index: int) -> Depth:
        if index not in self._blocks:
            self._blocks[index] = self._match(index)
            while len(self._blocks) > self.kept_blocks:
                self._blocks.popitem(last=False)
        self._blocks.move_to_end(index)
        return self._blocks[index]

    @cached_property
    def _levels(self) -> PairLevels:
        return self.levels or PairLevels.of(self.images)

    def _match(self, index: int) -> Depth:
        match = measure_block(self.images, self._levels, self.rig, self.config, index)
        z = depth_at(self.rig, match.disparity)
        return Depth(z, depth_sigma(self.rig, z, match.sigma) if self.config.tells_sigma else None)


def depth_of(scan: Scan, config: DisparityConfig | None = None, levels: PairLevels | None = None) -> DepthSource:
    """The scan's own depth map where its camera computed one, else the one matched from its two images.

    Args:
        levels: of the images, if they are known already.
    """
    match scan.images:
        case DepthView(_, depth):
            return StoredDepth(depth)
        case StereoPair() as pair:
            return MatchedDepth(pair, scan.rig, config or DisparityConfig(), levels=levels)
