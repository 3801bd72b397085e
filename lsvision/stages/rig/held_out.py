"""How well the rig of all other boards predicts a board: nothing of the board but its pose is fitted."""

from torch import Tensor

from lsvision.estimation import BorderedState, bordered_least_squares
from lsvision.stages.rig.config import RigConfig
from lsvision.stages.rig.model import POSE, RigModel
from lsvision.stages.rig.solve import RigSolution, corner_residuals, fit_rig

_FEWEST_BOARDS = 3


def held_out_rms(solution: RigSolution, config: RigConfig) -> list[float | None]:
    """Rms residual of each board of a problem, in sigmas, by the rig of the others; None with too few boards."""
    boards = range(solution.sightings.boards)
    if not config.held_out or len(boards) < _FEWEST_BOARDS:
        return [None for _ in boards]
    shared = _by_others(solution, config)
    board = solution.sightings.chosen([[i] for i in boards])
    model = RigModel.of(board, solution.model.prior)

    def residual(state: BorderedState) -> Tensor:
        return corner_residuals(model, board, BorderedState(shared, state.own)).flatten(-2)

    start = BorderedState(shared[:, :0], shared.new_zeros(len(boards), 1, POSE))  # nothing but the pose is unknown
    posed = bordered_least_squares(residual, start, max_iterations=config.max_iterations, tolerance=config.tolerance)
    return (residual(posed.state).square().sum((-2, -1)) / (4 * board.valid.sum((-2, -1)))).sqrt().tolist()


def _by_others(solution: RigSolution, config: RigConfig) -> Tensor:
    """Rig and motion without each board in turn, ``(boards, shared)``."""
    count = solution.sightings.boards
    without = [[k for k in range(count) if k != i] for i in range(count)]
    others = solution.sightings.chosen(without)
    model, shared = RigModel.of(others, solution.model.prior), solution.found.state.shared.expand(count, -1)
    start = BorderedState(shared, shared.new_zeros(count, count - 1, POSE))
    return fit_rig(model, others, start, solution.noise_scale.expand(count), config).state.shared
