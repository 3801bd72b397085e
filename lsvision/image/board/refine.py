"""Corners of a board to a fraction of a pixel, from a grid that is good to about two pixels."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from lsvision.image.board.correlated_noise import BoardNoise, possible_covariance
from lsvision.image.board.edge_profile import board_noise
from lsvision.image.board.outliers import evenly_clipped, in_line_with_neighbours, like_the_board
from lsvision.image.board.saddle import SaddleOptions, fit_saddles
from lsvision.image.brightness import gray
from lsvision.image.missing import missing_mask, missing_near
from lsvision.types import LineImage, missing_ranges

_READ_LINES = 512
_MODEL_PX = 0.001  # the error that a sharp image without noise or texture leaves: a turned pixel is no box
_INTO_SQUARES = 0.4  # share of a square that a window takes in: blur and shift stay clear of the next edges
_FEWEST_PIXELS = 49  # of the squares in a window


@dataclass(frozen=True)
class DetectedCorners:
    """Corners of one board in one image, in the board's order: (column, line) px, covariance px², valid or not.

    ``noise`` is what the fits left of their windows, where it is known.
    """

    position: Float[Tensor, "corners 2"]
    covariance: Float[Tensor, "corners 2 2"]
    valid: Bool[Tensor, " corners"]
    noise: BoardNoise | None = None

    def covariance_with(self, other: "DetectedCorners") -> Float[Tensor, "corners 2 2"]:
        """Covariance, px², of the errors in this image with those of the same corners in another.

        Both images show the texture of the board: much of their error is the same.
        """
        covariance = torch.zeros_like(self.covariance)
        both = self.valid & other.valid
        if self.noise is not None and other.noise is not None and bool(both.any()):
            mixed = self.noise.covariance_with(other.noise, both)
            covariance[both] = possible_covariance(mixed, self.covariance[both], other.covariance[both])
        return covariance


@dataclass(frozen=True)
class GridSteps:
    """Steps from each corner of a grid to its neighbours along X and along Y, px."""

    along_x: Float[Tensor, "corners 2"]
    along_y: Float[Tensor, "corners 2"]

    @classmethod
    def of(cls, grid: Float[Tensor, "rows columns 2"]) -> "GridSteps":
        """Central differences, one-sided at the rim."""
        along_y, along_x = torch.gradient(grid, dim=(0, 1))
        return cls(along_x.reshape(-1, 2), along_y.reshape(-1, 2))

    def window_radius(self, largest: int) -> int:
        """Half the size of windows that reach into the four squares around their corners, px."""
        extent = _INTO_SQUARES * (self.along_x.abs() + self.along_y.abs()).amax()
        return int(extent.ceil().clamp(3, largest))

    def normal_angles(self) -> Float[Tensor, "corners 2"]:
        """Direction of the normals of the edges along X and along Y, rad: a quarter turn from the edges."""
        return torch.stack([torch.atan2(d[:, 1], d[:, 0]) + torch.pi / 2 for d in (self.along_x, self.along_y)], dim=-1)

    def within_squares(self, radius: int) -> Bool[Tensor, "corners size size"]:
        """Pixels of windows that lie well within the four squares around their corners."""
        steps = torch.stack([self.along_x, self.along_y], dim=-1)
        span = torch.arange(-radius, radius + 1, dtype=steps.dtype)
        offset = torch.stack(torch.meshgrid(span, span, indexing="xy")).flatten(1)
        share = torch.linalg.solve(steps, offset.expand(len(steps), 2, -1))
        mask = (share.abs() < _INTO_SQUARES).all(1).unflatten(-1, (len(span), len(span)))
        # Corners closer than four pixels leave too few pixels for a fit: then the whole window is used.
        return mask | (mask.sum((1, 2)) < _FEWEST_PIXELS)[:, None, None]


def refine_grid(
    image: LineImage, grid: Float[Tensor, "rows columns 2"], *, largest_radius: int = 13, plain: bool = False
) -> DetectedCorners:
    """Locate corners at full size, from a grid good to about two pixels: one batch of windows, fitted together.

    A window reaches into the four squares around its corner, at any angle, shear and stretch, and at most
    ``largest_radius`` px: past it the board's texture weighs more than what is gained. A ``plain`` fit is good to a few
    hundredths of a pixel; its covariance is that of independent noise.
    """
    steps = GridSteps.of(grid)
    radius = steps.window_radius(largest_radius)
    centre = grid.reshape(-1, 2).round().long()
    inside = lies_within(image, centre, radius)
    windows, brightest = read_windows(image, centre, inside, radius)
    mask = steps.within_squares(radius)
    fit = fit_saddles(windows, steps.normal_angles().to(windows), mask, SaddleOptions(plain=plain))
    valid = like_the_board(fit, fit.valid & inside)
    if not plain:
        valid = evenly_clipped(brightest, mask, valid)
        valid = in_line_with_neighbours((centre + fit.position).reshape(grid.shape), valid)
    covariance = torch.full_like(fit.covariance, torch.nan)
    noise = None
    if plain:
        covariance[valid] = fit.covariance[valid]
    elif bool(valid.any()):
        noise = board_noise(fit, valid)
        covariance[valid] = noise.covariance(valid) + _MODEL_PX**2 * torch.eye(2).to(windows)
    position = torch.where(valid[:, None], centre + fit.position, torch.nan)
    return DetectedCorners(position, covariance, valid, noise)


def lies_within(image: LineImage, centre: Int[Tensor, "corners 2"], radius: int) -> Bool[Tensor, " corners"]:
    """Whether the square windows around (column, line) lie within an image, and none of their lines is missing."""
    lines, width, _ = image.shape
    inside = ((centre >= radius) & (centre < torch.tensor([width, lines]) - radius)).all(-1)
    if missing_ranges(image):
        spoiled = missing_near(missing_mask(image, torch.arange(lines)), radius)
        inside &= ~spoiled[centre[:, 1].clamp(0, lines - 1)]
    return inside


def read_windows(
    image: LineImage, centre: Int[Tensor, "corners 2"], wanted: Bool[Tensor, " corners"], radius: int
) -> tuple[Float[Tensor, "corners size size"], Float[Tensor, "corners size size"]]:
    """Brightness in square windows around (column, line), and the largest of their colours; float64.

    0 where a window is not wanted.
    """
    size = 2 * radius + 1
    windows = torch.zeros(centre.shape[0], size, size, dtype=torch.float64)
    brightest = torch.zeros_like(windows)
    span = torch.arange(size) - radius
    first = centre[:, 1] - radius
    for start in range(0, image.shape[0], _READ_LINES):
        here = wanted & (first >= start) & (first < start + _READ_LINES)
        if not bool(here.any()):
            continue
        strip = image.read(start, min(image.shape[0], start + _READ_LINES + size))
        rows = (centre[here, 1, None] + span - start)[:, :, None]
        columns = (centre[here, 0, None] + span)[:, None, :]
        pixels = strip[rows, columns]
        windows[here] = gray(pixels).to(torch.float64)
        brightest[here] = pixels.to(torch.float64).amax(-1)  # 16 bit has no maximum
    return windows, brightest
