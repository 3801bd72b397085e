"""The edges of squares on every line, reduced to rows on the errors along the scan and on the board's place.

A point that a line shows of an edge is somewhere on it: of (x, travel, z) the edge's direction in the measurement says
nothing. Two values are left, a displacement of x and one of z on that line, written as errors of the mean column and
of the disparity. Both are linear in the processes at the knots and in the affine map from board points to measured
ones. QR in pieces brings all lines of a scan to as many rows as there are unknowns, exactly.

How well edges are located follows from what a fit of free knots and a free map leaves: a size for the mean column,
which the board's texture moves in both images alike, and one for the disparity, and over how many lines each lasts.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import pad

from lsvision.estimation import NORMAL_OVER_MAD, upper_root
from lsvision.geometry import scan_position
from lsvision.stages.calibration.along_scan.kernels import FINE, Knots
from lsvision.stages.calibration.along_scan.lines import COMPONENTS, Lever, Travel
from lsvision.stages.calibration.model import rotations, translations
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.stages.calibration.reduction import affine_features
from lsvision.types import BoardEdges

MAP = 12  # coefficients of the affine map
_AT_ONCE = 2048  # crossings whose rows are reduced at once
_OUTLYING = 5.0  # sigmas
_LONGEST = 40  # lines over which errors of an edge are followed
_UNCORRELATED = 0.05
_FEWEST = 200  # crossings of a scan
_FREE = (10.0, 10.0, 10.0, 0.05)  # mm and rad: motion of x, travel and z, and roll, that is as good as free
_RANK = 1e-9  # of the largest singular value


@dataclass(frozen=True)
class EdgeRows:
    """Whitened rows of the edges of each board: on the processes at the knots, component by component, the map, and 1.

    ``values`` is how many measured values the rows of all boards stand for, ``sigma_px`` the standard deviation of a
    crossing's mean column and disparity by board.
    """

    rows: Float[Tensor, "boards rows columns"]
    values: float
    sigma_px: Float[Tensor, "boards 2"]

    def on_latents(
        self, roots: Float[Tensor, "#boards 4 knots latents"], knots: Knots = FINE
    ) -> Float[Tensor, "boards rows columns"]:
        """The same on standard normal latents of the processes, whose roots are given at as dense knots or more."""
        by_knot = self.rows[..., : -MAP - 1].unflatten(-1, (len(COMPONENTS), -1))
        inner = roots.expand(len(self.rows), -1, -1, -1)[..., knots.before : knots.before + by_knot.shape[-1], :]
        by_latent = by_knot.transpose(1, 2) @ inner
        return torch.cat([by_latent.transpose(1, 2).flatten(-2), self.rows[..., -MAP - 1 :]], dim=-1)

    def scaled(self, noise_scale: Float[Tensor, ""]) -> "EdgeRows":
        """The rows with their variance multiplied by a factor."""
        return replace(self, rows=self.rows / noise_scale.sqrt())


def edge_rows(problem: BoardProblem, state: Float[Tensor, " state"], edges: Sequence[BoardEdges | None]) -> EdgeRows:
    """The rows of all boards of a problem of batch shape (); zero for a board of which no edges were found.

    Args:
        state: near the solution: it says where on its edge a point is, and which direction the edge has.
    """
    size = len(COMPONENTS) * FINE.count + MAP + 1
    rows, sigma = problem.points.new_zeros(problem.boards, size, size), problem.points.new_zeros(problem.boards, 2)
    values = 0
    for board, found in enumerate(edges):
        if found is None or len(found.line) < _FEWEST:
            continue
        crossings = _Crossings.of(problem, state, board, found).without_outliers()
        rows[board], sigma[board] = crossings.weighed()
        values += int(rows[board].any(-1).sum())
    return EdgeRows(rows, float(values), sigma)


@dataclass(frozen=True)
class _Crossings:
    """Crossings of one board: ``whitener`` takes measured displacements to errors of mean column and disparity.

    ``place`` is where the left camera saw them along the scan, ``place_right`` where the right one did; None: there.
    """

    found: BoardEdges
    whitener: Float[Tensor, "crossings 2 3"]
    by_component: Float[Tensor, "crossings 2 4"]
    place: Float[Tensor, " crossings"]
    place_right: Float[Tensor, " crossings"] | None
    features: Float[Tensor, "crossings 4"]
    kept: Bool[Tensor, " crossings"]

    @classmethod
    def of(cls, problem: BoardProblem, state: Tensor, board: int, found: BoardEdges) -> "_Crossings":
        """Crossings, on the points of their edges that were seen when they were."""
        rotation, translation = rotations(problem, state)[board], translations(problem, state)[board]
        n, travel = BoardState.split(state).n, Travel.of(problem)
        start, stop = (scan_position(points @ rotation.mT + translation, n) for points in (found.start, found.stop))
        edge, y = stop - start, found.points[:, 1]
        share = ((y - start[:, 1]) / edge[:, 1])[:, None]
        body = torch.lerp(found.start, found.stop, share) - problem.centroid[board]
        whitener = torch.zeros_like(found.by_column[..., :1]).expand(-1, -1, 3).clone()
        whitener[:, 0, 0] = whitener[:, 1, 2] = 1.0
        whitener[:, :, 1] = -edge[:, ::2] / edge[:, 1:2]
        whitener = torch.linalg.solve(found.by_column, whitener) / found.sigma_px[:, None, None]
        lever, place = Lever.of(problem), (y - travel.start_mm[board]) / travel.extent_mm
        one = replace(lever, middle=lever.middle[board : board + 1])
        place_right = None if found.later_mm is None else place + found.later_mm / travel.extent_mm
        # The knots end where the corners do that were used.
        within = (place >= 0.0) & (place <= 1.0)
        if place_right is not None:
            within &= (place_right >= 0.0) & (place_right <= 1.0)
        return cls(
            found=found,
            whitener=whitener,
            # About places on the edges, not measured ones: a motion must not fit the noise of its own lever.
            by_component=whitener @ one.directions(torch.lerp(start, stop, share)[None])[0].mT,
            place=place,
            place_right=place_right,
            features=affine_features(body),
            kept=torch.isfinite(whitener).all((-2, -1)) & within,
        )

    def without_outliers(self) -> "_Crossings":
        """The same without those that lie far off a fit of all."""
        error = self.residuals(self.fitted(torch.ones(2).to(self.place)))
        known = error[self.kept]
        sigma = NORMAL_OVER_MAD * (known - known.median(0).values).abs().median(0).values
        return replace(self, kept=self.kept & (error.abs() <= _OUTLYING * sigma).all(-1))

    def weighed(self) -> tuple[Tensor, Tensor]:
        """Whitened rows, without what no unknown explains, and the sigma of a crossing's columns, px."""
        error = self.residuals(self.fitted(torch.ones(2).to(self.place)))
        kept = error[self.kept]
        unknowns = len(COMPONENTS) * FINE.count + MAP
        variance = kept.square().sum(0) / max(len(kept) - unknowns / 2, 1.0)
        lasting = torch.stack([self._lasting(error[:, channel]) for channel in range(2)])
        rows = _of_unknowns(self.reduced((variance * lasting).sqrt()))
        return rows, variance.sqrt() * self.found.sigma_px[self.kept].square().mean().sqrt()

    def fitted(self, sigma: Float[Tensor, "2"]) -> Tensor:
        """Unknowns, all as good as free, that fit the crossings best.

        Columns hardly change where an object is moved away along a camera's rays. Where the cameras look at different
        moments, a motion of metres from knot to knot would fit any columns, and their noise.
        """
        bound = sigma.new_tensor(_FREE).reciprocal().repeat_interleave(FINE.count)
        rows = torch.cat([self.reduced(sigma), pad(bound.diag(), (0, MAP + 1))])
        return torch.linalg.lstsq(rows[:, :-1], rows[:, -1:], rcond=_RANK, driver="gelsd").solution

    def residuals(self, unknowns: Tensor) -> Float[Tensor, "crossings 2"]:
        """What a fit leaves of the mean columns and disparities."""
        parts = []
        for piece in self._pieces():
            rows = self._rows(piece)
            parts.append(rows[..., -1] - (rows[..., :-1] @ unknowns)[..., 0])
        return torch.cat(parts)

    def reduced(self, sigma: Float[Tensor, "2"]) -> Tensor:
        """The triangular root of all rows that are kept, in sigmas of each of the two."""
        root: Tensor | None = None
        for piece in self._pieces():
            rows = torch.where(self.kept[piece, None, None], self._rows(piece) / sigma[:, None], 0.0).flatten(0, 1)
            root = upper_root(rows if root is None else torch.cat([root, rows]))
        assert root is not None
        return pad(root, (0, 0, 0, root.shape[-1] - len(root)))

    def _pieces(self) -> Iterator[slice]:
        for first in range(0, len(self.place), _AT_ONCE):
            yield slice(first, min(first + _AT_ONCE, len(self.place)))

    def _rows(self, piece: slice) -> Tensor:
        """Rows ``(crossings, 2, columns)`` on the processes at the knots, the map and 1."""
        whitener, by_process = self.whitener[piece], self._by_process(piece).flatten(-2)
        by_map = (self.features[piece][:, None, :, None] * whitener[:, :, None]).flatten(-2)
        measured = whitener @ self.found.points[piece][..., None]
        return torch.cat([by_process, by_map, measured], dim=-1)

    def _by_process(self, piece: slice) -> Float[Tensor, "crossings 2 4 knots"]:
        """What the processes at the knots do to mean column and disparity: to each column, when its camera sees it."""
        by_component, weights = self.by_component[piece][..., None], FINE.weights(self.place[piece])[:, None, None]
        if self.place_right is None:
            return by_component * weights
        mean, disparity = by_component.split(1, dim=1)
        left, right = mean + disparity / 2, mean - disparity / 2
        later = FINE.weights(self.place_right[piece])[:, None, None]
        left, right = left * weights, right * later
        return torch.cat([(left + right) / 2, left - right], dim=1)

    def _lasting(self, error: Float[Tensor, " crossings"]) -> Tensor:
        """Over how many lines errors along an edge last: the variance of a mean over that of as many single ones."""
        known = torch.where(self.kept, error, 0.0)
        total, power = error.new_ones(()), known[self.kept].square().mean()
        for lag in range(1, _LONGEST):
            same = self.found.segment[lag:] == self.found.segment[:-lag]
            same &= self.found.line[lag:] - self.found.line[:-lag] == lag
            same &= self.kept[lag:] & self.kept[:-lag]
            correlation = (known[lag:] * known[:-lag])[same].mean() / power
            if not bool(correlation > _UNCORRELATED):
                break
            total = total + 2.0 * correlation
        return total


def _of_unknowns(rows: Float[Tensor, "rows columns"]) -> Float[Tensor, "rows columns"]:
    """Rows of the same information on the unknowns, zero where they hold none: without what no unknown explains."""
    axes, size, unknowns = torch.linalg.svd(rows[:, :-1], full_matrices=False)
    known = size > _RANK * size[0]
    kept = torch.cat([size[:, None] * unknowns, axes.mT @ rows[:, -1:]], dim=-1)
    return pad(torch.where(known[:, None], kept, 0.0), (0, 0, 0, len(rows) - len(size)))
