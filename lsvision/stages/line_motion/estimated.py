"""Registered lines and the motion that they show."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.geometry import ProductFrame, travel_at, without_trend
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.line_motion.estimate import estimate, noisy_values
from lsvision.stages.line_motion.registration import RegisteredScan
from lsvision.types import LineFinding, LineMotion


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
        gauged = lines if level is None else replace(lines, values=lines.values - level)
        motion = estimate(gauged, samples, along, registered.errors, config)
        return cls(registered, along, noisy_values(gauged, samples, config).valid, motion)

    def with_finding(self, finding: LineFinding) -> "Estimated":
        """With another finding about δx."""
        findings = finding, *self.motion.findings[1:]
        return replace(self, motion=replace(self.motion, findings=findings))


def level_of(
    registered: RegisteredScan, samples: int, frame: ProductFrame, config: LineMotionConfig
) -> Float[Tensor, "lines 3"]:
    """Mean and trend of the δz and roll of registered lines, which belong to the object's pose."""
    lines = registered.lines
    along = travel_at(frame.travel, torch.arange(len(lines.values)).double())
    values = lines.values.T
    level = values - without_trend(along, noisy_values(lines, samples, config).valid)(values)
    return level.T * values.new_tensor([0.0, 1.0, 1.0])
