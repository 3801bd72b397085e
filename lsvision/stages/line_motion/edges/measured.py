"""Scan + registered profile of a flat object -> lines registered with what its straight edges show of their δx.

1. Tracks of edges along the travel in the left image (``tracks``).
2. Those on the object that agree, and the displacement that makes them straight (``agreeing``, ``common``).
3. Joined with what the profile of the object alone shows of δz and roll, for the smoother.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.geometry import ProductFrame, Rectification
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import relation_of_scan
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.edges.agreeing import TOO_FEW, Agreed, agreed
from lsvision.stages.line_motion.edges.cells import Cells
from lsvision.stages.line_motion.edges.common import CommonMotion, EdgeFit
from lsvision.stages.line_motion.edges.edge_lines import EdgeLines
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.edges.tracks import find_tracks
from lsvision.stages.line_motion.errors import LineErrors
from lsvision.stages.line_motion.register import LOOSE_SIGMA
from lsvision.stages.line_motion.registration import RegisteredScan
from lsvision.types import LineMotion, Scan

_FEWEST_LINES, _MOST_LINES = 64, 32768  # eight tracks take 11 kB a line


@dataclass(frozen=True)
class EdgeMotion:
    """Displacement sideways that straight edges show, on every line of a scan.

    Attributes:
        dx: mm, zero where nothing is seen. variance: of it, mm². memory: of its errors, lines.
        lever: its change by (δz, roll) of the line. count: of the edges.
    """

    dx: Float[Tensor, " lines"]
    variance: Float[Tensor, " lines"]
    memory: float
    lever: Float[Tensor, "lines 2"]
    count: int

    @property
    def seen(self) -> Bool[Tensor, " lines"]:
        """Lines on which edges show something."""
        return self.variance < LOOSE_SIGMA[0] ** 2


def measure_edges(
    scan: Scan,
    flat: FlatObject,
    found: LineMotion,
    level: Float[Tensor, "lines 3"],
    used: Bool[Tensor, " lines"],
    config: LineMotionConfig,
) -> EdgeMotion | str:
    """What the straight edges of a flat object show, or why they show nothing.

    Args:
        found: what its profile shows. level: mean and trend of that. used: lines that show the object.
    """
    if Rectification.of(scan.raw_rig) is not None:
        return "edges are looked for in rectified images alone"
    there = used.nonzero()[:, 0]
    if len(there) < _FEWEST_LINES:
        return TOO_FEW
    if len(there) > _MOST_LINES:
        return f"edges are looked for on no more than {_MOST_LINES} lines"
    motion = found.values + pad(level, (0, 1))
    lines = range(int(there[0]), int(there[-1]) + 1)
    relation = relation_of_scan(scan, DisparityConfig())
    cells = Cells.of(scan, 0 if relation is None else relation.rows.whole)
    seen = _lines_of(flat.frame, motion, used, lines)
    tracks = find_tracks(cells, lines, seen.advance_mm)
    result = agreed(CommonMotion.of_tracks(tracks, cells, flat, seen), config)
    return result if isinstance(result, str) else _on_all_lines(result, seen, lines, len(motion))


def _lines_of(
    frame: ProductFrame, motion: Float[Tensor, "lines 4"], used: Bool[Tensor, " lines"], lines: range
) -> EdgeLines:
    """Some lines, with what is known of their motion."""
    part = slice(lines.start, lines.stop)
    along = frame.along(torch.arange(lines.start, lines.stop).double())
    advance = float(along.diff().abs().mean())
    along = along - along.mean()
    return EdgeLines(motion[part], along / along.abs().max(), used[part], advance)


def _on_all_lines(result: Agreed, seen: EdgeLines, lines: range, count: int) -> EdgeMotion:
    """On every line of the scan; a line that shows nothing has the loosest variance."""
    fit: EdgeFit = result.fit
    around = (lines.start, count - lines.stop)
    loosest = LOOSE_SIGMA[0] ** 2
    variance = (fit.scale**2 / fit.total).clamp(max=loosest)
    return EdgeMotion(
        dx=pad(fit.dx + fit.mean_off, around),
        variance=pad(variance, around, value=loosest),
        memory=fit.memory,
        lever=pad(fit.lever, (0, 0, *around)),
        count=result.count,
    )


def with_edges(edges: EdgeMotion | None, profile: RegisteredScan, flat: FlatObject) -> RegisteredScan:
    """Join what edges show, if anything, with what the profile does, which is sure of δz + slope δx alone."""
    lines, errors = profile.lines, profile.errors
    loose = torch.diag(lines.values.new_tensor(LOOSE_SIGMA) ** -2)  # that registered lines count beside their own
    scale, ridge = errors.scale[1:], torch.eye(3).to(loose)
    ridge[1, 0] = -flat.slope
    apart = torch.zeros_like(lines.information)
    apart[:, 0, 0] = LOOSE_SIGMA[0] ** 2 if edges is None else edges.variance
    apart[:, 1:, 1:] = scale[:, None] * torch.linalg.inv((lines.information + loose)[:, 1:, 1:]) * scale
    dx = torch.zeros_like(lines.values[:, 0]) if edges is None else edges.dx
    values = torch.stack([dx, *lines.values.T[1:]], 1)
    values[:, 1] -= flat.slope * (dx - lines.values[:, 0])
    information = torch.linalg.inv(ridge @ apart @ ridge.T) - loose
    rms, memory = errors.rms.clone(), errors.memory.clone()
    rms[0] = LOOSE_SIGMA[0] if edges is None else edges.variance[edges.seen].median().sqrt()
    memory[0] = memory[1] if edges is None else edges.memory
    lines = replace(lines, values=values, information=information)
    return RegisteredScan(lines, LineErrors(torch.ones_like(rms), memory, rms))


def finished(motion: LineMotion, edges: EdgeMotion, gauge: Callable[[Tensor], Tensor]) -> LineMotion:
    """The motion with δx as edges show it.

    It errs besides because the edges lie at another depth, or are rolled otherwise, than their profile says.

    Args:
        gauge: removes mean and trend over the lines that show edges.
    """
    sideways = replace(motion.findings[0], edges=edges.count)
    if sideways.state == "corrected":
        values, covariance = motion.values.clone(), motion.covariance.clone()
        values[:, 0] = gauge(values[:, 0])
        across = (covariance[:, 1:3, 1:3] @ edges.lever[..., None])[..., 0]
        covariance[:, 0, 0] += (edges.lever * across).sum(1)
        covariance[:, 0, 1:3] += across
        covariance[:, 1:3, 0] += across
        rms, variance = values[edges.seen, 0].square().mean().sqrt(), covariance[edges.seen, 0, 0].mean()
        sideways = replace(sideways, rms=float(rms), sigma=float(variance.sqrt()))
        motion = replace(motion, values=values, covariance=covariance)
    return replace(motion, findings=(sideways, *motion.findings[1:]))
