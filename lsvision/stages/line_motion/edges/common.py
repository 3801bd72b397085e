"""What several straight edges have in common: how their object is displaced sideways on every line.

In the product an edge i that runs along the travel lies at q_x = a_i + b_i y, once its line is shifted back by δx. All
edges of an object share δx: it is found where all of them are straight, by Gauss-Newton on their strips at once. Places
of single edges err by texture beside them; on a line they count by their contrast, and less where they are off.

How well δx is known follows from how the edges differ, and so does whether they are straight at all: one that departs
from the others is left out. Two that contradict each other show nothing.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.estimation import NORMAL_OVER_MAD
from lsvision.stages.line_motion.edges.cells import Cells
from lsvision.stages.line_motion.edges.edge_lines import EdgeLines, robust_straight
from lsvision.stages.line_motion.edges.flat_object import FlatObject
from lsvision.stages.line_motion.edges.strips import Strips
from lsvision.stages.line_motion.edges.tracks import Tracks

_ROUNDS, _LAST_ROUNDS = 4, 2
_SMOOTHED_CELLS, _SHAPE_CELLS = 16.0, 64.0  # standard deviations, over the travel, of δx between rounds and of shapes
# Over the travel, over which contrast is averaged; of that of the mean picture, with which an edge shows.
_SHOWN_CELLS, _LEAST_CONTRAST = 8.0, 0.5
_CUT = 3.0  # standard deviations, beyond which an edge counts less on a line
_LARGEST_CELLS = 2.0  # of a shift: pictures are linear over no more
_LEAST_INFORMATION = 1e-4  # of contrast squared
_FORGOTTEN, _LEAST_MEMORY, _LONGEST = 0.05, 0.3, 100  # correlation, lines
_LEVER_STEPS = (1e-2, 1e-2, 1e-4)  # mm, mm, rad


@dataclass(frozen=True)
class EdgeFit:
    """Displacement sideways by line, how far single edges are off, and their weights, 1 / mm².

    Attributes:
        dx: smoothed, mm. straight: (a, b) of each edge. off: places of edges beyond a_i + b_i y + δx, mm.
        lever: change of δx by (δz, roll) that the edges' places leave open, mm/mm and mm/rad.
    """

    dx: Float[Tensor, " lines"]
    straight: Float[Tensor, "edges 2"]
    off: Float[Tensor, "edges lines"]
    weight: Float[Tensor, "edges lines"]
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

    @property
    def shown(self) -> Bool[Tensor, "edges lines"]:
        """Edges on lines that show them and others, too."""
        weight = self.weight > 0
        return weight & (weight.sum(0) > 1)

    @property
    def scale(self) -> float:
        """True errors over those that the weights state; 1 at least, as weights of what is off make it look smaller."""
        return max(1.0, float(self.left[self.shown].square().mean().sqrt()))

    def shapes(self, lines: EdgeLines, length_mm: float) -> Float[Tensor, " edges"]:
        """How far each edge departs from the others over long distances, mm rms."""
        share = (self.weight / self.total).clamp(max=1 - 1e-6)
        apart = (self.off - self.mean_off) / (1 - share)
        slow = lines.smooth(apart, self.weight * (1 - share), length_mm) * self.shown
        return (slow.square().sum(1) / self.shown.sum(1).clamp(min=1)).sqrt()

    @property
    def memory(self) -> float:
        """Lines over which errors are forgotten, of as large a sum of correlations."""
        left = self.left * self.shown
        power = torch.fft.rfft(left, n=2 * left.shape[1]).abs().square()
        correlation = torch.fft.irfft(power).sum(0)[: min(_LONGEST, left.shape[1])]
        correlation = correlation / correlation[0].clamp(min=torch.finfo(left.dtype).tiny)
        total = float(2 * (correlation * (correlation > _FORGOTTEN).cumprod(0)).sum() - 1)
        kept = torch.tensor(max((total - 1) / (total + 1), 1e-9))
        return max(_LEAST_MEMORY, float(-1 / kept.log()))


@dataclass(frozen=True)
class CommonMotion:
    """Tracks of an object's edges, q_x in mm, on which lines there is an edge, their strips, and the lines."""

    place: Float[Tensor, "edges lines"]
    there: Bool[Tensor, "edges lines"]
    strips: Strips
    cells: Cells
    flat: FlatObject
    lines: EdgeLines

    @classmethod
    def of_tracks(cls, tracks: Tracks, cells: Cells, flat: FlatObject, lines: EdgeLines) -> "CommonMotion":
        """That of all tracks; strips lie where the object's depth says that both images show them."""
        place = flat.across(cells.column(tracks.place), lines.motion)
        columns = cells.place(flat.columns(place, lines.motion))[: cells.views]
        strips = Strips.read(cells, columns, tracks.lines)
        contrast = strips.shifts(columns, lines.used.expand(len(place), -1)).contrast.mean(0)
        shown = lines.smooth(contrast, torch.ones_like(contrast), _SHOWN_CELLS * cells.pitch_mm)
        return cls(place, (shown > _LEAST_CONTRAST) & lines.used, strips, cells, flat, lines)

    def among(self, edges: Tensor) -> "CommonMotion":
        """That of some edges."""
        return replace(self, place=self.place[edges], there=self.there[edges], strips=self.strips.of(edges))

    def alike(self) -> Float[Tensor, "2 edges"]:
        """Contrast of edges in the right image over that in the left one, and how far they lie apart, in cells."""
        columns = self.cells.place(self.flat.columns(self.place, self.lines.motion))
        return self.strips.alike(columns, self.there)

    def fit(self) -> EdgeFit:
        """Displacement sideways that makes the edges straight."""
        lines, length = self.lines, _SMOOTHED_CELLS * self.cells.pitch_mm
        there = self.there.to(self.place)
        apart = self.place - robust_straight(self.place, lines, there) @ lines.design.T
        middle = apart.masked_fill(~self.there, torch.nan).nanquantile(0.5, dim=0).nan_to_num()
        dx = self._gauged(lines.smooth(middle, there.amax(0), length))
        for _ in range(_ROUNDS):
            # Pictures do not say where an edge is, but for a shift of all lines: tracks do.
            straight = robust_straight(self.place - dx, lines, there)
            found = self._residuals(dx, straight)
            dx = dx + self._gauged(lines.smooth(found.mean_off, found.total, length))
        for _ in range(_LAST_ROUNDS):
            found = self._residuals(dx, straight)
            change = self._gauged(lines.smooth(found.mean_off, found.total, length))
            dx, straight = dx + change, straight + lines.straight(found.off - change, found.weight)
        return self._residuals(dx, straight)

    def _gauged(self, dx: Float[Tensor, " lines"]) -> Float[Tensor, " lines"]:
        """Without mean and trend over the lines that show an edge."""
        line = self.lines.straight(dx[None], self.there.any(0).to(dx)[None])
        return dx - (line @ self.lines.design.T)[0]

    def _places(self, straight: Tensor, motion: Float[Tensor, "lines 4"]) -> Float[Tensor, "views edges lines"]:
        """Where straight edges show, in cells."""
        columns = self.flat.columns(straight @ self.lines.design.T, motion)[: len(self.strips.first)]
        return self.cells.place(columns)

    def _residuals(self, dx: Float[Tensor, " lines"], straight: Float[Tensor, "edges 2"]) -> EdgeFit:
        """By how much edges are off their places at a displacement."""
        motion = self.lines.displaced(dx)
        place = self._places(straight, motion)
        shifts = self.strips.shifts(place, self.there)
        contrast = shifts.contrast.clamp(min=0)
        information = contrast.square().sum(0) + _LEAST_INFORMATION
        shift = (contrast * shifts.moved).sum(0) / information
        off = self.cells.pitch_mm * shift.clamp(-_LARGEST_CELLS, _LARGEST_CELLS)
        error = off * information.sqrt()
        usual = error.abs().masked_fill(~self.there, torch.nan).nanmedian(1, keepdim=True).values
        sigma = NORMAL_OVER_MAD * usual.nan_to_num()
        sigma = sigma.clamp(min=1e-6 * self.cells.pitch_mm)
        weight = information / sigma.square() / (1 + (error / sigma / _CUT).square()) * self.there
        lever = self._lever(straight, motion, contrast.square() / information * weight)
        return EdgeFit(dx, straight, off, weight, lever)

    def _lever(self, straight: Tensor, motion: Tensor, weight: Float[Tensor, "views edges lines"]) -> Tensor:
        """Change of δx by (δz, roll) at which the edges stay where they are."""
        by = []
        for index, step in enumerate(_LEVER_STEPS):
            change = torch.zeros_like(motion)
            change[:, index] = step
            by.append((self._places(straight, motion + change) - self._places(straight, motion - change)) / (2 * step))
        total = weight.sum((0, 1)).clamp(min=torch.finfo(weight.dtype).tiny)
        return torch.stack([-(weight * each / by[0]).sum((0, 1)) / total for each in by[1:]], -1)


def shape_length_mm(cells: Cells) -> float:
    """Distance over which departures of an edge from the others are averaged."""
    return _SHAPE_CELLS * cells.pitch_mm
