"""``+experiment=paper``: Wang et al. 2024 redone on scan files, from start to end.

Renders boards, a sheet and a rail, writes them as scan folders, reads them back, calibrates by both methods, corrects
all scans and compares the figures with the paper's: once without vibration and once with it.
"""

import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

from annotated_types import MinLen

from lsvision.archive import Processing, plan_one
from lsvision.experiments.correct import make_product
from lsvision.experiments.parallel import map_names, scan_pool
from lsvision.experiments.settings import RunSettings
from lsvision.experiments.simulate import write_simulation
from lsvision.geometry import displace, scaled_rig
from lsvision.io import Product, read_product, read_scan, write_calibration, write_json
from lsvision.report.paper_pages import write_paper_report
from lsvision.report.paper_scenario import PAPER, BoardCheck, Scenario
from lsvision.report.progress import ProgressBars, progress_bars
from lsvision.schema import Positive, Scale
from lsvision.simulation import (
    Acquisition,
    BoardPose,
    MotionConfig,
    SceneConfig,
    SensorConfig,
    Simulation,
    simulate,
)
from lsvision.simulation.sheet_points import points_in_product, points_in_scan
from lsvision.stages.calibration.calibrate import calibrate
from lsvision.stages.calibration.config import CalibrationConfig
from lsvision.stages.corners.config import CornersConfig
from lsvision.stages.corners.find import find_corners
from lsvision.stages.correction.config import CorrectionConfig
from lsvision.stages.disparity.config import DisparityConfig
from lsvision.stages.disparity.depth import depth_of
from lsvision.stages.measurement import distance_errors, measure_board
from lsvision.types import Board, BoardCorners, Rig, Scan, TensorImage

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PaperSettings(RunSettings):
    """Options of the experiment; ``two_step`` sees the first of ``poses`` alone, as in the paper, ``joint`` all."""

    rig: Rig
    board: Board
    scene: SceneConfig
    sheet: SceneConfig
    rail: SceneConfig
    still: MotionConfig
    vibrating: MotionConfig
    sensor: SensorConfig
    poses: Annotated[list[BoardPose], MinLen(1)]
    corners: CornersConfig
    joint: CalibrationConfig
    two_step: CalibrationConfig
    disparity: DisparityConfig
    correction: CorrectionConfig
    scale: Scale = 4.0
    line_pitch_mm: Positive = 0.07


def run_paper(settings: PaperSettings, folder: Path) -> None:
    """Run both scenarios, then write the summary and the report."""
    scenarios = {}
    with progress_bars() as bars:
        for name, motion in (("still", settings.still), ("vibrating", settings.vibrating)):
            log.info("scenario %s: render, calibrate, correct", name)
            scenarios[name] = _scenario(settings, motion, folder / name, bars)
    summary = {"paper": PAPER, **{name: scenario.summary() for name, scenario in scenarios.items()}}
    write_json(folder / "summary.json", summary)
    write_paper_report(folder, scenarios, asdict(settings))
    for name, scenario in scenarios.items():
        for method, result in scenario.results.items():
            log.info(
                "%-9s %-8s RMSE %.4f -> %.4f mm, %.1f %% better, %d iterations, %s",
                name, method, result.rmse_before_mm, result.rmse_after_mm, 100 * result.improvement,
                len(result.iterations) - 1, result.verdict,
            )  # fmt: skip
    log.info("wrote %s", folder / "report.html")


def _scenario(settings: PaperSettings, motion: MotionConfig, folder: Path, bars: ProgressBars) -> Scenario:
    """Render, read back, calibrate by both methods, correct and measure, for one motion."""
    simulations = _simulations(settings, motion)
    with scan_pool(settings.threads) as pool:

        def rendered(name: str) -> Scan:
            write_simulation(simulations[name], folder / name, bars)
            return read_scan(folder / name)

        scans = map_names(pool, rendered, simulations)
        boards = [name for name in scans if name.startswith("board")]
        corners = map_names(pool, lambda name: find_corners(scans[name], settings.board, settings.corners), boards)

        joint = calibrate(list(corners.values()), scans["sheet"].rig, settings.joint)
        two_step = calibrate([corners[boards[0]]], scans["sheet"].rig, settings.two_step)
        write_calibration(joint, folder / "calibration_joint.json")
        write_calibration(two_step, folder / "calibration_two_step.json")

        processing = Processing(settings.disparity, settings.correction, repair_encoder=False, worker_memory_mb=None)

        def corrected(name: str) -> Product:
            planned = plan_one(folder / name, folder / "calibration_joint.json", processing)
            return read_product(make_product(planned, processing, folder, bars).path)

        products = map_names(pool, corrected, scans)
        checks = map_names(pool, lambda name: _check_board(settings.board, corners[name], products[name]), boards)
    sheet = simulations["sheet"]
    color, height = _in_memory(products["sheet"])
    return Scenario(
        n_true=sheet.trajectory.n,
        results={"joint": joint, "two_step": two_step},
        boards=corners,
        checks=checks,
        sheet_before=points_in_scan(scans["sheet"], depth_of(scans["sheet"], settings.disparity), sheet),
        sheet_after=points_in_product(color, height, products["sheet"].grid, joint.motion.n, sheet),
        scans=scans,
        products=products,
    )


def _simulations(settings: PaperSettings, motion: MotionConfig) -> dict[str, Simulation]:
    """The scans of a scenario by name: board_1, board_2, .., sheet, rail."""
    scenes = {
        f"board_{index}": replace(settings.scene, **asdict(pose)) for index, pose in enumerate(settings.poses, start=1)
    }
    scenes |= {"sheet": settings.sheet, "rail": settings.rail}
    rig = scaled_rig(settings.rig, settings.scale)
    return {
        # Each scan has another phase of the vibration and other noise.
        name: simulate(
            rig,
            settings.board,
            scene,
            replace(motion, seed=motion.seed + index),
            replace(settings.sensor, seed=settings.sensor.seed + index),
            Acquisition(settings.line_pitch_mm * settings.scale),
        )
        for index, (name, scene) in enumerate(scenes.items())
    }


def _check_board(board: Board, corners: BoardCorners, product: Product) -> BoardCheck:
    """Distances between a board's corners at nominal motion and in the product."""
    nominal = displace(corners.points, corners.points.new_tensor([0.0, 1.0, 0.0]))
    neighbours_mm, pairs_mm = distance_errors(nominal, board, corners.valid)
    color, height = _in_memory(product)
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


def _in_memory(product: Product) -> tuple[TensorImage, TensorImage]:
    """Colour and height of a whole product."""
    rows = product.grid.rows
    return TensorImage(product.color(0, rows)), TensorImage(product.height(0, rows)[..., None])
