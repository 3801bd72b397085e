"""Disparity -> depth: the depth of a stereo scan, matched where it is read."""

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import depth_at, depth_sigma
from lsvision.image.stereo.relation import PairRelation
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_block, measure_lines, relation_of
from lsvision.stages.disparity.rectify import RectifiedPair
from lsvision.types import Depth, DepthSource, DepthView, Rig, Scan, StereoPair, StoredDepth


@dataclass
class MatchedDepth:
    """The depth of a stereo scan; the last blocks stay in memory, since neighbouring reads overlap.

    ``known_relation`` of the images is measured where it is not given. ``rectified`` are the images of an ideal pair,
    which are matched in place of raw ones; None where ``images`` are rectified. The sigma is None where the matcher
    does not refine: nothing is known about it then.
    """

    images: StereoPair
    rig: Rig
    config: DisparityConfig = field(default_factory=DisparityConfig)
    kept_blocks: int = 3
    known_relation: PairRelation | None = None
    rectified: RectifiedPair | None = None
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
        return self.known_relation or relation_of(self.images, self.rig, self.config)

    def _match(self, index: int) -> Depth:
        if self.rectified is None:
            match = measure_block(self.images, self.relation, self.rig, self.config, index)
            z = depth_at(self.rig, match.disparity)
            return Depth(z, depth_sigma(self.rig, z, match.sigma) if self.config.tells_sigma else None)
        start, size = index * self.config.block_lines, self.config.block_lines
        stop = min(start + size, self.lines)
        rows = self.rectified.rows_of(start, stop)
        rig = self.rectified.rectification.matched_rig
        match = measure_lines(self.rectified.images, self.relation, rig, self.config, rows)
        match = self.rectified.without_unseen(match, rows, self.relation.rows.whole)
        depth = self.rectified.depth(match, rows, start, stop)
        return depth if self.config.tells_sigma else Depth(depth.z)


def relation_of_scan(scan: Scan, config: DisparityConfig) -> PairRelation | None:
    """How the two images of a scan differ apart from disparity; None for a scan with a depth map.

    Raw images are rectified for it as for an object of nominal motion.
    """
    match scan.images:
        case StereoPair() as pair:
            rectified = RectifiedPair.of(scan, config)
            if rectified is None:
                return relation_of(pair, scan.rig, config)
            return relation_of(rectified.images, rectified.rectification.matched_rig, config)
        case DepthView():
            return None


def depth_of(
    scan: Scan,
    config: DisparityConfig | None = None,
    known_relation: PairRelation | None = None,
    n: Float[Tensor, "3"] | None = None,
) -> DepthSource:
    """The scan's own depth map where its camera computed one, else the one matched from its two images.

    Args:
        known_relation: of the two images, where it has been measured before.
        n: motion of the object, by which the cameras of a raw rig see it moved between their planes; nominal if None.
    """
    config = config or DisparityConfig()
    match scan.images:
        case DepthView(_, depth):
            return StoredDepth(depth)
        case StereoPair() as pair:
            rectified = RectifiedPair.of(scan, config, n)
            if rectified is not None:  # the relation does not depend on n
                known_relation = known_relation or relation_of_scan(scan, config)
            return MatchedDepth(pair, scan.rig, config, known_relation=known_relation, rectified=rectified)
