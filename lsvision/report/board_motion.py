"""What a calibration found of the motion from line to line of its boards' scans: a table and figures."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from lsvision.report.line_motion_figures import LineMotionView, component_name, in_shown_units, line_motion_figures
from lsvision.report.pages import ReportFigure, Table
from lsvision.types import BoardCorners, BoardFit, Calibration, LineFinding


def board_motion_tables(calibration: Calibration) -> list[Table]:
    """A row for every component of every scan; no table where the lines are not corrected."""
    rows = [_row(board, finding) for board in calibration.boards for finding in board.line_motion]
    header = ("scan", "component", "state", "rms", "sigma, rms", "length of a wave", "log evidence", "file")
    note = (
        "Displacement of the board on each line, besides its constant motion: in the files beside the calibration, "
        "which line_motion=FILE takes for the same scan, and taken away in the RMSE after. Log evidence is how much "
        "better the boards of all scans fit with the component than without; n allows for it either way."
    )
    return [Table("Motion from line to line", header, rows, note)] if rows else []


def board_motion_figures(calibration: Calibration, boards: Sequence[BoardCorners]) -> Iterator[ReportFigure]:
    """The motion by line and its spectrum, of every scan."""
    for number, (motion, board) in enumerate(zip(calibration.line_motions, boards, strict=False), start=1):
        if board.travel_mm is None:
            continue
        view = LineMotionView(motion.values, motion.sigma, float(board.travel_mm.diff().abs().mean()))
        for figure in line_motion_figures(view):
            yield replace(figure, name=f"{figure.name}_{number}", title=f"{figure.title}, {Path(board.scan).name}")


def _row(board: BoardFit, finding: LineFinding) -> tuple[str, ...]:
    name, length = finding.component, finding.length_mm
    return (
        Path(board.scan).name,
        component_name(name),
        finding.state,
        in_shown_units(name, finding.rms, "%.3g") if finding.state == "corrected" else "",
        in_shown_units(name, finding.sigma, "%.2g"),
        "" if length is None else f"{length:.3g} mm",
        f"{finding.evidence:.1f}",
        board.line_motion_file or "",
    )
