"""Corners of raw images as the ideal pair would have seen them: both cameras in one plane, columns without distortion.

What follows then needs no more than a rectified pair: the rays of the ideal columns meet where those of the raw ones do
(``RawPair.meet``), and the right line is the one on which the left camera's plane shows the point.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import Rectification, line_at, project, travel_at
from lsvision.image.board.lattice import SeenLattice
from lsvision.types import Travel


@dataclass(frozen=True)
class IdealCorners:
    """Places (column, line) of corners in both ideal images, and how fast an ideal column grows with a raw one.

    ``later_mm`` is the travel after which the right camera saw each; None where both see it at once.
    """

    left: Float[Tensor, "corners 2"]
    right: Float[Tensor, "corners 2"]
    left_growth: Float[Tensor, " corners"]
    right_growth: Float[Tensor, " corners"]
    later_mm: Float[Tensor, " corners"] | None = None

    @classmethod
    def of(
        cls,
        left: Float[Tensor, "corners 2"],
        right: Float[Tensor, "corners 2"],
        rectification: Rectification | None,
        travel: Travel,
    ) -> "IdealCorners":
        """Those of places in the images of a scan; the same where nothing is to be rectified."""
        if rectification is None:
            return cls(left, right, torch.ones_like(left[:, 0]), torch.ones_like(right[:, 0]))
        met = rectification.raw.meet(left[:, 0], right[:, 0], rectification.n)
        columns = project(rectification.rig, met.x, met.z)
        right_line = line_at(travel, travel_at(travel, right[:, 1]) - met.later_mm)
        return cls(
            torch.stack([columns[0], left[:, 1]], dim=-1),
            torch.stack([columns[1], right_line], dim=-1),
            rectification.growth(left[:, 0], "left"),
            rectification.growth(right[:, 0], "right"),
            met.later_mm if bool(rectification.raw.plane.any()) else None,
        )


def ideal_lattice(seen: SeenLattice, rectification: Rectification | None, *, right: bool = False) -> SeenLattice:
    """A lattice of an image with the columns of the ideal one."""
    if rectification is None:
        return seen
    column = rectification.ideal_column(seen.position[:, 0], "right" if right else "left")
    return SeenLattice(seen.node, torch.stack([column, seen.position[:, 1]], dim=-1))


def lines_apart(
    left: Float[Tensor, "left 2"], right: Float[Tensor, "right 2"], rectification: Rectification | None, travel: Travel
) -> Float[Tensor, "left right"]:
    """How many lines apart a place of the left and one of the right ideal image lie if they show the same point."""
    right_line = right[None, :, 1]
    if rectification is not None:
        later = rectification.meet(left[:, None, 0], left[:, None, 0] - right[None, :, 0]).later_mm
        right_line = line_at(travel, travel_at(travel, right_line) - later)
    return (left[:, None, 1] - right_line).abs()
