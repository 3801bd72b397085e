"""Disparity -> depth: the depth of a stereo scan, matched where it is read."""

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property

import torch

from lsvision.geometry import depth_at, depth_sigma
from lsvision.image.stereo.relation import PairRelation
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_block, relation_of
from lsvision.types import Depth, DepthSource, DepthView, Rig, Scan, StereoPair, StoredDepth


@dataclass
class MatchedDepth:
    """The depth of a stereo scan; the last blocks stay in memory, since neighbouring reads overlap.

    The sigma is None where the matcher does not refine: nothing is known about it then.
    """

    images: StereoPair
    rig: Rig
    config: DisparityConfig = field(default_factory=DisparityConfig)
    kept_blocks: int = 3
    known_relation: PairRelation | None = None
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
    def relation(self) -> PairRelation:
        """How the right image differs from the left one apart from disparity; measured when it is first needed."""
        return self.known_relation or relation_of(self.images.left, self.images.right, self.rig, self.config)

    def _match(self, index: int) -> Depth:
        match = measure_block(self.images.left, self.images.right, self.rig, self.config, self.relation, index)
        z = depth_at(self.rig, match.disparity)
        return Depth(z, depth_sigma(self.rig, z, match.sigma) if self.config.tells_sigma else None)


def depth_of(
    scan: Scan, config: DisparityConfig | None = None, known_relation: PairRelation | None = None
) -> DepthSource:
    """The scan's own depth map where its camera computed one, else the one matched from its two images.

    Args:
        known_relation: of the two images, where it has been measured before.
    """
    match scan.images:
        case DepthView(_, depth):
            return StoredDepth(depth)
        case StereoPair() as pair:
            return MatchedDepth(pair, scan.rig, config or DisparityConfig(), known_relation=known_relation)
