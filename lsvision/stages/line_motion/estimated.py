"""Registered lines and the motion that they show."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry import ProductFrame, travel_at, without_trend
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.estimate import estimate, noisy_values
from lsvision.stages.line_motion.register import Registered
from lsvision.stages.line_motion.registration import RegisteredScan
from lsvision.types import LineFinding, LineMotion

_STEP_MM, _FEW = 3.0, 0.15  # between neighbouring lines; share of the lines


@dataclass(frozen=True)
class Estimated:
    """Registered lines, their travel, mm, which of them count, and the motion that they show."""

    registered: RegisteredScan
    along: Float[Tensor, " lines"]
    valid: Bool[Tensor, " lines"]
    motion: LineMotion

    @classmethod
    def of(
        cls,
        registered: RegisteredScan,
        samples: int,
        frame: ProductFrame,
        config: LineMotionConfig,
        level: Float[Tensor, "lines 3"] | None = None,
    ) -> "Estimated":
        """That of registered lines.

        Args:
            samples: of a line that take part where nothing is missing.
            level: what of their displacements is no motion, as ``level_of``.
        """
        lines = registered.lines
        along = travel_at(frame.travel, torch.arange(len(lines.values)).double())
        gauged = (
            lines if level is None else _of_one_object(replace(lines, values=lines.values - level), samples, config)
        )
        motion = estimate(gauged, samples, along, registered.errors, config)
        return cls(registered, along, noisy_values(gauged, samples, config).valid, motion)

    def with_finding(self, finding: LineFinding) -> "Estimated":
        """With another finding about δx."""
        findings = finding, *self.motion.findings[1:]
        return replace(self, motion=replace(self.motion, findings=findings))


def _of_one_object(lines: Registered, samples: int, config: LineMotionConfig) -> Registered:
    """Lines without those before or behind a step in depth, of which there are few: they show another object.

    As seen from a tilted sheet, the conveyor at one of its ends may lie no further off than a motion reaches.
    """
    shown = noisy_values(lines, samples, config).valid.nonzero()[:, 0]
    part = torch.cat([shown.new_zeros(1), (lines.values[shown, 1].diff().abs() > _STEP_MM).long().cumsum(0)])[
        : len(shown)
    ]
    few = torch.bincount(part) < _FEW * len(shown)
    return replace(lines, samples=lines.samples.index_fill(0, shown[few[part]], 0))


def level_of(
    registered: RegisteredScan, samples: int, frame: ProductFrame, config: LineMotionConfig
) -> Float[Tensor, "lines 3"]:
    """Mean and trend of the δz and roll of registered lines, which belong to the object's pose."""
    lines = registered.lines
    along = travel_at(frame.travel, torch.arange(len(lines.values)).double())
    values = lines.values.T
    level = values - without_trend(along, noisy_values(lines, samples, config).valid)(values)
    return level.T * values.new_tensor([0.0, 1.0, 1.0])
