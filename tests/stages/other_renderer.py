"""The four tilts that a separate program rendered: their scans, corners and truth, found once for all tests."""

import json
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import scan_position, transform
from lsvision.io import read_scan
from lsvision.stages.corners.find import find_corners
from lsvision.types import BoardCorners, Scan
from tests.stages.rendered import BOARD


@cache
def tilt_scans(shared_data: Path) -> tuple[Scan, ...]:
    """Scans tilt_a..tilt_d."""
    return tuple(read_scan(shared_data / "scans_other_renderer" / f"tilt_{name}") for name in "abcd")


@cache
def tilt_corners(shared_data: Path) -> tuple[BoardCorners, ...]:
    """The corners found in each scan."""
    return tuple(find_corners(scan, BOARD) for scan in tilt_scans(shared_data))


def true_motion(scan: Scan) -> Tensor:
    """The n that the scan was rendered with."""
    return torch.tensor(_truth(scan)["n"], dtype=torch.float64)


def true_points(scan: Scan) -> Tensor:
    """True (x, travel, z), mm, of the corners."""
    truth = _truth(scan)
    rotation, translation = (torch.tensor(truth[key], dtype=torch.float64) for key in ("R", "T"))
    return scan_position(transform(rotation, translation, BOARD.corner_points()), true_motion(scan))


def _truth(scan: Scan) -> dict:
    return json.loads((scan.path / "truth.json").read_text())
