"""Small rendered scans in memory, and the truth about their corners."""

from functools import lru_cache
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import Camera, scaled_rig, scan_position, transform
from lsvision.simulation import (
    Acquisition,
    EncoderConfig,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    Simulation,
    simulate,
)
from lsvision.stages.corners.find import LocatedCorners, find_corners, locate_in_images, measure_corners
from lsvision.types import Board, BoardCorners, DepthView, Motion, Rig, Scan, StereoPair, TensorImage, Transport

FULL_RIG = Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)
SMALL_RIG = scaled_rig(FULL_RIG, 16)
PITCH = 1.12
BOARD = Board(12, 9, 30.0)
MOTION = MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)
TILTED = SceneConfig(pitch_deg=6.0, roll_deg=-4.0, yaw_deg=92.0)
FINE_SENSOR = SensorConfig(supersampling=2)


@lru_cache(maxsize=8)
def simulation(
    scene: SceneConfig = TILTED, transport: Transport = "forward", encoder: EncoderConfig | None = None
) -> Simulation:
    """A board or sheet under the small rig, in motion."""
    return simulate(
        SMALL_RIG, BOARD, scene, MOTION, FINE_SENSOR, Acquisition(PITCH, transport=transport, encoder=encoder)
    )


def stereo_scan(source: Simulation) -> Scan:
    """The scan with both its images."""
    left, right = (TensorImage(_image(source, camera).clone()) for camera in ("left", "right"))
    return Scan(Path("rendered"), source.rig, source.travel, StereoPair(left, right))


def depth_scan(source: Simulation) -> Scan:
    """The scan as a camera that computes depth itself would store it."""
    left, depth = TensorImage(_image(source, "left").clone()), TensorImage(_depth(source).clone())
    return Scan(Path("rendered"), source.rig, source.travel, DepthView(left, depth))


@lru_cache(maxsize=8)
def _image(source: Simulation, camera: Camera) -> Tensor:
    """What a camera sees; rendered once for tests of the same scan."""
    return torch.cat(list(source.strips(camera)))


@lru_cache(maxsize=8)
def _depth(source: Simulation) -> Tensor:
    return torch.cat(list(source.depth_strips()))[..., None]


@lru_cache(maxsize=8)
def located(source: Simulation) -> LocatedCorners:
    """The board's corners in both images; found once for tests of the same scan."""
    return locate_in_images(stereo_scan(source), BOARD)


def stereo_corners(source: Simulation) -> BoardCorners:
    """The corners as both images measure them."""
    return measure_corners(stereo_scan(source), BOARD, located(source))


@lru_cache(maxsize=8)
def depth_corners(source: Simulation) -> BoardCorners:
    """The corners as one image and a depth map measure them."""
    return find_corners(depth_scan(source), BOARD)


def motion_of(*n: float) -> Motion:
    """A motion that is known exactly."""
    return Motion(torch.tensor(n, dtype=torch.float64), torch.zeros(3, 3, dtype=torch.float64))


def true_measurement(source: Simulation) -> Tensor:
    """True (x, travel, z), mm, of the board's corners."""
    points = transform(source.pose.rotation, source.pose.translation, BOARD.corner_points())
    return scan_position(points, source.trajectory.n)
