"""What several straight edges have in common: how their object is displaced sideways on every line.

In the product an edge i that runs along the travel lies at q_x = a_i + b_i y, once its line is shifted back by δx. All
edges of an object share δx: it is found where all of them are straight, by Gauss-Newton on their strips at once. Places
of single edges err by texture beside them; on a line they count by their contrast, and less where they are off.

How well δx is known follows from how the edges differ, and so does whether they are straight at all: one that departs
from the others is left out. Two that contradict each other show nothing.
"""

from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F  # noqa: N812
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.stages.line_motion.edges.cells import Cells
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.edges.strips import Strips
from lsvision.stages.line_motion.edges.tracks import Tracks

_ROUNDS = 5
_SMOOTHED_CELLS, _SHAPE_CELLS = 16.0, 64.0  # standard deviations, over the travel, of δx between rounds and of shapes
_TAIL = 3.0  # standard deviations, at which the Gaussian is cut off
_CUT = 3.0  # standard deviations, beyond which an edge counts less on a line
_LEAST_INFORMATION = 1e-4  # of contrast squared
_FORGOTTEN, _LEAST_MEMORY, _LONGEST = 0.05, 0.3, 100  # correlation, lines
_LEVER_STEPS = (1e-2, 1e-2, 1e-4)  # mm, mm, rad


@dataclass(frozen=True)
class EdgeLines:
    """The lines on which edges are looked at.

    Attributes:
        motion: what their profile shows of the object's motion, by line; δx is what edges have found of it.
        along_mm: travel, from the middle of the lines, over its largest. used: which lines show the object.
        advance_mm: of the object by line.
    """

    motion: Float[Tensor, "lines 4"]
    along: Float[Tensor, " lines"]
    used: Bool[Tensor, " lines"]
    advance_mm: float

    @property
    def design(self) -> Float[Tensor, "lines 2"]:
        """Mean and trend."""
        return torch.stack([torch.ones_like(self.along), self.along], 1)

    def displaced(self, dx: Float[Tensor, " lines"]) -> Float[Tensor, "lines 4"]:
        """The motion with a displacement sideways."""
        return torch.cat([dx[:, None], self.motion[:, 1:]], 1)

    def straight(
        self, values: Float[Tensor, "edges lines"], weight: Float[Tensor, "edges lines"]
    ) -> Float[Tensor, "edges 2"]:
        """Mean and trend of values, by weighted least squares over the used lines."""
        weight = weight * self.used
        heavy = weight[..., None] * self.design
        normal = self.design.T @ heavy
        right = (heavy * values[..., None]).sum(-2)
        ridge = 1e-12 * normal.diagonal(dim1=-2, dim2=-1).amax(-1)[:, None, None] * torch.eye(2).to(normal)
        return torch.linalg.solve(normal + ridge, right)

    def smooth(
        self, values: Float[Tensor, "*batch lines"], weight: Float[Tensor, "*batch lines"], length_mm: float
    ) -> Float[Tensor, "*batch lines"]:
        """Weighted means over neighbouring used lines."""
        weight = weight * self.used
        both = torch.stack([weight * values, weight])
        sigma = length_mm / self.advance_mm
        offset = torch.arange(-round(_TAIL * sigma), round(_TAIL * sigma) + 1).to(values)
        kernel = torch.exp(-0.5 * (offset / sigma).square())
        flat = F.conv1d(both.flatten(0, -2)[:, None], kernel[None, None], padding=len(offset) // 2)[:, 0]
        total, weights = flat.view_as(both)
        return total / weights.clamp(min=torch.finfo(values.dtype).tiny)


@dataclass(frozen=True)
class EdgeFit:
    """Displacement sideways by line, how far single edges are off, and their weights, 1 / mm².

    Attributes:
        dx: smoothed, mm. straight: (a, b) of each edge. off: places of edges beyond a_i + b_i y + δx, mm.
        contrast: of edges over that of their mean pictures.
        lever: change of δx by (δz, roll) that the edges' places leave open, mm/mm and mm/rad.
    """

    dx: Float[Tensor, " lines"]
    straight: Float[Tensor, "edges 2"]
    off: Float[Tensor, "edges lines"]
    weight: Float[Tensor, "edges lines"]
    contrast: Float[Tensor, "edges lines"]
    lever: Float[Tensor, "lines 2"]

    @property
    def mean_off(self) -> Float[Tensor, " lines"]:
        """What single lines add to the smoothed displacement."""
        return (self.weight * self.off).sum(0) / self.total

    @property
    def total(self) -> Float[Tensor, " lines"]:
        """Information of a line on δx, 1 / mm²."""
        return self.weight.sum(0).clamp(min=torch.finfo(self.weight.dtype).tiny)

    @property
    def left(self) -> Float[Tensor, "edges lines"]:
        """Residuals of edges over what they are expected to be."""
        share = self.weight / self.total
        return (self.off - self.mean_off) * (self.weight / (1 - share).clamp(min=1e-6)).sqrt()

    def scale(self, lines: EdgeLines) -> float:
        """True errors over those that the weights state; 1 at least, as weights of what is off make it look smaller."""
        return max(1.0, float(self.left[:, lines.used].square().mean().sqrt()))

    def shapes(self, lines: EdgeLines, length_mm: float) -> Float[Tensor, " edges"]:
        """How far each edge departs from the others over long distances, mm rms."""
        share = (self.weight / self.total).clamp(max=1 - 1e-6)
        apart = (self.off - self.mean_off) / (1 - share)
        slow = lines.smooth(apart, self.weight * (1 - share), length_mm)
        return slow[:, lines.used].square().mean(1).sqrt()

    def memory(self, lines: EdgeLines) -> float:
        """Lines over which errors are forgotten, of as large a sum of correlations."""
        left = self.left * lines.used
        power = torch.fft.rfft(left, n=2 * left.shape[1]).abs().square()
        correlation = torch.fft.irfft(power).sum(0)[: min(_LONGEST, left.shape[1])]
        correlation = correlation / correlation[0].clamp(min=torch.finfo(left.dtype).tiny)
        total = float(2 * (correlation * (correlation > _FORGOTTEN).cumprod(0)).sum() - 1)
        kept = torch.tensor(max((total - 1) / (total + 1), 1e-9))
        return max(_LEAST_MEMORY, float(-1 / kept.log()))


@dataclass(frozen=True)
class CommonMotion:
    """Tracks of an object's edges, q_x in mm, their strips, and the lines that they are on."""

    place: Float[Tensor, "edges lines"]
    strips: Strips
    cells: Cells
    flat: FlatObject
    lines: EdgeLines

    @classmethod
    def of_tracks(cls, tracks: Tracks, cells: Cells, flat: FlatObject, lines: EdgeLines) -> "CommonMotion":
        """That of all tracks; strips lie where the object's depth says that both images show them."""
        place = flat.across(cells.column(tracks.place), lines.motion)
        columns = cells.place(flat.columns(place, lines.motion))[: cells.views]
        return cls(place, Strips.read(cells, columns, tracks.lines), cells, flat, lines)

    def among(self, edges: Tensor) -> "CommonMotion":
        """That of some edges."""
        return replace(self, place=self.place[edges], strips=self.strips.of(edges))

    def alike(self) -> Float[Tensor, "2 edges"]:
        """Contrast of edges in the right image over that in the left one, and how far they lie apart, in cells."""
        columns = self.cells.place(self.flat.columns(self.place, self.lines.motion))
        return self.strips.alike(columns, self.lines.used)

    def fit(self) -> EdgeFit:
        """Displacement sideways that makes the edges straight."""
        place, lines, length = self.place, self.lines, _SMOOTHED_CELLS * self.cells.pitch_mm
        even = torch.ones_like(place)
        straight = robust_straight(place, lines)
        middle = (place - straight @ lines.design.T).median(0).values
        dx = self._gauged(lines.smooth(middle, even[0], length))
        straight = robust_straight(place - dx, lines)
        for _ in range(_ROUNDS):
            found = self._residuals(dx, straight)
            change = self._gauged(lines.smooth(found.mean_off, found.total, length))
            dx, straight = dx + change, straight + lines.straight(found.off - change, found.weight)
        return self._residuals(dx, straight)

    def _gauged(self, dx: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
        """Without mean and trend over the used lines."""
        line = self.lines.straight(dx[None], torch.ones_like(dx)[None])
        return dx - (line @ self.lines.design.T)[0]

    def _places(self, straight: Tensor, motion: Float[Tensor, "lines 4"]) -> Float[Tensor, "views edges lines"]:
        """Where straight edges show, in cells."""
        columns = self.flat.columns(straight @ self.lines.design.T, motion)[: len(self.strips.first)]
        return self.cells.place(columns)

    def _residuals(self, dx: Float[Tensor, " lines"], straight: Float[Tensor, "edges 2"]) -> EdgeFit:
        """By how much edges are off their places at a displacement."""
        motion = self.lines.displaced(dx)
        place = self._places(straight, motion)
        shifts = self.strips.shifts(place, self.lines.used)
        contrast = shifts.contrast.clamp(min=0)
        information = contrast.square().sum(0) + _LEAST_INFORMATION
        off = self.cells.pitch_mm * (contrast * shifts.moved).sum(0) / information
        error = off * information.sqrt()
        sigma = NORMAL_OVER_MAD * error[:, self.lines.used].abs().median(1, keepdim=True).values
        sigma = sigma.clamp(min=1e-6 * self.cells.pitch_mm)
        weight = information / sigma.square() / (1 + (error / sigma / _CUT).square()) * self.lines.used
        lever = self._lever(straight, motion, contrast.square() / information * weight)
        return EdgeFit(dx, straight, off, weight, shifts.contrast.mean(0), lever)

    def _lever(self, straight: Tensor, motion: Tensor, weight: Float[Tensor, "views edges lines"]) -> Tensor:
        """Change of δx by (δz, roll) at which the edges stay where they are."""
        by = []
        for index, step in enumerate(_LEVER_STEPS):
            change = torch.zeros_like(motion)
            change[:, index] = step
            by.append((self._places(straight, motion + change) - self._places(straight, motion - change)) / (2 * step))
        total = weight.sum((0, 1)).clamp(min=torch.finfo(weight.dtype).tiny)
        return torch.stack([-(weight * each / by[0]).sum((0, 1)) / total for each in by[1:]], -1)


def robust_straight(place: Float[Tensor, "edges lines"], lines: EdgeLines) -> Float[Tensor, "edges 2"]:
    """Mean and trend of places that are off on some lines: by weights that shrink with the distance (Cauchy)."""
    weight = torch.ones_like(place)
    for _ in range(10):
        line = lines.straight(place, weight)
        off = (place - line @ lines.design.T).abs()
        usual = off[:, lines.used].median(1, keepdim=True).values.clamp(min=1e-9)
        weight = 1 / (1 + (off / (2 * usual)).square())
    return line


def shape_length_mm(cells: Cells) -> float:
    """Distance over which departures of an edge from the others are averaged."""
    return _SHAPE_CELLS * cells.pitch_mm
