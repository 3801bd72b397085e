"""The points of a study: their conditions, and the exact corners of the boards under them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from lsvision.errors import ConfigError
from lsvision.schema import AcuteAngle, Checked, NonNegative, Positive, PositiveInt, Text
from lsvision.simulation import Acquisition, BoardPose, MotionConfig, SceneConfig, SensorConfig, Simulation, simulate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.linearise import motion_information
from lsvision.stages.calibration.problem import BoardProblem, BoardState, nominal_problem
from lsvision.study.edges import exact_edges
from lsvision.types import Board, BoardEdges, CalibrationMethod, Rig, WhetherLineMotion

# Of the simulated scan; corners are taken between its lines, so that it rounds nothing.
_LINE_PITCH_MM = 0.07


@dataclass(frozen=True)
class Conditions(Checked):
    """One point of a study: the boards' placing, the installation, disturbances of the corners, and the method for n.

    ``corner_sigma_mm`` is the white noise of x and of the travel, ``depth_sigma_mm`` that of z; the calibration knows
    both. It does not know the vibration of x and z or the encoder's error, and has to detect them: sine waves of a
    given rms, with new phases in every scan. With ``line_motion`` "auto" it sees the edges of the squares besides, as
    exact as the corners, and the motion from line to line that it finds is part of the result; with "none" it has the
    corners alone, and what it finds is noise.
    """

    boards: Text
    angle_x_deg: AcuteAngle = 0.0
    angle_z_deg: AcuteAngle = 0.0
    stretch: Positive = 1.0
    corner_sigma_mm: Positive = 0.02
    depth_sigma_mm: Positive = 0.014
    vibration_mm: NonNegative = 0.0
    vibration_wavelength_mm: Positive = 233.0  # at 100 mm, on boards of 200 mm, n would hardly feel it
    encoder_mm: NonNegative = 0.0
    encoder_wavelength_mm: Positive = 400.0
    prior_sigma: Positive = 0.05
    method: CalibrationMethod = "joint"
    iterations: PositiveInt = 20
    line_motion: WhetherLineMotion = "none"

    def calibration(self, config: CalibrationConfig) -> CalibrationConfig:
        """The calibration's options with those of this point."""
        return replace(
            config,
            method=self.method,
            line_motion=self.line_motion,
            prior_sigma=self.prior_sigma,
            max_iterations=self.iterations,
            two_step_max_iterations=self.iterations,
        )


@dataclass(frozen=True)
class ExactCorners:
    """The corners of a point's boards without noise, and the truth: ``points`` (x, travel, z) mm, poses and n.

    ``edges`` are those of the boards' squares, where the point's calibrations see them.
    """

    points: Float[Tensor, "boards corners 3"]
    board_points: Float[Tensor, "boards corners 3"]
    rotation: Float[Tensor, "boards 3 3"]
    translation: Float[Tensor, "boards 3"]
    n: Float[Tensor, "3"]
    edges: tuple[BoardEdges, ...] = ()

    @property
    def valid(self) -> Bool[Tensor, "boards corners"]:
        """All corners are seen."""
        return torch.ones(self.points.shape[:-1], dtype=torch.bool)

    @property
    def depth_span_mm(self) -> float:
        """Depth from the nearest to the farthest corner of a board, the largest of all boards."""
        z = self.points[..., 2]
        return float((z.amax(-1) - z.amin(-1)).max())

    @property
    def tilt_spread_deg(self) -> float:
        """Largest angle between the normals of two boards; 0 where one tilt is repeated, or for one board."""
        normals = self.rotation[..., 2]
        return math.degrees(math.acos(min(1.0, float((normals @ normals.mT).min()))))


def exact_corners(
    rig: Rig, board: Board, placings: Mapping[str, Sequence[BoardPose]], conditions: Conditions
) -> ExactCorners:
    """The corners of a point's boards as the simulated cameras would see them without noise.

    Raises:
        ConfigError: the set of boards is not among the placings, or has none.
    """
    poses = placings.get(conditions.boards)
    if not poses:
        raise ConfigError(f"boards: expected one of {', '.join(placings)}, got {conditions.boards!r}")
    simulations = [_simulation(rig, board, pose, conditions) for pose in poses]
    body = board.corner_points()
    points = []
    for simulation in simulations:
        pose = simulation.pose
        x, line, z = simulation.trajectory.project(body @ pose.rotation.mT + pose.translation).unbind(-1)
        points.append(torch.stack([x, line * _LINE_PITCH_MM, z], dim=-1))
    n, with_edges = simulations[0].trajectory.n, conditions.line_motion == "auto"
    return ExactCorners(
        points=torch.stack(points),
        board_points=body.expand(len(poses), *body.shape),
        rotation=torch.stack([simulation.pose.rotation for simulation in simulations]),
        translation=torch.stack([simulation.pose.translation for simulation in simulations]),
        n=n,
        edges=tuple(exact_edges(rig, board, item.pose, n) for item in simulations) if with_edges else (),
    )


def noise_chol(conditions: Conditions) -> Float[Tensor, "3 3"]:
    """Cholesky factor of the covariance of a corner that the calibration assumes, mm."""
    corner, depth = conditions.corner_sigma_mm, conditions.depth_sigma_mm
    return torch.diag(torch.tensor([corner, corner, depth], dtype=torch.float64))


def true_information(corners: ExactCorners, conditions: Conditions) -> Float[Tensor, "3 3"]:
    """Fisher information of a point's corners on n at the truth, the poses unknown, without the prior."""
    problem, state = true_problem(corners, noise_chol(conditions))
    return motion_information(problem, state)


def true_problem(corners: ExactCorners, chol: Float[Tensor, "3 3"]) -> tuple[BoardProblem, Float[Tensor, " state"]]:
    """The calibration's problem with exact corners and the true poses as the nominal ones, and the true state."""
    problem, _ = nominal_problem(
        corners.points, chol.expand(*corners.points.shape, 3), corners.board_points, corners.valid
    )
    problem = replace(problem, rotation=corners.rotation)
    position = corners.translation + (corners.rotation @ problem.centroid[..., None])[..., 0]
    return problem, BoardState(torch.zeros_like(position), position, corners.n).join()


def _simulation(rig: Rig, board: Board, pose: BoardPose, conditions: Conditions) -> Simulation:
    scene = SceneConfig(kind="board", **asdict(pose))
    motion = MotionConfig(conditions.angle_x_deg, conditions.angle_z_deg, conditions.stretch)
    return simulate(rig, board, scene, motion, SensorConfig(), Acquisition(_LINE_PITCH_MM))
