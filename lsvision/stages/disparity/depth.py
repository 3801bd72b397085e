"""Disparity -> depth: the depth map of a stereo scan, matched where it is read."""

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import torch
from torch import Tensor

from lsvision.geometry import depth_at
from lsvision.image.brightness import white_level
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.match import measure_block
from lsvision.types import LineImage, Rig, Scan


def depth_sigma(depth: Tensor, sigma: Tensor, rig: Rig) -> Tensor:
    """Standard deviation of depths, mm, from that of their disparities, px: ``dz/dd = -z² / (f B)``."""
    return depth.square() * (sigma / (rig.focal_length_px * rig.baseline_mm))


@dataclass
class MatchedDepth:
    """The depth map of a stereo scan as a ``LineImage``: float32 z in mm, NaN for none, matched where it is read.

    The last blocks stay in memory, since neighbouring reads overlap.
    """

    scan: Scan
    config: DisparityConfig = field(default_factory=DisparityConfig)
    kept_blocks: int = 3
    _blocks: OrderedDict[int, tuple[Tensor, Tensor]] = field(default_factory=OrderedDict, init=False, repr=False)

    @property
    def shape(self) -> tuple[int, int, int]:
        """(lines, width, 1)."""
        return self.scan.lines, self.scan.rig.width_px, 1

    @property
    def dtype(self) -> torch.dtype:
        """float32."""
        return torch.float32

    def read(self, start: int, stop: int) -> Tensor:
        """Depth of lines ``start..stop-1``, ``(stop - start, width, 1)`` in mm."""
        return self._read(start, stop, 0)

    def read_sigma(self, start: int, stop: int) -> Tensor:
        """Standard deviation of the depth of lines ``start..stop-1``, ``(stop - start, width, 1)`` in mm."""
        return self._read(start, stop, 1)

    def _read(self, start: int, stop: int, which: Literal[0, 1]) -> Tensor:
        size = self.config.block_lines
        first, last = start // size, (stop - 1) // size
        blocks = [self._block(index)[which] for index in range(first, last + 1)]
        lines = slice(start - first * size, stop - first * size)
        return (blocks[0] if len(blocks) == 1 else torch.cat(blocks))[lines, :, None]

    def _block(self, index: int) -> tuple[Tensor, Tensor]:
        if index not in self._blocks:
            self._blocks[index] = self._match(index)
            while len(self._blocks) > self.kept_blocks:
                self._blocks.popitem(last=False)
        self._blocks.move_to_end(index)
        return self._blocks[index]

    @cached_property
    def _white(self) -> float:
        assert self.scan.right is not None
        return white_level(self.scan.left, self.scan.right)

    def _match(self, index: int) -> tuple[Tensor, Tensor]:
        """Depth and its standard deviation, each (lines, width)."""
        assert self.scan.right is not None
        match = measure_block(self.scan.left, self.scan.right, self.scan.rig, self.config, self._white, index)
        depth = depth_at(self.scan.rig, match.disparity)
        return depth, depth_sigma(depth, match.sigma, self.scan.rig)


def depth_of(scan: Scan, config: DisparityConfig) -> LineImage:
    """The scan's own depth map where a camera computed one, else the one matched from its two images."""
    return scan.depth if scan.depth is not None else MatchedDepth(scan, config)
