"""The true motion of the object: where each of its points is on each line, and the rays that see it.

On line v the object's own point p stands in the scan frame at

    P = Rroll(v) (p - y n - c) + c + (dx(v), 0, dz(v)),     y = the true nominal travel of line v,

with Rroll a rotation about Y and c = (B/2, 0, z0). Without vibration that is p = P + y n, Eq. 11 of Wang et al. 2024.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.simulation.config import EncoderConfig, MotionConfig
from lsvision.simulation.noise import lattice_hash
from lsvision.types import Rig, Transport

# One phase stream per thing that swings.
_X, _Z, _ROLL, _WOBBLE = range(4)
# Fixed-point steps that invert the uneven travel; each gains at least a digit for any wobble a log can follow.
_INVERSION_STEPS = 40


@dataclass(frozen=True)
class Trajectory:
    """True motion under a rig: direction, vibration, and the travel of each line."""

    rig: Rig
    motion: MotionConfig
    encoder: EncoderConfig
    line_pitch_mm: float
    transport: Transport = "forward"

    @property
    def n(self) -> Tensor:
        """True displacement in mm per nominal mm, float64 (3,)."""
        slope_x, slope_z = (math.tan(math.radians(a)) for a in (self.motion.angle_x_deg, self.motion.angle_z_deg))
        direction = torch.tensor([slope_x, 1.0, slope_z], dtype=torch.float64)
        return self.motion.stretch * direction / torch.linalg.vector_norm(direction)

    @property
    def sign(self) -> float:
        """+1 where later lines see larger Y, -1 for reversed transport."""
        return -1.0 if self.transport == "reverse" else 1.0

    @property
    def pivot(self) -> Tensor:
        """Point c on the axis of roll, mm, float64 (3,)."""
        return torch.tensor([self.rig.baseline_mm / 2, 0.0, self.rig.zero_disparity_mm], dtype=torch.float64)

    def position(self, line: Tensor) -> Tensor:
        """True nominal travel y, mm, of (fractional) lines, float64."""
        even = line.double() * self.line_pitch_mm
        return self.sign * (even + self._wobble(even))

    def line_at(self, y: Tensor) -> Tensor:
        """Fractional line of a true nominal travel y, mm: the inverse of ``position``."""
        target = self.sign * y.double()
        even = target
        for _ in range(_INVERSION_STEPS if self.encoder.enabled else 0):
            even = target - self._wobble(even)
        return even / self.line_pitch_mm

    def vibration(self, line: Tensor) -> Tensor:
        """Displacement (dx mm, dz mm, roll rad) of the object on (fractional) lines, float64 ``(*lines, 3)``."""
        y, m = line.double() * self.line_pitch_mm, self.motion
        amplitudes = (m.vibration_x_mm, m.vibration_z_mm, math.radians(m.vibration_roll_deg))
        return torch.stack(
            [
                amplitude * _waves(y, m.vibration_wavelengths_mm, m.seed, stream)
                for stream, amplitude in zip((_X, _Z, _ROLL), amplitudes, strict=True)
            ],
            dim=-1,
        )

    def project(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """x (mm), line and z (mm) at which the object's own points ``(*batch, 3)``, mm, cross the scan plane."""
        y = points[..., 1].double() / self.n[1]  # neither roll about Y nor dx, dz moves a point along Y
        line = self.line_at(y)
        dx, dz, roll = self.vibration(line).unbind(-1)
        x, _, z = (points - y[..., None] * self.n - self.pivot).unbind(-1)
        cos, sin = torch.cos(roll), torch.sin(roll)
        return cos * x + sin * z + self.pivot[0] + dx, line, cos * z - sin * x + self.pivot[2] + dz

    def _wobble(self, even: Tensor) -> Tensor:
        if not self.encoder.enabled:
            return torch.zeros_like(even)
        return self.encoder.wobble_mm * _waves(even, self.encoder.wobble_wavelengths_mm, self.encoder.seed, _WOBBLE)


@dataclass(frozen=True)
class Rays:
    """What one camera's columns see on some lines, in the object's own coordinates.

    The point at depth z on column j of line i is ``origin[i] + z (slope[j] across[i] + ahead[i])``; in the scan frame
    its x is ``camera_x_mm + z (slope[j] + middle_slope)``. Lines are float64, slopes float32 about the middle column,
    so that a float32 offset along the sensor is exact to micrometres.
    """

    slope: Tensor
    origin: Tensor
    across: Tensor
    ahead: Tensor
    camera_x_mm: float
    middle_slope: float

    def within(self, rotation: Tensor, translation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Origin, across and ahead seen from a frame with ``p = rotation p_frame + translation``."""
        return (self.origin - translation) @ rotation, self.across @ rotation, self.ahead @ rotation


def cast_rays(trajectory: Trajectory, camera: str, columns: Tensor, lines: Tensor, plane_y_mm: float = 0.0) -> Rays:
    """Rays of the left or right camera through columns ``(w,)`` px on (fractional) lines ``(h,)``, float64.

    Args:
        trajectory: the true motion.
        camera: "left" or "right".
        plane_y_mm: Y of the plane that the sensor line looks at; zero but for a trilinear sensor.
    """
    rig = trajectory.rig
    left = camera == "left"
    principal = rig.principal_left_px if left else rig.principal_right_px
    camera_x = 0.0 if left else rig.baseline_mm
    middle_slope = ((rig.width_px - 1) / 2 - principal) / rig.focal_length_px
    slope = (columns.double() - principal) / rig.focal_length_px - middle_slope
    dx, dz, roll = trajectory.vibration(lines).unbind(-1)
    cos, sin, zero = torch.cos(roll), torch.sin(roll), torch.zeros_like(roll)
    across = torch.stack([cos, zero, sin], -1)  # columns of the inverse of Rroll
    depth = torch.stack([-sin, zero, cos], -1)
    pivot = trajectory.pivot
    from_pivot_x, from_pivot_z = camera_x - pivot[0] - dx, -pivot[2] - dz
    origin = across * from_pivot_x[:, None] + depth * from_pivot_z[:, None] + pivot
    origin = origin + origin.new_tensor([0.0, plane_y_mm, 0.0]) + trajectory.position(lines)[:, None] * trajectory.n
    return Rays(slope.float(), origin, across, depth + middle_slope * across, camera_x, middle_slope)


def _waves(y: Tensor, wavelengths_mm: tuple[float, ...], seed: int, stream: int) -> Tensor:
    """Sum of equal sine waves with random phases and an rms of one."""
    count = len(wavelengths_mm)
    phase = math.pi * lattice_hash(torch.arange(count), stream, seed).double()
    wavelength = torch.tensor(wavelengths_mm, dtype=torch.float64)
    return math.sqrt(2.0 / count) * torch.sin(2.0 * math.pi * y[..., None] / wavelength + phase).sum(-1)
