"""Which directions of n the boards determine, and which board tilt to scan next.

The measure is the Fisher information of the corners on n, the boards' poses unknown and without the prior, in units of
the prior's sigma: the data weigh λ times as much as the prior along the direction of an eigenvalue λ.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import weighed_directions
from lsvision.geometry import euler_angles, rotation_from_vector, scan_position, transform
from lsvision.stages.calibration.linearise import motion_information
from lsvision.stages.calibration.model import rotations
from lsvision.stages.calibration.problem import BoardProblem, BoardState
from lsvision.types import Observability, ObservedDirection

# A direction counts as observed where the data weigh at least three times as much as the prior: the posterior sigma is
# then at most half the prior's.
OBSERVED_SHARE = 0.5
# Tilts to choose from. Past 15 degrees the inner corners of a 360 x 270 mm board exceed a depth range of 52 mm.
TILT_GRID_DEG = (-15.0, -10.0, 0.0, 10.0, 15.0)

_NEARLY_ONE = 0.95  # a direction is named after its component alone where that is this much of its length
_AXES = ("n1 (sideways)", "n2 (stretch)", "n3 (in depth)")


def observe(
    problem: BoardProblem, state: Float[Tensor, " state"], prior_sigma: float, noise_scale: float
) -> Observability:
    """What the boards of one problem show of n, direction by direction, and what to scan next, in words.

    Args:
        state: solution of the problem, whose batch shape is ().
        prior_sigma: sigma of each component of n before the scans.
        noise_scale: factor on the corners' covariance that their residuals ask for.
    """
    information = motion_information(problem, state) / noise_scale
    weighed = weighed_directions(information, prior_sigma)
    directions = tuple(
        _observed_direction(vector.tolist(), float(share), prior_sigma)
        for vector, share in zip(weighed.vectors, weighed.share, strict=True)
    )
    missing = [direction for direction in directions if not direction.observed]
    about_x, about_y = next_tilt(problem, state, prior_sigma, noise_scale)
    proposal = _tilt_in_words(about_x, about_y)
    if not missing:
        weakest = _direction_in_words(directions[0])
        return Observability(directions, f"n is determined; to sharpen {weakest}, {proposal}")
    names = ", ".join(_direction_in_words(direction) for direction in missing)
    return Observability(directions, f"the boards do not show {names}: {proposal}")


def next_tilt(
    problem: BoardProblem, state: Float[Tensor, " state"], prior_sigma: float, noise_scale: float = 1.0
) -> tuple[float, float]:
    """Tilt of the next board scan (about the sensor axis X, about the travel axis Y), deg, that helps most.

    It is the tilt of the grid whose scan, simulated with the corners and noise of the first board, makes the posterior
    sigma along the direction that is weakest now the smallest. Of equally good tilts it is the smallest.
    """
    information = motion_information(problem, state) / noise_scale
    weakest = weighed_directions(information, prior_sigma).weakest
    grid = state.new_tensor(TILT_GRID_DEG)
    tilts = torch.cartesian_prod(grid, grid)
    gained = information + simulated_information(problem, state, tilts) / noise_scale
    precision = gained + torch.eye(3, dtype=state.dtype, device=state.device) / prior_sigma**2
    variance = (weakest * torch.linalg.solve(precision, weakest.expand(len(tilts), 3))).sum(-1)
    effort = 1.0 + 1e-9 * tilts.square().sum(-1)  # ties, as between turning either way, go to the smaller tilt
    about_x, about_y = tilts[(variance * effort).argmin()].tolist()
    return about_x, about_y


def simulated_information(
    problem: BoardProblem, state: Float[Tensor, " state"], tilts_deg: Float[Tensor, "tilts 2"]
) -> Float[Tensor, "tilts 3 3"]:
    """Fisher information on n of one more scan of the first board, tilted about X and Y from lying flat."""
    now, count = BoardState.split(state), len(tilts_deg)
    about_x, about_y = (
        rotation_from_vector(angle[:, None] * axis)
        for angle, axis in zip(tilts_deg.deg2rad().unbind(-1), torch.eye(3).to(state), strict=False)
    )
    rotation = (about_x @ about_y @ _without_tilt(rotations(problem, state)[0]))[:, None]
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


def _without_tilt(rotation: Tensor) -> Tensor:
    """The part of a board's rotation about the viewing direction, ``(3, 3)``."""
    _, _, heading = euler_angles(rotation)
    return rotation_from_vector(heading * rotation.new_tensor([0.0, 0.0, 1.0]))


def _observed_direction(vector: Sequence[float], share: float, prior_sigma: float) -> ObservedDirection:
    n1, n2, n3 = vector
    return ObservedDirection((n1, n2, n3), prior_sigma, prior_sigma * share, share < OBSERVED_SHARE)


def _direction_in_words(direction: ObservedDirection) -> str:
    sizes = [abs(component) for component in direction.vector]
    largest = max(sizes)
    return ("" if largest > _NEARLY_ONE else "mostly ") + _AXES[sizes.index(largest)]


def _tilt_in_words(about_x: float, about_y: float) -> str:
    turns = [
        f"by {angle:g} deg about the {axis} axis"
        for angle, axis in ((about_x, "sensor"), (about_y, "travel"))
        if angle != 0.0
    ]
    return "tilt the board " + " and ".join(turns) if turns else "lay the board flat"
