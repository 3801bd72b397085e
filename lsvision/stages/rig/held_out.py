"""How well the rig of all other boards predicts a board: nothing of the board but its pose is fitted."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from lsvision.estimation import BorderedState, bordered_least_squares
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.model import POSE, RigModel
from lsvision.stages.rig.sightings import Sightings
from lsvision.stages.rig.solve import RigSolution, corner_residuals, fit_rig

FEWEST_BOARDS = 3


@dataclass(frozen=True)
class HeldOut:
    """Each board left out in turn: rms residuals, in sigmas, of it by the others' rig, and of the others themselves."""

    rms: Float[Tensor, " boards"]
    rms_of_others: Float[Tensor, " boards"]

    @classmethod
    def of(cls, solution: RigSolution, config: RigConfig) -> "HeldOut":
        """Those of one problem of at least three boards."""
        prior, shared, count = solution.model.prior, solution.found.state.shared, solution.sightings.boards
        others = solution.sightings.chosen([[k for k in range(count) if k != i] for i in range(count)])
        start = BorderedState(shared.expand(count, -1), shared.new_zeros(count, count - 1, POSE))
        model = RigModel.of(others, prior)
        by_others = fit_rig(model, others, start, shared.new_ones(others.valid.shape), config).state
        board = solution.sightings.chosen([[i] for i in range(count)])
        alone = RigModel.of(board, prior)

        def residual(state: BorderedState) -> Tensor:
            return corner_residuals(alone, board, BorderedState(by_others.shared, state.own)).flatten(-2)

        start = BorderedState(shared.new_zeros(count, 0), shared.new_zeros(count, 1, POSE))  # nothing but the pose
        posed = bordered_least_squares(
            residual, start, max_iterations=config.max_iterations, tolerance=config.tolerance
        )
        of_others = corner_residuals(model, others, by_others)
        return cls(_rms(residual(posed.state).unflatten(-1, (-1, 4)), board), _rms(of_others, others))


def _rms(residuals: Float[Tensor, "boards of_each corners 4"], sightings: Sightings) -> Float[Tensor, " boards"]:
    return (residuals.square().sum((-3, -2, -1)) / (4 * sightings.valid.sum((-2, -1)))).sqrt()
