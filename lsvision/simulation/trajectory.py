"""The true motion of the object: the position of its points on every line, and the rays that see them.

On line v the object's own point p lies in the scan frame at

    P = Rroll(v) (p - y n - c) + c + (dx(v), 0, dz(v)),     y = the true nominal travel of line v,

with Rroll a rotation about Y and c = (B/2, 0, z0). Without vibration that is p = P + y n, Eq. 11 of Wang et al. 2024.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from lsvision.geometry import Camera, RawPair, camera_center_mm, middle_point, shaken, slope_at
from lsvision.simulation.config import EncoderConfig, MotionConfig
from lsvision.simulation.noise import lattice_hash
from lsvision.types import Pose, Rig, Transport

# One stream of random phases for each quantity that swings.
_X, _Z, _ROLL, _WOBBLE, _JITTER = range(5)
# Fixed-point steps that invert the uneven travel; each gains a digit or more for any wobble that a log can follow.
_INVERSION_STEPS = 40
_CROSSING_STEPS = 8  # each gains two digits where a plane is tilted by half a degree


@dataclass(frozen=True)
class Trajectory:
    """True motion under a rig: direction, vibration, and the travel of each line.

    ``raw`` are the cameras where they are not rectified; ``rig`` is the ideal pair of those then.
    """

    rig: Rig
    motion: MotionConfig
    encoder: EncoderConfig
    line_pitch_mm: float
    transport: Transport = "forward"
    raw: RawPair | None = None

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
        return middle_point(self.rig)

    def position(self, line: Tensor) -> Tensor:
        """True nominal travel y, mm, of (fractional) lines, float64."""
        even = line.double() * self.line_pitch_mm
        return self.sign * (even + self._wobble(even) + self.jitter(line))

    def logged(self, line: Tensor) -> Tensor:
        """The travel of lines as an exact log has it, mm, float64: without the jitter."""
        return self.position(line) - self.sign * self.jitter(line)

    def jitter(self, line: Tensor) -> Tensor:
        """By how much the trigger of lines is late, mm along the transport, float64; linear between whole lines."""
        if self.encoder.jitter == 0:
            return torch.zeros_like(line, dtype=torch.float64)
        first = line.double().floor()
        here, after = (
            lattice_hash(number, _JITTER, self.encoder.seed).double() for number in (first.long(), first.long() + 1)
        )
        rms = self.encoder.jitter * self.line_pitch_mm
        return math.sqrt(3.0) * rms * torch.lerp(here, after, line.double() - first)

    def line_at(self, y: Tensor) -> Tensor:
        """Fractional line of a true nominal travel y, mm: the inverse of ``position``."""
        target = self.sign * y.double()
        even = target
        for _ in range(_INVERSION_STEPS if self.encoder.enabled or self.encoder.jitter else 0):
            even = target - self._wobble(even) - self.jitter(even / self.line_pitch_mm)
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

    def project(self, points: Tensor, camera: Camera = "left") -> Tensor:
        """Places (x mm, line, z mm), ``(*batch, 3)``, where the object's own points, mm, cross the plane of a camera.

        That is the scan plane, unless the right one of a raw pair looks at another.
        """
        crossing = self._crossing(points, torch.zeros_like(points[..., 1]))
        if self.raw is not None and camera == "right":
            for _ in range(_CROSSING_STEPS):
                crossing = self._crossing(points, self.raw.right_plane(crossing[..., 0], crossing[..., 2]))
        return crossing

    def _crossing(self, points: Tensor, plane_y_mm: Tensor) -> Tensor:
        """Where the object's own points reach Y, mm, as ``project``."""
        y = (points[..., 1].double() - plane_y_mm) / self.n[1]  # neither roll about Y nor dx, dz moves a point along Y
        line = self.line_at(y)
        still = (points - y[..., None] * self.n)[..., ::2]
        x, z = shaken(still, pad(self.vibration(line), (0, 1)), self.pivot).unbind(-1)
        return torch.stack([x, line, z], dim=-1)

    def _wobble(self, even: Tensor) -> Tensor:
        if not self.encoder.enabled:
            return torch.zeros_like(even)
        return self.encoder.wobble_mm * _waves(even, self.encoder.wobble_wavelengths_mm, self.encoder.seed, _WOBBLE)


@dataclass(frozen=True)
class Rays:
    """Rays of one camera's columns on some lines, in the object's own coordinates.

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

    def in_frame(self, pose: Pose) -> "Rays":
        """The same rays in the coordinates of a target's frame; depths and slopes stay those of the scan frame."""
        rotation, translation = pose.rotation, pose.translation
        return replace(
            self,
            origin=(self.origin - translation) @ rotation,
            across=self.across @ rotation,
            ahead=self.ahead @ rotation,
        )

    def on_columns(self, columns: slice) -> "Rays":
        """The rays of some columns."""
        return replace(self, slope=self.slope[columns])

    def direction(self, axis: int) -> Tensor:
        """One coordinate of every ray's direction, ``(lines, columns)`` float32, mm per mm of depth."""
        across, ahead = self.across[:, axis].float(), self.ahead[:, axis].float()
        return torch.addcmul(ahead[:, None], across[:, None], self.slope[None])

    def scan_x(self, z: Tensor) -> Tensor:
        """x in the scan frame, mm, of the points at depths z ``(lines, columns)``, mm."""
        return (self.slope[None] + self.middle_slope).mul(z).add_(self.camera_x_mm)


def cast_rays(trajectory: Trajectory, camera: Camera, columns: Tensor, lines: Tensor, plane_y_mm: float = 0.0) -> Rays:
    """Rays of the left or right camera through columns ``(w,)`` px on (fractional) lines ``(h,)``, float64.

    Args:
        trajectory: the true motion.
        camera: "left" or "right".
        columns, lines: positions, px and lines.
        plane_y_mm: Y, at the depth of zero disparity, of the plane through the camera's centre that the sensor line
            sees; zero except for a trilinear sensor.
    """
    rig, raw = trajectory.rig, trajectory.raw
    camera_x = camera_center_mm(rig, camera)
    if raw is None:
        middle_slope = slope_at(rig, (rig.width_px - 1) / 2, camera)
        slope = slope_at(rig, columns.double(), camera) - middle_slope
    else:
        slope = (raw.left if camera == "left" else raw.right).slope(columns.double())
        middle_slope = float(slope[len(slope) // 2])
        slope = slope - middle_slope
    dx, dz, roll = trajectory.vibration(lines).unbind(-1)
    cos, sin, zero = torch.cos(roll), torch.sin(roll), torch.zeros_like(roll)
    across = torch.stack([cos, zero, sin], -1)  # columns of the inverse of Rroll
    depth = torch.stack([-sin, zero, cos], -1)
    pivot = trajectory.pivot
    from_pivot_x, from_pivot_z = camera_x - pivot[0] - dx, -pivot[2] - dz
    origin = across * from_pivot_x[:, None] + depth * from_pivot_z[:, None] + pivot
    origin = origin + trajectory.position(lines)[:, None] * trajectory.n
    depth = depth + depth.new_tensor([0.0, plane_y_mm / float(pivot[2]), 0.0])
    if raw is not None and camera == "right":
        # Along a ray, Y of its plane is linear in z and in the slope.
        up, none = origin.new_tensor([0.0, 1.0, 0.0]), origin.new_zeros(())
        origin = origin + up * raw.right_plane(origin.new_tensor(camera_x), none)
        across, depth = across + up * raw.plane[1], depth + up * raw.plane[2]
    return Rays(slope.float(), origin, across, depth + middle_slope * across, camera_x, middle_slope)


def _waves(y: Tensor, wavelengths_mm: tuple[float, ...], seed: int, stream: int) -> Tensor:
    """Sum of equal sine waves with random phases and an rms of one."""
    count = len(wavelengths_mm)
    phase = math.pi * lattice_hash(torch.arange(count), stream, seed).double()
    wavelength = torch.tensor(wavelengths_mm, dtype=torch.float64)
    return math.sqrt(2.0 / count) * torch.sin(2.0 * math.pi * y[..., None] / wavelength + phase).sum(-1)
