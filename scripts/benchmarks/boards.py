"""Boards that are hard to find: partly beyond the images, faint, unevenly lit or partly hidden; seconds play no part.

Rendered scans, 446 px wide, whose corners are known. Of boards cut off by the images' borders, and of boards with
something in front of them, a scan is right where every corner that counts as measured is; of faint and unevenly lit
boards each image counts, and OpenCV's findChessboardCornersSB is asked for the same ones.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import torch
from torch import Tensor

from lsvision.errors import BoardNotFoundError
from lsvision.geometry import scaled_rig, scan_position, transform
from lsvision.image.board.detect import detect_board
from lsvision.simulation import Acquisition, MotionConfig, SceneConfig, SensorConfig, simulate
from lsvision.stages.corners.find import find_corners
from lsvision.types import Board, Rig, Scan, StereoPair, TensorImage

RIG = scaled_rig(Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0), 16)
BOARD = Board(12, 9, 30.0)
PITCH, SQUARE_PX = 1.12, 27
MOTION = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
YAWS = (2.0, 21.0, 48.0, 93.0, 137.0, 216.0, 301.0)
TILTS = ((5.0, -4.0), (-3.0, 6.0), (0.0, 0.0))
RIGHT_MM, RIGHT_PX = (0.2, 0.2, 0.5), 0.3


@dataclass(frozen=True)
class View:
    """Both images of a board, grey, and the true points (mm) and pixels of its corners."""

    images: tuple[Tensor, Tensor]
    points: Tensor
    pixels: tuple[Tensor, Tensor]
    rig: Rig = RIG

    def outcome(self) -> str:
        """Whether the corners that count as measured are right."""
        left, right = (TensorImage(image.round().clamp(0, 255).to(torch.uint8)[..., None]) for image in self.images)
        source = Scan(Path("rendered"), self.rig, TRAVEL, StereoPair(left, right))
        try:
            corners = find_corners(source, BOARD)
        except BoardNotFoundError:
            return "refused"
        error = (corners.points - self.points)[corners.valid]
        if bool((error.abs() < torch.tensor(RIGHT_MM)).all()):
            return "right"
        # A board that goes beyond both ends of an image may be counted from another square: its motion is the same.
        return "shifted" if bool(((error - error.mean(0)).abs() < torch.tensor(RIGHT_MM)).all()) else "wrong"


TRAVEL = simulate(RIG, BOARD, SceneConfig(), MOTION, SensorConfig(), Acquisition(PITCH)).travel


def run() -> dict[str, object]:
    """Counts by kind; ``ratio`` is the faint and unevenly lit boards that we find over those that OpenCV does."""
    torch.set_num_threads(1)
    torch.manual_seed(0)
    cut = Counter(view.outcome() for yaw in (2.0, 93.0, 216.0) for view in _cut(_rendered(yaw, TILTS[0])))
    hidden = Counter(view.outcome() for yaw in YAWS for view in _hidden(_rendered(yaw, TILTS[0])))
    hard = sum((_found(_rendered(yaw, tilt)) for yaw, tilt in itertools.product(YAWS, TILTS)), Counter())
    return {
        "cut off": dict(cut),
        "hidden": dict(hidden),
        "faint or unevenly lit": dict(hard),
        "ratio": round(hard["lsvision"] / max(1, hard["opencv"]), 2),
    }


def _rendered(yaw_deg: float, tilt: tuple[float, float]) -> View:
    scene = SceneConfig(pitch_deg=tilt[0], roll_deg=tilt[1], yaw_deg=yaw_deg)
    source = simulate(RIG, BOARD, scene, MOTION, SensorConfig(supersampling=2), Acquisition(PITCH))
    left, right = (torch.cat(list(source.strips(camera))).float().mean(-1) for camera in ("left", "right"))
    points = transform(source.pose.rotation, source.pose.translation, BOARD.corner_points())
    return View((left, right), scan_position(points, source.trajectory.n), source.corners())


def _cut(whole: View) -> Iterator[View]:
    """Eleven ways to lose a part of a board beyond the border: on either side of either image, before or after."""
    for squares, *sides in itertools.product((1.5, 2.4), ("left", "right"), ("left", "right")):
        yield _cut_aside(whole, sides, squares)
    line = whole.pixels[0][:, 1]
    first, last = int(line.min() + 2.4 * SQUARE_PX), int(line.max() - 2.4 * SQUARE_PX)
    for start, stop in ((first, None), (0, last), (first - SQUARE_PX, last + SQUARE_PX)):
        points = whole.points - whole.points.new_tensor([0.0, start * PITCH, 0.0])
        yield replace(whole, images=tuple(image[start:stop] for image in whole.images), points=points)


def _cut_aside(whole: View, sides: list[str], squares: float) -> View:
    width = RIG.width_px - max(_columns_lost(px, side, squares) for px, side in zip(whole.pixels, sides, strict=True))
    first = [
        _columns_lost(px, side, squares) if side == "left" else RIG.width_px - _columns_lost(px, side, squares) - width
        for px, side in zip(whole.pixels, sides, strict=True)
    ]
    images = tuple(image[:, start : start + width] for image, start in zip(whole.images, first, strict=True))
    centres = RIG.principal_left_px - first[0], RIG.principal_right_px - first[1]
    rig = replace(RIG, width_px=width, principal_left_px=centres[0], principal_right_px=centres[1])
    return replace(whole, images=images, rig=rig)


def _columns_lost(px: Tensor, side: str, squares: float) -> int:
    """Columns that must go for some squares of a board to be lost on one side."""
    inside = float(px[:, 0].min()) if side == "left" else RIG.width_px - float(px[:, 0].max())
    return int(inside + squares * SQUARE_PX)


def _hidden(whole: View) -> Iterator[View]:
    """Grey clamps over the middle, the rim and the corners of the board, and glare in its middle, in both images."""
    for corner in (38, 5, 0, 87):
        yield _spoiled(whole, corner, _clamp)
    yield _spoiled(whole, 38, _glare)


def _spoiled(whole: View, corner: int, spoil: Callable[[Tensor, Tensor, Tensor], Tensor]) -> View:
    images = []
    for image, px in zip(whole.images, whole.pixels, strict=True):
        v, u = torch.meshgrid(torch.arange(image.shape[0]), torch.arange(image.shape[1]), indexing="ij")
        images.append(spoil(image, (u - px[corner, 0]) / SQUARE_PX, (v - px[corner, 1]) / SQUARE_PX))
    return replace(whole, images=tuple(images))


def _clamp(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    return torch.where(((u - 0.2).abs() < 0.7) & ((v + 0.3).abs() < 0.9), 80.0, image)


def _glare(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    return image + 400 * torch.exp(-(u.square() + v.square()) / 3)


def _found(whole: View) -> Counter:
    """Boards found in both images at low contrast, under light that falls off, and both; a wrong one is not found."""
    found = Counter(images=0, lsvision=0, opencv=0)
    for contrast, fall_off in ((0.2, 0.0), (0.2, 0.45), (1.0, 0.45)):
        for image, px in zip(whole.images, whole.pixels, strict=True):
            light = 1 - fall_off * torch.linspace(0, 1, image.shape[1])
            picture = (110 + contrast * (image * light - 110) + torch.randn(image.shape)).round().to(torch.uint8)
            corners = detect_board(TensorImage(picture[..., None]), BOARD)
            right = corners is not None and bool(
                ((corners.position - px)[corners.valid].abs() < RIGHT_PX).all() and corners.valid.sum() >= 80
            )
            seen, _ = cv2.findChessboardCornersSB(picture.numpy(), BOARD.inner, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
            found.update(images=1, lsvision=int(right), opencv=int(seen))
    return found
