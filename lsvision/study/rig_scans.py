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
from lsvision.types import Board


@dataclass(frozen=True)
class RigConditions(Checked):
    """One point of a study of raw rigs.

    ``boards`` scans lie across and along the travel in turn, tilted by ``tilt_deg`` about the sensor and the travel
    axis either way, ``depth_mm`` nearer or deeper than the middle of the depth, and as far to either side of the field
    as ``sideways`` says, 1 to its edge. ``column_sigma_px`` is the white noise of columns, ``line_sigma`` that of
    lines, which are ``line_pitch_mm`` apart. The true rig and motion are drawn from the prior, narrowed to the share
    ``off``.
    """

    boards: PositiveInt = 8
    tilt_deg: AcuteAngle = 4.0
    depth_mm: NonNegative = 20.0
    sideways: Share = 1.0
    column_sigma_px: Positive = 0.03
    line_sigma: Positive = 0.03
    line_pitch_mm: Positive = 0.07
    off: Share = 0.2


@dataclass(frozen=True)
class RigScans:
    """Rigs with their motions, and what they saw of boards: a batch of runs."""

    truth: Shared
    sightings: Sightings


def rig_scans(prior: RigPrior, board: Board, conditions: RigConditions, runs: int) -> RigScans:
    """Draw rigs and motions and scan boards with them; torch's generator of random numbers is used."""
    truth = prior.shared(conditions.off * torch.randn(runs, len(prior.sigma), dtype=torch.float64))
    each = Shared(truth.quantities[:, None], truth.n[:, None])
    return RigScans(truth, scanned(prior, each, board, conditions))


def scanned(prior: RigPrior, truth: Shared, board: Board, conditions: RigConditions) -> Sightings:
    """What true rigs see of boards that are placed by the data sheet.

    Args:
        truth: of every run and board, ``(runs, boards, ..)``, or of every run, ``(runs, 1, ..)``.
    """
    body = board.corner_points()
    body = body - body.mean(0)
    rotation, middle = _poses(prior, body, conditions, len(truth.n))
    points = transform(rotation, middle, body.expand(*middle.shape[:2], -1, 3))
    pair, n = RawPair.of(prior.rig, truth.quantities[..., None, :]), truth.n[..., None, :]
    sigma = torch.tensor(
        [conditions.column_sigma_px, conditions.line_sigma * conditions.line_pitch_mm], dtype=torch.float64
    )
    left, right = (
        _sighted(torch.stack([seen.column, seen.travel], dim=-1), sigma)
        for seen in (pair.seen_left(points, n), pair.seen_right(points, n))
    )
    return Sightings(left, right, torch.ones(points.shape[:-1], dtype=torch.bool), board.corner_points())


def _poses(
    prior: RigPrior, body: Float[Tensor, "corners 3"], conditions: RigConditions, runs: int
) -> tuple[Float[Tensor, "runs boards 3 3"], Float[Tensor, "runs boards 3"]]:
    """Rotations of boards and where their middles are: a balanced design, every pose off it by a little."""
    index = torch.arange(conditions.boards)
    a, b, c = (((index >> bit) & 1).double() for bit in range(3))
    along, about_x, about_y, sideways, deeper = (2 * (bits % 2) - 1 for bits in (a, b, c, b + c, a + b + c))
    nearly = 1 + 0.05 * (2 * torch.rand(5, runs, conditions.boards, dtype=torch.float64) - 1)
    zero = torch.zeros_like(nearly[0])
    angle = math.radians(conditions.tilt_deg)
    tilt = torch.stack([angle * about_x * nearly[0], angle * about_y * nearly[1], zero], dim=-1)
    yaw = torch.stack([zero, zero, math.pi / 4 * (1 + along) * nearly[2]], dim=-1)
    pair = RawPair.of(prior.rig)
    longer, shorter = (body.amax(0) - body.amin(0))[:2].tolist()
    extent = torch.where(along > 0, shorter, longer)
    room = (pair.field_mm(prior.rig.width_px) - extent).clamp(min=0) / 2
    places = [
        conditions.sideways * room * sideways * nearly[3],
        zero + longer,
        conditions.depth_mm * deeper * nearly[4],
    ]
    return rotation_from_vector(tilt) @ rotation_from_vector(yaw), pair.middle + torch.stack(places, dim=-1)


def _sighted(exact: Float[Tensor, "runs boards corners 2"], sigma: Float[Tensor, "2"]) -> CameraSighting:
    factor = sigma.diag().expand(*exact.shape, 2)
    return CameraSighting(exact + sigma * torch.randn_like(exact), factor)
