"""Boards that separate programs rendered: their scans, corners and truth, found once for all tests."""

import dataclasses
import json
from functools import cache
from pathlib import Path

import torch
from torch import Tensor

from lsvision.geometry import RawPair, ideal_rig, scan_position, transform
from lsvision.io import read_scan
from lsvision.stages.corners.find import LocatedCorners, find_corners, locate_in_images
from lsvision.types import BoardCorners, RawCamera, Scan, ViewPlane
from tests.stages.rendered import BOARD

_THEIR_Z0_MM = 796.9


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
    rotation, translation = true_pose(scan)
    return scan_position(transform(rotation, translation, BOARD.corner_points()), true_motion(scan))


def true_pose(scan: Scan) -> tuple[Tensor, Tensor]:
    """R and T of the board."""
    truth = _truth(scan)
    rotation, translation = (torch.tensor(truth[key], dtype=torch.float64) for key in ("R", "T"))
    return rotation, translation


def _truth(scan: Scan) -> dict:
    return json.loads((scan.path / "truth.json").read_text())


@cache
def raw_scans(shared_data: Path) -> tuple[Scan, ...]:
    """Scans raw_a..raw_h of a raw rig, with the rig that they were rendered with in place of the data sheet's."""
    return tuple(raw_scan(shared_data, f"raw_{name}") for name in "abcdefgh")


@cache
def raw_located(shared_data: Path, name: str) -> LocatedCorners:
    """The corners in both images of one of these scans."""
    return locate_in_images(raw_scan(shared_data, name), BOARD)


def raw_scan(shared_data: Path, name: str) -> Scan:
    """One of the scans of a raw rig, with the rig that it was rendered with."""
    scan = read_scan(shared_data / "scans_shaken_and_raw" / name)
    truth = _truth(scan)
    pitch_mm = scan.raw_rig.pixel_pitch_um * 1e-3
    left, right = (
        RawCamera(side["f_px"] * pitch_mm, side["c"], side["turn"], (side["k1"], side["k2"]))
        for side in (truth["left"], truth["right"])
    )
    view = ViewPlane(*(truth["right"][key] for key in ("s0", "s1", "s2")))
    raw = dataclasses.replace(scan.raw_rig, left=left, right=right, view_plane=view)
    # Their plane counts depth from another z0 than ours does.
    moved = view.slope_z * (float(RawPair.of(raw).z0_mm) - _THEIR_Z0_MM)
    raw = dataclasses.replace(raw, view_plane=dataclasses.replace(view, offset_mm=view.offset_mm + moved))
    return dataclasses.replace(scan, raw_rig=raw, rig=ideal_rig(raw))
