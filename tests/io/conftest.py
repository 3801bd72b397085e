"""A small scan on disk and the calibration that goes with it."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch

from lsvision.io import NewScan, write_scan
from lsvision.types import (
    BoardFit,
    Calibration,
    ErrorAlongScan,
    Iteration,
    Motion,
    Observability,
    ObservedDirection,
    Pose,
    Provenance,
    Rig,
    Travel,
)

LINES, WIDTH = 300, 32


@pytest.fixture
def small_rig() -> Rig:
    return Rig(WIDTH, 80.0, 113.84, 354.0, 4.5, 27.25)


@pytest.fixture
def images() -> tuple[torch.Tensor, torch.Tensor]:
    return tuple(torch.randint(0, 256, (2, LINES, WIDTH, 3), dtype=torch.uint8))


@pytest.fixture
def make_scan(tmp_path: Path, small_rig: Rig, images) -> Callable[..., Path]:
    """Write a small scan; keyword arguments replace those of ``NewScan``."""

    def make(name: str = "scan", **changes: object) -> Path:
        left, right = images
        arguments = {
            "rig": small_rig,
            "travel": Travel(0.56),
            "left": [left[:100], left[100:]],
            "right": [right],
            "lines": LINES,
        }
        write_scan(tmp_path / name, NewScan(**(arguments | changes)))
        return tmp_path / name

    return make


@pytest.fixture
def calibration(small_rig: Rig) -> Calibration:
    n = torch.tensor([-0.0257, 0.9845, 0.1 + 0.2], dtype=torch.float64)
    root = torch.randn(3, 3, dtype=torch.float64) * 1e-4
    board = BoardFit(
        scan="scans/Tür 1",
        corners=88,
        pose=Pose(torch.eye(3).double(), torch.tensor([1.0, 2.0, 797.3], dtype=torch.float64)),
        rmse_before_mm=2.1,
        rmse_after_mm=0.05,
        reduced_chi_square=1.5,
    )
    direction = ObservedDirection((0.0, 0.6, 0.8), 0.05, 2.5e-5, True)
    return Calibration(
        method="joint",
        motion=Motion(n, root @ root.mT),
        rmse_before_mm=2.059,
        rmse_after_mm=0.8794,
        iterations=(Iteration(2.059, (0.0, 1.0, 0.0), 1.0), Iteration(1 / 3, (-0.02, 0.98, 0.3), 1.02)),
        boards=(board,),
        observability=Observability((direction,), "tilt the board by 15° about the sensor axis"),
        rig=small_rig,
        verdict="inconsistent",
        reasons=("scan b ran 3.0 % faster than a",),
        noise_scale=2.5,
        errors_along_scan=(ErrorAlongScan("x", 0.03, 230.0), ErrorAlongScan("travel", 0.01, 61.5)),
        provenance=Provenance("0.1.0", "ab" * 32, (("scans/a", "cd" * 32),)),
    )
