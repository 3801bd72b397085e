"""Flat printed targets and the conveyor under them: the colour and depth that each ray sees."""

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import torch
from torch import Tensor

from lsvision.simulation.artwork import sheet_raster
from lsvision.simulation.config import SceneConfig
from lsvision.simulation.lighting import Lighting
from lsvision.simulation.noise import Raster, covering, octaves, value_noise
from lsvision.simulation.plane import PlaneView, coverage, footprint, square_wave, view_plane
from lsvision.simulation.trajectory import Rays
from lsvision.types import Board, Pose

_INK = 0.05  # reflectance of a black square over that of a white one
_BOARD_TINT = (0.84, 0.82, 0.79)
_CONVEYOR_TINT = (0.205, 0.200, 0.185)
_CONVEYOR_CONTRAST = 0.25
_OCTAVES = octaves(6)


@dataclass(frozen=True)
class Look:
    """Colour ``(3, h, w)`` that rays see, 1 for a perfectly white and fully lit surface, and depth z ``(h, w)``, mm."""

    color: Tensor
    z: Tensor


class Scene(Protocol):
    """Surfaces under the cameras."""

    def look(self, rays: Rays) -> Look:
        """Colour and depth of the first surface that each ray meets."""
        ...


@dataclass(frozen=True)
class Conveyor:
    """An endless dark plane along the motion."""

    pose: Pose
    lighting: Lighting
    texture_mm: float
    seed: int

    def look(self, rays: Rays) -> Look:
        """Colour and depth of the conveyor."""
        view = view_plane(rays, self.pose, self.texture_mm)
        nodes = covering(view.x, view.y, self.texture_mm, view.base_y)
        grain = value_noise(nodes, _OCTAVES, 8 * self.seed + 4).mul_(_CONVEYOR_CONTRAST).add_(1.0).clamp_(0.2, 2.0)
        albedo = Raster(grain[None], nodes).at(view.x, view.y, view.base_y)
        return Look(tinted(albedo.mul_(light_on(self.lighting, self.pose, view)), _CONVEYOR_TINT), view.z)


@dataclass(frozen=True)
class BoardScene:
    """A checkerboard with a white border, over the conveyor."""

    board: Board
    config: SceneConfig
    pose: Pose
    lighting: Lighting
    conveyor: Conveyor

    def look(self, rays: Rays) -> Look:
        """Colour and depth; the edges of the squares are filtered over the box of each sample."""
        view = view_plane(rays, self.pose, self.config.texture_mm)
        x, y = view.x, view.y + view.base_y * self.config.texture_mm
        squares, border_x, border_y = (
            squares_of(self.board),
            self.config.board_border_x_mm,
            self.config.board_border_y_mm,
        )
        side, right, bottom = squares.side_mm, squares.right_mm, squares.bottom_mm
        width_x, width_y = footprint(x), footprint(y)
        inside = coverage(x, -side - border_x, right + border_x, width_x)
        inside *= coverage(y, -side - border_y, bottom + border_y, width_y)
        # Black where column and row of a square, counted from the pattern's first corner, are both even or both odd.
        black = square_wave(x, side, width_x).mul_(square_wave(y, side, width_y)).add_(1.0).mul_(0.5 * (1.0 - _INK))
        black.mul_(coverage(x, -side, right, width_x)).mul_(coverage(y, -side, bottom, width_y))
        albedo = self._grain.at(x, y).mul_(black.neg_().add_(1.0)).mul_(light_on(self.lighting, self.pose, view))
        return over(self.conveyor.look(rays), Look(tinted(albedo, _BOARD_TINT), view.z), inside)

    @cached_property
    def _grain(self) -> Raster:
        """Weak texture of the whole board, without which stereo matching finds nothing on its plain squares."""
        squares = squares_of(self.board)
        side = squares.side_mm
        corners = torch.tensor([[-side, -side], [squares.right_mm, squares.bottom_mm]])
        border = torch.tensor([self.config.board_border_x_mm, self.config.board_border_y_mm])
        corners = corners + torch.tensor([[-1.0], [1.0]]) * border
        nodes = covering(corners[:, 0], corners[:, 1], self.config.texture_mm)
        grain = value_noise(nodes, _OCTAVES, 8 * self.config.seed + 5)
        return Raster(grain.mul_(self.config.board_texture).add_(1.0)[None], nodes)


@dataclass(frozen=True)
class SheetScene:
    """A printed sheet over the conveyor."""

    config: SceneConfig
    pose: Pose
    lighting: Lighting
    conveyor: Conveyor

    def look(self, rays: Rays) -> Look:
        """Colour and depth."""
        view = view_plane(rays, self.pose, self.config.texture_mm)
        x, y = view.x, view.y + view.base_y * self.config.texture_mm
        inside = coverage(x, 0.0, self.config.sheet_width_mm, footprint(x))
        inside *= coverage(y, 0.0, self.config.sheet_height_mm, footprint(y))
        color = sheet_raster(self.config).at(x, y).mul_(light_on(self.lighting, self.pose, view))
        return over(self.conveyor.look(rays), Look(color, view.z), inside)


@dataclass(frozen=True)
class Squares:
    """Side of a board's squares and where they end in its frame, mm; they begin at minus one side on both axes."""

    side_mm: float
    right_mm: float
    bottom_mm: float


def squares_of(board: Board) -> Squares:
    """The squares of a board, whose frame has its origin at the first inner corner."""
    side = board.square_mm
    return Squares(side, (board.columns - 1) * side, (board.rows - 1) * side)


def over(below: Look, above: Look, share: Tensor) -> Look:
    """One surface before another, covering the given share of each sample."""
    color = torch.lerp(below.color, above.color, share)
    return Look(color, torch.where(share >= 0.5, above.z, below.z))


def tinted(albedo: Tensor, tint: tuple[float, float, float]) -> Tensor:
    """Grey values ``(1, h, w)`` times a colour: ``(3, h, w)``."""
    return albedo * albedo.new_tensor(tint)[:, None, None]


def light_on(lighting: Lighting, pose: Pose, view: PlaneView) -> Tensor:
    """Brightness on a plane whose frame's Z points away from the cameras."""
    normal = -pose.rotation[:, 2]
    return lighting.irradiance(view.scan_x, view.z, float(normal[0]), float(normal[2]))
