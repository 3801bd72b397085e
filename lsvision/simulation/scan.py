"""Simulated line-scan stereo scans, rendered strip by strip."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.geometry import Camera, RawPair, camera_center_mm, ideal_rig, project, zero_disparity_mm
from lsvision.schema import Checked, Positive, PositiveInt
from lsvision.simulation.config import EncoderConfig, MotionConfig, SceneConfig, SensorConfig
from lsvision.simulation.noise import lattice_hash
from lsvision.simulation.scene import build_scene, place, scene_lines
from lsvision.simulation.sensor import expose, halo_px, received, sample_offsets, true_response
from lsvision.simulation.surfaces import Look, Scene
from lsvision.simulation.trajectory import Trajectory, cast_rays
from lsvision.types import Board, CameraResponse, Pose, RawRig, Rig, Transport, Travel

# Lines rendered at once. Blocks begin at multiples of it, so that strips of every height have the same bits; 32 lines
# of samples fit the processor's cache.
_BLOCK = 32
_LOG_STREAM = 7
_RESPONSE_STREAM = -1  # no line has this number


@dataclass(frozen=True)
class Acquisition(Checked):
    """How the lines of a scan are triggered.

    Attributes:
        line_pitch_mm: nominal travel per line.
        lines: length of the scan; None for a scan that shows the whole target and its margin.
        transport: "reverse" turns the image upside down.
        encoder: uneven trigger and its log; None for a constant pitch.
    """

    line_pitch_mm: Positive
    lines: PositiveInt | None = None
    transport: Transport = "forward"
    encoder: EncoderConfig | None = None


@dataclass(frozen=True)
class Simulation:
    """One simulated pass of an object under the rig; images are rendered strip by strip, as they are read.

    Attributes:
        lines: number of lines.
        travel: as the scan's file states it: the constant pitch, or the encoder's log.
        pose: of the target, ``p = R p_target + T`` in the scan frame.
        raw_rig: the cameras where they are not rectified; ``rig`` is the ideal pair of those then.
        trajectory: the true motion, vibration and uneven travel included.
    """

    rig: Rig
    board: Board
    scene: SceneConfig
    sensor: SensorConfig
    trajectory: Trajectory
    travel: Travel
    lines: int
    pose: Pose
    raw_rig: RawRig | None = None

    @property
    def width_px(self) -> int:
        """Columns of the images."""
        return (self.raw_rig or self.rig).width_px

    @property
    def channels(self) -> int:
        """1 for a mono sensor, otherwise 3."""
        return 1 if self.sensor.mono else 3

    def strips(self, camera: Camera, strip_lines: int = 256) -> Iterator[Tensor]:
        """Consecutive strips ``(h, width, channels)`` of one camera's image, uint8 or uint16.

        The pixels do not depend on ``strip_lines``; the memory does not depend on the number of lines.
        """
        blocks = (self._expose_block(camera, first) for first in range(0, self.lines, _BLOCK))
        return _regroup(blocks, strip_lines, self.lines)

    def depth_strips(self, strip_lines: int = 256) -> Iterator[Tensor]:
        """Strips ``(h, width)`` of the true depth z, mm, float32, at the centre of every pixel of the left image."""
        columns = torch.arange(self.width_px, dtype=torch.float64)
        blocks = (
            self._look("left", columns, torch.arange(first, first + _BLOCK, dtype=torch.float64)).z
            for first in range(0, self.lines, _BLOCK)
        )
        return _regroup(blocks, strip_lines, self.lines)

    def corners(self) -> tuple[Tensor, Tensor]:
        """True pixel positions (column, line) of the board's corners in the left and right image, float64."""
        points = self.board.corner_points() @ self.pose.rotation.mT + self.pose.translation
        raw = self.trajectory.raw
        if raw is None:
            x, line, z = self.trajectory.project(points).unbind(-1)
            left, right = project(self.rig, x, z)
            return torch.stack([left, line], dim=-1), torch.stack([right, line], dim=-1)
        (x, line, z), (right_x, right_line, right_z) = (
            self.trajectory.project(points, camera).unbind(-1) for camera in ("left", "right")
        )
        right = raw.right.column((right_x - camera_center_mm(self.rig, "right")) / right_z)
        return torch.stack([raw.left.column(x / z), line], dim=-1), torch.stack([right, right_line], dim=-1)

    def truth(self) -> dict[str, Any]:
        """The truth of the scan as plain values for a JSON file.

        ``n``, ``stretch``, ``R``, ``T``, ``lines``, the settings under ``args``, ``jitter_mm`` of every line where
        there is one, ``rig`` of raw cameras, and for a board its corners as (column, line) in the order of
        ``Board.corner_points``.
        """
        trajectory = self.trajectory
        args = {
            "scene": dataclasses.asdict(self.scene),
            "motion": dataclasses.asdict(trajectory.motion),
            "encoder": dataclasses.asdict(trajectory.encoder),
            "sensor": dataclasses.asdict(self.sensor),
            "line_pitch_mm": trajectory.line_pitch_mm,
            "transport": trajectory.transport,
        }
        truth: dict[str, Any] = {
            "n": trajectory.n.tolist(),
            "stretch": trajectory.motion.stretch,
            "R": self.pose.rotation.tolist(),
            "T": self.pose.translation.tolist(),
            "lines": self.lines,
            "args": args,
        }
        if trajectory.encoder.jitter > 0:
            truth["jitter_mm"] = trajectory.jitter(torch.arange(self.lines, dtype=torch.float64)).tolist()
        if self.raw_rig is not None:
            truth["rig"] = dataclasses.asdict(self.raw_rig)
        if self.scene.kind == "board":
            left, right = self.corners()
            truth |= {"corners_left_px": left.tolist(), "corners_right_px": right.tolist()}
        return truth

    @property
    def _focus_mm(self) -> float:
        """Depth z at which the lenses are in focus."""
        return zero_disparity_mm(self.rig) - self.sensor.focus_height_mm

    @cached_property
    def _scene(self) -> Scene:
        return build_scene(self.rig, self.board, self.scene, self.pose, self.trajectory.n)

    def _expose_block(self, camera: Camera, first: int) -> Tensor:
        reach = halo_px(self.sensor)
        columns = sample_offsets(-reach, self.width_px + 2 * reach, self.sensor)
        lines = sample_offsets(first - reach, _BLOCK + 2 * reach, self.sensor)
        light = received(self._look(camera, columns, lines), self.sensor, self._focus_mm)
        seed = self._drawn(first, int(camera == "right"))
        return expose(light, self.sensor, seed, None if self.sensor.is_even else self.response(camera))

    def response(self, camera: Camera) -> CameraResponse:
        """True offset and gain of the columns of a camera, float32."""
        return true_response(self.sensor, self.width_px, self._drawn(_RESPONSE_STREAM, int(camera == "right")))

    def _drawn(self, number: int, stream: int) -> int:
        """A seed by the number of a line and a stream."""
        return int((float(lattice_hash(torch.tensor(number), stream, self.sensor.seed)) + 1.0) * 2**30)

    def _look(self, camera: Camera, columns: Tensor, lines: Tensor) -> Look:
        """Colour and depth that samples see; each colour of a trilinear sensor looks at another plane."""
        spacing = self.rig.color_spacing_lines
        if not any(spacing):
            return self._scene.look(cast_rays(self.trajectory, camera, columns, lines))
        looks = [self._look_channel(camera, columns, lines, shift) for shift in spacing]
        return Look(torch.stack([look.color[c] for c, look in enumerate(looks)]), looks[1].z)

    def _look_channel(self, camera: Camera, columns: Tensor, lines: Tensor, spacing: float) -> Look:
        """One colour, seen ``spacing`` lines further along Y, and that much earlier if the camera registers colours."""
        if self.sensor.color_registered:
            lines = lines - self.trajectory.sign * spacing
        plane_y = spacing * self.trajectory.line_pitch_mm
        return self._scene.look(cast_rays(self.trajectory, camera, columns, lines, plane_y))


def simulate(
    rig: Rig | RawRig,
    board: Board,
    scene: SceneConfig,
    motion: MotionConfig,
    sensor: SensorConfig,
    acquisition: Acquisition,
) -> Simulation:
    """Set up a scan of a board, sheet or rail.

    Args:
        rig: the cameras, a rectified pair or a raw one.
        board: the target if ``scene.kind`` is "board".
        scene, motion, sensor: the object, how it moves, and what sees it.
        acquisition: pitch and number of the lines, transport, encoder.

    Raises:
        ConfigError: an option has a value that no scan can have; the message names it.
    """
    pitch, raw_rig = acquisition.line_pitch_mm, rig if isinstance(rig, RawRig) else None
    rig, raw = (rig, None) if isinstance(rig, Rig) else (ideal_rig(rig), RawPair.of(rig))
    trajectory = Trajectory(rig, motion, acquisition.encoder or EncoderConfig(), pitch, acquisition.transport, raw)
    lines = acquisition.lines
    if lines is None:
        lines = scene_lines(board, scene, trajectory.n, pitch)
    middle_mm = trajectory.sign * pitch * (lines - 1) / 2
    pose = place(rig, board, scene, trajectory.n, middle_mm)
    return Simulation(rig, board, scene, sensor, trajectory, _logged_travel(trajectory, lines), lines, pose, raw_rig)


def _logged_travel(trajectory: Trajectory, lines: int) -> Travel:
    """The travel as an encoder recorded it, counted positive along the transport."""
    encoder, pitch = trajectory.encoder, trajectory.line_pitch_mm
    if not encoder.enabled:
        return Travel(pitch, None, trajectory.transport)
    position = trajectory.sign * trajectory.logged(torch.arange(lines, dtype=torch.float64))
    generator = torch.Generator().manual_seed(encoder.seed * 8 + _LOG_STREAM)
    log = position + encoder.noise_mm * torch.randn(lines, generator=generator, dtype=torch.float64)
    if not bool((log.diff() > 0).all()):
        raise ConfigError("encoder.wobble_mm, encoder.noise_mm: too large for this line pitch, the log runs backwards")
    return Travel(pitch, log, trajectory.transport)


def _regroup(blocks: Iterator[Tensor], strip_lines: int, total: int) -> Iterator[Tensor]:
    """Cut a stream of blocks into strips of another height."""
    if strip_lines < 1:
        raise ValueError(f"strip_lines must be at least 1, got {strip_lines}")
    return _cut(blocks, strip_lines, total)


def _cut(blocks: Iterator[Tensor], strip_lines: int, total: int) -> Iterator[Tensor]:
    pending: list[Tensor] = []
    held = 0
    for start in range(0, total, strip_lines):
        wanted = min(strip_lines, total - start)
        while held < wanted:
            pending.append(next(blocks))
            held += len(pending[-1])
        joined = torch.cat(pending)
        yield joined[:wanted]
        pending, held = [joined[wanted:]], held - wanted
