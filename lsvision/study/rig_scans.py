"""Scans of boards by raw rigs that differ from their data sheet: what both cameras would see of the corners."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.geometry import RawPair, rotation_from_vector, transform
from lsvision.schema import AcuteAngle, Checked, NonNegative, Positive, PositiveInt, Share
from lsvision.stages.rig.model import RigPrior, Shared
from lsvision.stages.rig.sightings import CameraSighting, Sightings
from lsvision.types import Board, Pose, RawRig


@dataclass(frozen=True)
class RigConditions(Checked):
    """One point of a study of raw rigs.

    ``boards`` scans lie across and along the travel in turn, tilted by ``tilt_deg`` about the sensor and the travel
    axis either way, ``depth_mm`` nearer or deeper than the middle of the depth, and as far to either side of the field
    as ``sideways`` says, 1 to its edge. ``column_sigma_px`` is the white noise of columns, ``line_sigma`` that of
    lines, which are ``line_pitch_mm`` apart. The deviations of the true rigs from the data sheet are multiplied
    by ``off``.
    """

    boards: PositiveInt = 8
    tilt_deg: AcuteAngle = 4.0
    depth_mm: NonNegative = 20.0
    sideways: Share = 1.0
    column_sigma_px: Positive = 0.03
    line_sigma: Positive = 0.03
    line_pitch_mm: Positive = 0.07
    off: Positive = 1.0


@dataclass(frozen=True)
class RigScans:
    """Rigs with their motions, where boards lay before line 0, and what was seen of them: a batch of runs.

    ``state`` is the true rigs and motions in units of what they were drawn from.
    """

    truth: Shared
    state: Float[Tensor, "runs shared"]
    poses: Pose
    sightings: Sightings


def rig_scans(drawn: RigPrior, board: Board, conditions: RigConditions, runs: int) -> RigScans:
    """Draw rigs and motions and scan boards with them; torch's generator of random numbers is used."""
    state = conditions.off * torch.randn(runs, len(drawn.root), dtype=torch.float64)
    truth = drawn.shared(state)
    each = Shared(truth.quantities[:, None], truth.n[:, None])
    poses = board_poses(drawn.rig, board, conditions, runs)
    return RigScans(truth, state, poses, scanned(drawn.rig, each, poses, board, conditions))


def scanned(rig: RawRig, truth: Shared, poses: Pose, board: Board, conditions: RigConditions) -> Sightings:
    """What true rigs see of boards.

    Args:
        rig: the data sheet. truth: of every run and board, ``(runs, boards, ..)``, or of every run, ``(runs, 1, ..)``.
        poses: of the middles of the boards, ``(runs, boards, ..)``.
    """
    body = from_middle(board).expand(*poses.translation.shape[:2], -1, 3)
    points = transform(poses.rotation, poses.translation, body)
    pair, n = RawPair.of(rig, truth.quantities[..., None, :]), truth.n[..., None, :]
    sigma = torch.tensor(
        [conditions.column_sigma_px, conditions.line_sigma * conditions.line_pitch_mm], dtype=torch.float64
    )
    left, right = (
        _sighted(torch.stack([seen.column, seen.travel], dim=-1), sigma)
        for seen in (pair.seen_left(points, n), pair.seen_right(points, n))
    )
    return Sightings(left, right, torch.ones(points.shape[:-1], dtype=torch.bool), board.corner_points())


def from_middle(board: Board) -> Float[Tensor, "corners 3"]:
    """The corners of a board from their middle, mm."""
    points = board.corner_points()
    return points - points.mean(0)


def board_poses(rig: RawRig, board: Board, conditions: RigConditions, runs: int) -> Pose:
    """Poses of the middles of boards by the data sheet: a balanced design, every pose off it by a little."""
    index = torch.arange(conditions.boards)
    a, b, c = (((index >> bit) & 1).double() for bit in range(3))
    along, about_x, about_y, sideways, deeper = (2 * (bits % 2) - 1 for bits in (a, b, c, b + c, a + b + c))
    nearly = 1 + 0.05 * (2 * torch.rand(5, runs, conditions.boards, dtype=torch.float64) - 1)
    zero = torch.zeros_like(nearly[0])
    angle = math.radians(conditions.tilt_deg)
    tilt = torch.stack([angle * about_x * nearly[0], angle * about_y * nearly[1], zero], dim=-1)
    yaw = torch.stack([zero, zero, math.pi / 4 * (1 + along) * nearly[2]], dim=-1)
    pair, body = RawPair.of(rig), from_middle(board)
    longer, shorter = (body.amax(0) - body.amin(0))[:2].tolist()
    extent = torch.where(along > 0, shorter, longer)
    room = (pair.field_mm(rig.width_px) - extent).clamp(min=0) / 2
    places = [
        conditions.sideways * room * sideways * nearly[3],
        zero + longer,
        conditions.depth_mm * deeper * nearly[4],
    ]
    rotation = rotation_from_vector(tilt) @ rotation_from_vector(yaw)
    return Pose(rotation, pair.middle + torch.stack(places, dim=-1))


def _sighted(exact: Float[Tensor, "runs boards corners 2"], sigma: Float[Tensor, "2"]) -> CameraSighting:
    factor = sigma.diag().expand(*exact.shape, 2)
    return CameraSighting(exact + sigma * torch.randn_like(exact), factor)
