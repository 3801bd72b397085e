"""Corners left out, in words: which they are, how far off they lie, and whether rows or columns were exchanged."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from lsvision.stages.calibration.model import residuals_in_sigmas
from lsvision.stages.calibration.problem import BoardProblem
from lsvision.stages.calibration.readmitted import MANY
from lsvision.types import BoardCorners

# Of a square: a corner this near another's place was taken for it.
_AT_PLACE = 0.3
_NAMED = 3  # corners named one by one


@dataclass(frozen=True)
class LeftOut:
    """The sentence on corners of one scan that were left out, and whether they make its board doubtful."""

    sentence: str
    doubtful: bool


def left_out(board: BoardCorners, outlying: Tensor) -> LeftOut | None:
    """What is to say of the corners of one scan that were left out; None where none were."""
    if not bool(outlying.any()):
        return None
    places = _Places.of(board, outlying)
    count, seen = int(outlying.sum()), int(board.valid.sum())
    exchanged = places.exchanged()
    if exchanged is not None:
        return LeftOut(f"scan {board.scan}: {exchanged}; their {count} corners were left out", True)
    farthest = places.distance_mm.argsort(descending=True)[:_NAMED].tolist()
    named = [places.described(i) for i in farthest]
    if count == 1:
        return LeftOut(f"scan {board.scan}: the corner {named[0]}; it was left out", False)
    more = ", .." if count > _NAMED else ""
    sentence = (
        f"scan {board.scan}: {count} of {seen} corners lie off their board and were left out: {'; '.join(named)}{more}"
    )
    return LeftOut(sentence, count > MANY * seen)


@dataclass(frozen=True)
class _Places:
    """Corners left out: their (column, row) from 0, how far off they lie, and the (column, row) where they do.

    ``found`` is (-1, -1) where there is no corner's place.
    """

    own: Tensor
    distance_mm: Tensor
    found: Tensor

    @classmethod
    def of(cls, board: BoardCorners, outlying: Tensor) -> "_Places":
        """By the affine map of the corners that were kept."""
        body = board.board_points[:, :2]
        features = torch.cat([torch.ones_like(body[:, :1]), body], dim=-1)
        kept = board.valid & ~outlying
        coefficients = torch.linalg.lstsq(features[kept], board.points[kept]).solution
        error = board.points[outlying] - features[outlying] @ coefficients
        on_board = torch.linalg.lstsq(coefficients[1:].mT, (board.points[outlying] - coefficients[0]).mT).solution.mT
        column_row = _column_row(board.board_points)
        away = torch.linalg.vector_norm(on_board[:, None] - body, dim=-1)
        nearest = away.argmin(-1)
        near = away.amin(-1) < _AT_PLACE * _spacing(body)
        found = torch.where(near[:, None], column_row[nearest], -1)
        return cls(column_row[outlying], torch.linalg.vector_norm(error, dim=-1), found)

    def described(self, i: int) -> str:
        """Where one corner should be, and where it is."""
        column, row = (self.own[i] + 1).tolist()
        off = f"in column {column}, row {row} lies {float(self.distance_mm[i]):.3g} mm off"
        if bool((self.found[i] < 0).any()) or bool((self.found[i] == self.own[i]).all()):
            return off
        return off + f", at the place of column {int(self.found[i, 0]) + 1}, row {int(self.found[i, 1]) + 1}"

    def exchanged(self) -> str | None:
        """The sentence that says which two rows or columns stand for each other, if two do."""
        for axis, name in ((1, "rows"), (0, "columns")):
            pair = sorted(set(self.own[:, axis].tolist()))
            if len(pair) != 2 or len(self.own) < 4:
                continue
            other = sum(pair) - self.own[:, axis]
            same = self.found[:, 1 - axis] == self.own[:, 1 - axis]
            if bool((same & (self.found[:, axis] == other)).all()):
                return f"{name} {pair[0] + 1} and {pair[1] + 1} of its corners are exchanged"
        return None


def column_rows(board_points: Tensor, chosen: Tensor) -> tuple[tuple[int, int], ...]:
    """Columns and rows, from 1 at the board's origin, of the chosen corners."""
    return tuple((column, row) for column, row in (_column_row(board_points)[chosen] + 1).tolist())


def largest_residuals(problem: BoardProblem, state: Tensor) -> tuple[float, ...]:
    """The largest residual of a corner of each board, in sigmas of its given covariance."""
    return tuple(torch.linalg.vector_norm(residuals_in_sigmas(problem, state), dim=-1).amax(-1).tolist())


def doubts(found: Sequence[LeftOut | None], doubtful: bool) -> tuple[str, ...]:
    """The sentences of the boards that are doubtful, or of those that are not."""
    return tuple(each.sentence for each in found if each is not None and each.doubtful is doubtful)


def _column_row(board_points: Tensor) -> Tensor:
    """Columns and rows of a board's corners, from 0 at its origin, ``(corners, 2)``."""
    body = board_points[:, :2]
    return ((body - body.amin(0)) / _spacing(body)).round().long()


def _spacing(body: Tensor) -> float:
    """Distance of neighbouring corners, mm."""
    away = torch.linalg.vector_norm(body - body[:1], dim=-1)
    return float(away[away > 0].min())
