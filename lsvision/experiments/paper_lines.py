"""What the motion from line to line does to the scans of the paper's experiment that shook.

Boards show it themselves, on their corners and the edges of their squares. A flat sheet's profile shows depth and roll
of its lines, its straight edges show their sideways motion but for its trend. For that and the travel it needs a log.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch.nn.functional import pad

from lsvision.archive import LineMotionChoice, Processing, plan_one
from lsvision.experiments.calibrate import calibrate_with_edges, write_line_motions
from lsvision.experiments.correct import make_product
from lsvision.experiments.parallel import map_names, scan_pool
from lsvision.geometry import displace
from lsvision.image.tiling import one_torch_thread
from lsvision.io import Product, read_product, write_calibration, write_line_motion
from lsvision.report.paper_scenario import HELD_OUT, NOMINAL, BoardCheck, SheetCheck, Steadied, Trial
from lsvision.report.progress import ProgressBars
from lsvision.simulation import Simulation
from lsvision.simulation.sheet_points import points_in_product
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.calibration.known_motion import calibrate_lines
from lsvision.stages.corners.edges import find_edges
from lsvision.stages.line_motion.config import LineMotionConfig
from lsvision.stages.measurement import distance_errors, measure_board
from lsvision.types import Board, BoardCorners, Calibration, LineMotion, Scan, TensorImage

_CALIBRATION = "calibration_line_motion.json"


@dataclass(frozen=True)
class ShakenScans:
    """The scans of a scenario in ``folder``, by name, with the corners of the boards and how the sheet was made.

    ``config`` is that of the calibration, ``processing`` that of the products but for the motion of their lines.
    """

    folder: Path
    board: Board
    scans: Mapping[str, Scan]
    corners: Mapping[str, BoardCorners]
    sheet: Simulation
    config: CalibrationConfig
    processing: Processing

    def steadied(self, threads: int, bars: ProgressBars) -> Steadied:
        """Calibrate with the motion of the lines, take it from every board and the sheet, and measure them."""
        result = self._calibrated()
        own = self._held_out(result)
        files = self._line_motions(result, own)
        log = self.folder / "line_motion_log_of_sheet.parquet"
        write_line_motion(self._true_motion(), log)

        def checked(name: str) -> BoardCheck:
            """A board's product, with the motion that its own scan showed."""
            return check_board(self.board, self.corners[name], self._product(name, str(files[name]), bars))

        def sheet(source: str) -> SheetCheck:
            """The sheet's product against its artwork, with one source of the motion of its lines."""
            product = self._product("sheet", str(log) if source == "log" else source, bars)
            line_motion: Any = product.metadata["line_motion"]
            color, height = in_memory(product)
            points = points_in_product(color, height, product.grid, result.motion.n, self.sheet)
            return SheetCheck.of(points, line_motion)

        with scan_pool(threads) as pool:
            checks = map_names(pool, checked, files)
            sheets = map_names(pool, sheet, ("none", "auto", "log"))
        return Steadied(Trial(result, self.sheet.trajectory.n, own.rmse_after_mm), checks, sheets)

    def _line_motions(self, result: Calibration, own: Calibration) -> dict[str, Path]:
        """The file with the motion of every board that shows one, by name of its scan."""
        files = {
            name: self.folder / board.line_motion_file
            for name, board in zip(self._seen, result.boards, strict=True)
            if board.line_motion_file is not None
        }
        for motion in own.line_motions:
            files[HELD_OUT] = self.folder / "line_motion_held_out.parquet"
            write_line_motion(motion, files[HELD_OUT])
        return files

    @property
    def _seen(self) -> list[str]:
        return [name for name in self.corners if name != HELD_OUT]

    def _calibrated(self) -> Calibration:
        """The joint calibration of shaken boards with the motion of their lines, which is written beside it."""
        scans, boards = [self.scans[name] for name in self._seen], [self.corners[name] for name in self._seen]
        result = write_line_motions(
            calibrate_with_edges(scans, boards, self.board, self.config), self.folder / _CALIBRATION
        )
        write_calibration(result, self.folder / _CALIBRATION)
        return result

    def _held_out(self, result: Calibration) -> Calibration:
        """The board that is held out, fitted under the result's n, with the motion of its own lines."""
        scan, corners = self.scans[HELD_OUT], self.corners[HELD_OUT]
        edges = find_edges(scan, self.board, corners)
        with one_torch_thread():
            return calibrate_lines(corners, edges, result.motion.n, scan.rig, self.config)

    def _true_motion(self) -> LineMotion:
        """What an exact log of the sheet's scan would hold."""
        lines = torch.arange(self.scans["sheet"].lines).double()
        values = pad(self.sheet.trajectory.vibration(lines), (0, 1))
        return LineMotion(values, values.new_zeros(len(values), 4, 4))

    def _product(self, name: str, source: str, bars: ProgressBars) -> Product:
        choice = LineMotionChoice.of(source, LineMotionConfig())
        processing = replace(self.processing, line_motion=choice)
        planned = plan_one(self.folder / name, self.folder / _CALIBRATION, processing)
        output = self.folder / f"with_line_motion_{Path(source).stem}"
        return read_product(make_product(planned, processing, output, bars).path)


def check_board(board: Board, corners: BoardCorners, product: Product) -> BoardCheck:
    """Distances between a board's corners at nominal motion and in the product."""
    nominal = displace(corners.points, NOMINAL)
    neighbours_mm, pairs_mm = distance_errors(nominal, board, corners.valid)
    color, height = in_memory(product)
    measured = measure_board(color, height, product.grid, board)
    if measured is None:
        return BoardCheck(0, neighbours_mm, pairs_mm)
    return BoardCheck(
        corners=int(measured.valid.sum()),
        neighbours_before_mm=neighbours_mm,
        pairs_before_mm=pairs_mm,
        neighbours_after_mm=measured.neighbour_rms_mm,
        pairs_after_mm=measured.distance_rms_mm,
        points=measured.points,
    )


def in_memory(product: Product) -> tuple[TensorImage, TensorImage]:
    """Colour and height of a whole product."""
    rows = product.grid.rows
    return TensorImage(product.color(0, rows)), TensorImage(product.height(0, rows)[..., None])
