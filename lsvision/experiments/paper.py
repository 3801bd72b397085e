"""``+experiment=paper``: Wang et al. 2024 redone on scan files, start to end.

Renders boards, a sheet and a rail, writes them as scan folders, reads them back, calibrates by both methods, corrects
everything and holds the figures against the paper's; once without vibration and once with.
"""

import json
import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from lsvision.archive import Processing, plan_one
from lsvision.experiments.correct import make_product
from lsvision.experiments.parallel import scan_pool
from lsvision.experiments.settings import RunSettings
from lsvision.experiments.simulate import write_simulation
from lsvision.geometry import displace
from lsvision.io import Product, read_product, read_scan, write_calibration, write_text
from lsvision.report.paper_pages import PAPER, BoardCheck, Scenario, write_paper_report
from lsvision.report.progress import ProgressBars, progress_bars
from lsvision.simulation import BoardPose, MotionConfig, SceneConfig, SensorConfig, Simulation, scaled_rig, simulate
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
    poses: list[BoardPose]
    corners: CornersConfig
    joint: CalibrationConfig
    two_step: CalibrationConfig
    disparity: DisparityConfig
    correction: CorrectionConfig
    scale: float = 4.0
    line_pitch_mm: float = 0.07


def run_paper(settings: PaperSettings, folder: Path) -> None:
    """Both scenarios, then the summary and the report."""
    scenarios = {}
    with progress_bars() as bars:
        for name, motion in (("still", settings.still), ("vibrating", settings.vibrating)):
            log.info("scenario %s: render, calibrate, correct", name)
            scenarios[name] = _scenario(settings, motion, folder / name, bars)
    summary = {"paper": PAPER, **{name: scenario.summary() for name, scenario in scenarios.items()}}
    write_text(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    write_paper_report(folder, scenarios, asdict(settings))
    for name, scenario in scenarios.items():
        for method, result in scenario.results.items():
            log.info(
                "%-9s %-8s RMSE %.4f -> %.4f mm, %.1f %% better, %d iterations, %s",
                name, method, result.rmse_before_mm, result.rmse_after_mm, 100 * result.improvement,
                len(result.iterations) - 1, result.observability.verdict,
            )  # fmt: skip
    log.info("wrote %s", folder / "report.html")


def _scenario(settings: PaperSettings, motion: MotionConfig, folder: Path, bars: ProgressBars) -> Scenario:
    """Render, read back, calibrate by both methods, correct and measure, for one motion."""
    simulations = _simulations(settings, motion)
    names = list(simulations)
    with scan_pool(settings.threads) as pool:
        rendered = pool.map(lambda name: _rendered(simulations[name], folder / name, bars), names)
        scans = dict(zip(names, rendered, strict=True))
        boards = {name: scan for name, scan in scans.items() if name.startswith("board")}
        found = pool.map(lambda scan: find_corners(scan, settings.board, settings.corners), boards.values())
        corners = dict(zip(boards, found, strict=True))

        rig = scans["sheet"].rig
        joint = calibrate(list(corners.values()), rig, settings.joint)
        two_step = calibrate([next(iter(corners.values()))], rig, settings.two_step)
        for method, calibration in (("joint", joint), ("two_step", two_step)):
            write_calibration(calibration, folder / f"calibration_{method}.json")

        processing = Processing(settings.disparity, settings.correction, repair_encoder=False, worker_memory_mb=None)

        def corrected(name: str) -> Product:
            planned = plan_one(folder / name, folder / "calibration_joint.json", processing)
            return read_product(make_product(planned, processing, folder, bars).path)

        products = dict(zip(names, pool.map(corrected, names), strict=True))
        checked = pool.map(lambda name: _check_board(settings.board, corners[name], products[name]), boards)
        checks = dict(zip(boards, checked, strict=True))
    sheet, product = simulations["sheet"], products["sheet"]
    strip = product.read(0, product.grid.rows)
    color, height = TensorImage(strip.color), TensorImage(strip.height[..., None])
    return Scenario(
        n_true=sheet.trajectory.n,
        results={"joint": joint, "two_step": two_step},
        boards=corners,
        checks=checks,
        sheet_before=points_in_scan(scans["sheet"], depth_of(scans["sheet"], settings.disparity), sheet),
        sheet_after=points_in_product(color, height, product.grid, joint.motion.n, sheet),
        scans=scans,
        products=products,
    )


def _rendered(simulation: Simulation, folder: Path, bars: ProgressBars) -> Scan:
    write_simulation(simulation, folder, bars)
    return read_scan(folder)


def _simulations(settings: PaperSettings, motion: MotionConfig) -> dict[str, Simulation]:
    """The scans of a scenario by name: board_1, board_2, .., sheet, rail."""
    scenes = {
        f"board_{index}": replace(settings.scene, **asdict(pose)) for index, pose in enumerate(settings.poses, start=1)
    }
    scenes |= {"sheet": settings.sheet, "rail": settings.rail}
    rig = scaled_rig(settings.rig, settings.scale)
    return {
        # Each pass meets another phase of the vibration and other noise.
        name: simulate(
            rig,
            settings.board,
            scene,
            replace(motion, seed=motion.seed + index),
            replace(settings.sensor, seed=settings.sensor.seed + index),
            settings.line_pitch_mm * settings.scale,
        )
        for index, (name, scene) in enumerate(scenes.items())
    }


def _check_board(board: Board, corners: BoardCorners, product: Product) -> BoardCheck:
    """Distances between a board's corners at nominal motion and in the product."""
    nominal = displace(corners.points, corners.points.new_tensor([0.0, 1.0, 0.0]))
    before = distance_errors(nominal, board, corners.valid)
    strip = product.read(0, product.grid.rows)
    color, height = TensorImage(strip.color), TensorImage(strip.height[..., None])
    measured = measure_board(color, height, product.grid, board)
    if measured is None:
        return BoardCheck(0, before, (float("nan"), float("nan")), None)
    return BoardCheck(
        corners=int(measured.valid.sum()),
        before_mm=before,
        after_mm=(measured.neighbour_rms_mm, measured.distance_rms_mm),
        points=measured.points,
    )
