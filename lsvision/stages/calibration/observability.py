"""Which directions of n the boards determine, and which board tilt to scan next.

The directions are the principal axes of the covariance of n that the calibration states, so that what is called
observed is what its sigmas say, in units of the prior's sigma.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import principal_directions
from lsvision.geometry import euler_angles, rotation_from_vector, scan_position, transform
from lsvision.stages.calibration.linearise import motion_information
from lsvision.stages.calibration.model import rotations
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.types import Observability, ObservedDirection

# A direction counts as observed where the posterior sigma is at most half the prior's: the data weigh at least three
# times as much as the prior there.
OBSERVED_SHARE = 0.5
LARGEST_TILT_DEG = 15.0  # of a proposal; a steeper board shows its squares ever worse
_STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)  # tilts to choose from, in largest ones
_WHOLE_DEG = 0.5  # proposals are rounded down to halves of a degree

_NEARLY_ONE = 0.95  # a direction is named after its component alone where that is this much of its length
_AXES = ("n1 (sideways)", "n2 (stretch)", "n3 (in depth)")


@dataclass(frozen=True)
class Known:
    """What a calibration knows of n, and by which scans more may be learnt.

    ``noise_scale`` is the factor on the corners' covariance that their residuals ask for, ``depth_range_mm`` the depth
    in which the camera sees a board sharp.
    """

    covariance: Float[Tensor, "3 3"]
    prior_sigma: float
    noise_scale: float = 1.0
    depth_range_mm: float = math.inf


@dataclass(frozen=True)
class Tilt:
    """Tilt of a board about the sensor axis X and about the travel axis Y, deg."""

    about_x: float
    about_y: float


def observe(problem: BoardProblem, state: Float[Tensor, " state"], known: Known) -> Observability:
    """What the boards of one problem show of n, direction by direction, and what to scan next, in words.

    Args:
        state: solution of the problem, whose batch shape is ().
    """
    found = principal_directions(known.covariance, known.prior_sigma)
    directions = tuple(
        _observed_direction(vector.tolist(), float(share), known.prior_sigma)
        for vector, share in zip(found.vectors, found.share, strict=True)
    )
    missing = [direction for direction in directions if not direction.observed]
    proposal = _in_words(problem, state, next_tilt(problem, state, known))
    if not missing:
        weakest = _direction_in_words(directions[0])
        return Observability(directions, f"n is determined; to sharpen {weakest}, {proposal}")
    names = ", ".join(_direction_in_words(direction) for direction in missing)
    return Observability(directions, f"the boards do not show {names}: {proposal}")


def next_tilt(problem: BoardProblem, state: Float[Tensor, " state"], known: Known) -> Tilt:
    """Tilt of the next board scan that helps most, with all corners within the camera's depth.

    It is the one whose scan, simulated with the corners and noise of the first board, makes the posterior sigma along
    the direction that is weakest now the smallest. Of equally good tilts it is the smallest.
    """
    weakest = principal_directions(known.covariance, known.prior_sigma).weakest
    tilts = possible_tilts(problem, state, known.depth_range_mm)
    information = motion_information(problem, state) + simulated_information(problem, state, tilts)
    eye = torch.eye(3, dtype=state.dtype, device=state.device)
    precision = information / known.noise_scale + eye / known.prior_sigma**2
    variance = (weakest * torch.linalg.solve(precision, weakest.expand(len(tilts), 3))).sum(-1)
    effort = 1.0 + 1e-9 * tilts.square().sum(-1)  # ties, as between turning either way, go to the smaller tilt
    return Tilt(*tilts[(variance * effort).argmin()].tolist())


def possible_tilts(
    problem: BoardProblem, state: Float[Tensor, " state"], depth_range_mm: float
) -> Float[Tensor, "tilts 2"]:
    """Tilts about X and Y, deg, at which the corners of the first board span no more than a depth; flat is one."""
    across, along = _extent(problem, state)
    axes = []
    for extent in (along, across):
        largest = math.degrees(math.asin(min(1.0, depth_range_mm / extent)))
        whole = math.floor(min(largest, LARGEST_TILT_DEG) / _WHOLE_DEG) * _WHOLE_DEG
        axes.append(whole * state.new_tensor(_STEPS))
    tilts = torch.cartesian_prod(*axes).unique(dim=0)
    depth = transform(_tilted(problem, state, tilts), state.new_zeros(3), problem.body_points[0])[..., 2]
    seen = depth[:, problem.valid[0]]
    return tilts[seen.amax(-1) - seen.amin(-1) <= depth_range_mm]


def simulated_information(
    problem: BoardProblem, state: Float[Tensor, " state"], tilts_deg: Float[Tensor, "tilts 2"]
) -> Float[Tensor, "tilts 3 3"]:
    """Fisher information on n of one more scan of the first board, tilted about X and Y from lying flat."""
    now, count = BoardState.split(state), len(tilts_deg)
    rotation = _tilted(problem, state, tilts_deg)[:, None]
    body, position = problem.body_points[:1].expand(count, 1, -1, 3), now.position[:1].expand(count, 1, 3)
    simulated = BoardProblem(
        points=scan_position(transform(rotation, position, body), now.n),
        noise_chol=problem.noise_chol[:1].expand(count, 1, -1, 3, 3),
        body_points=body,
        centroid=problem.centroid[:1].expand(count, 1, 3),
        valid=problem.valid[:1].expand(count, 1, -1),
        rotation=rotation,
    )
    untilted = BoardState(torch.zeros_like(position), position, now.n.expand(count, 3))
    return motion_information(simulated, untilted.join())


def _tilted(problem: BoardProblem, state: Tensor, tilts_deg: Tensor) -> Tensor:
    """Rotations ``(tilts, 3, 3)`` of the first board, tilted about X and Y from lying flat."""
    about_x, about_y = (
        rotation_from_vector(angle[:, None] * axis)
        for angle, axis in zip(tilts_deg.deg2rad().unbind(-1), torch.eye(3).to(state), strict=False)
    )
    return about_x @ about_y @ _without_tilt(problem, state)


def _without_tilt(problem: BoardProblem, state: Tensor) -> Tensor:
    """The part of the first board's rotation about the viewing direction, ``(3, 3)``."""
    _, _, heading = euler_angles(rotations(problem, state)[0])
    return rotation_from_vector(heading * state.new_tensor([0.0, 0.0, 1.0]))


def _extent(problem: BoardProblem, state: Tensor) -> tuple[float, float]:
    """How far the first board's corners reach across and along the travel when it lies flat, mm."""
    points = (problem.body_points[0] @ _without_tilt(problem, state).mT)[problem.valid[0]]
    across, along, _ = (points.amax(0) - points.amin(0)).tolist()
    return across, along


def _observed_direction(vector: Sequence[float], share: float, prior_sigma: float) -> ObservedDirection:
    n1, n2, n3 = vector
    return ObservedDirection((n1, n2, n3), prior_sigma, prior_sigma * share, share < OBSERVED_SHARE)


def _direction_in_words(direction: ObservedDirection) -> str:
    sizes = [abs(component) for component in direction.vector]
    largest = max(sizes)
    return ("" if largest > _NEARLY_ONE else "mostly ") + _AXES[sizes.index(largest)]


def _in_words(problem: BoardProblem, state: Tensor, tilt: Tilt) -> str:
    """A tilt, and which edge it raises towards the cameras.

    A positive turn about X lowers what has the larger Y: it is scanned last, but by a reversed transport. A positive
    turn about Y raises what has the larger X: the larger columns.
    """
    across, along = _extent(problem, state)
    reverse = bool((problem.points[0, :, 1] * problem.valid[0]).sum() < 0)
    first = (tilt.about_x > 0) != reverse
    about_x = f"the edge that is scanned {'first' if first else 'last'}"
    about_y = f"the edge at the {'larger' if tilt.about_y > 0 else 'smaller'} columns"
    turns = [
        f"by {abs(angle):g} deg about the {axis} axis (raise {edge} by "
        f"{extent * math.sin(math.radians(abs(angle))):.0f} mm over the other)"
        for angle, axis, edge, extent in (
            (tilt.about_x, "sensor", about_x, along),
            (tilt.about_y, "travel", about_y, across),
        )
        if angle != 0.0
    ]
    return "tilt the board " + " and ".join(turns) if turns else "lay the board flat"
