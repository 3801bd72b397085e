"""Rigs, a board, a motion and a sensor for most scans."""

import pytest
import torch

from lsvision.geometry import scaled_rig
from lsvision.simulation import MotionConfig, SensorConfig
from lsvision.types import Board, Rig


@pytest.fixture
def full_rig() -> Rig:
    return Rig(7142, 10.0, 113.84, 354.0, 1042.0, 6099.0)


@pytest.fixture
def small_rig(full_rig: Rig) -> Rig:
    return scaled_rig(full_rig, 8)


@pytest.fixture
def coarse(full_rig: Rig) -> Rig:
    return scaled_rig(full_rig, 16)


@pytest.fixture
def board() -> Board:
    return Board(12, 9, 30.0)


@pytest.fixture
def motion() -> MotionConfig:
    return MotionConfig(angle_x_deg=-1.5, angle_z_deg=0.8, stretch=1.0246)


@pytest.fixture
def clean() -> SensorConfig:
    return SensorConfig(noise=0.0, bits=16, supersampling=2)


@pytest.fixture
def whole():
    """The whole image, float64, of one camera."""

    def read(simulation, camera="left", strip_lines=256):
        return torch.cat(list(simulation.strips(camera, strip_lines))).double()

    return read
