"""``+experiment=paper``: Wang et al. 2024 redone on scan files, from start to end.

Renders boards, a sheet and a rail, writes them as scan folders, reads them back, calibrates by both methods, corrects
all scans and compares the figures with the paper's: once without vibration and once with it. A further board checks
both calibrations, and one board shaken as the paper's figures suggest is calibrated as the paper did.
"""

import logging
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

from annotated_types import MinLen

from lsvision.archive import Processing, plan_one
from lsvision.experiments.correct import make_product
from lsvision.experiments.paper_lines import ShakenScans, check_board, in_memory
from lsvision.experiments.parallel import map_names, scan_pool
from lsvision.experiments.settings import RunSettings
from lsvision.experiments.simulate import write_simulation
from lsvision.geometry import scaled_rig
from lsvision.io import Product, read_product, read_scan, write_calibration, write_json
from lsvision.report.paper_pages import write_paper_report
from lsvision.report.paper_scenario import HELD_OUT, NOMINAL, PAPER, Scenario, Trial
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
from lsvision.stages.measurement import fitted_rmse_mm
from lsvision.types import Board, Calibration, Rig, Scan

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class PaperSettings(RunSettings):
    """Options of the experiment; ``two_step`` sees the first of ``poses`` alone, as in the paper, ``joint`` all.

    The board at ``held_out`` is scanned too, and calibrates nothing. Under ``paper_numbers`` the first board is scanned
    alone, and calibrated by ``two_step``.
    """

    rig: Rig
    board: Board
    scene: SceneConfig
    sheet: SceneConfig
    rail: SceneConfig
    still: MotionConfig
    vibrating: MotionConfig
    paper_numbers: MotionConfig
    sensor: SensorConfig
    poses: Annotated[list[BoardPose], MinLen(1)]
    held_out: BoardPose
    corners: CornersConfig
    joint: CalibrationConfig
    two_step: CalibrationConfig
    disparity: DisparityConfig
    correction: CorrectionConfig
    scale: Scale = 4.0
    line_pitch_mm: Positive = 0.07


def run_paper(settings: PaperSettings, folder: Path) -> None:
    """Run all scenarios, then write the summary and the report."""
    scenarios = {}
    with progress_bars() as bars:
        for name, motion in (("still", settings.still), ("vibrating", settings.vibrating)):
            log.info("scenario %s: render, calibrate, correct", name)
            scenarios[name] = _scenario(settings, motion, folder / name, bars)
        log.info("scenario paper_numbers: render and calibrate one board")
        paper_numbers = _paper_numbers(settings, folder / "paper_numbers", bars)
    summary = {"paper": PAPER, **{name: scenario.summary() for name, scenario in scenarios.items()}}
    write_json(folder / "summary.json", summary | {"paper_numbers": paper_numbers.summary()})
    write_paper_report(folder, scenarios, paper_numbers, asdict(settings))
    for name, scenario in scenarios.items():
        for method, trial in scenario.trials.items():
            _log_trial(name, method, trial)
    _log_trial("paper_numbers", "two_step", paper_numbers)
    log.info("wrote %s", folder / "report.html")


def _log_trial(scenario: str, method: str, trial: Trial) -> None:
    result = trial.result
    log.info(
        "%-13s %-8s RMSE %.4f -> %.4f mm, %.1f %% better, %d iterations, %s",
        scenario, method, result.rmse_before_mm, result.rmse_after_mm, 100 * result.improvement,
        len(result.iterations) - 1, result.verdict,
    )  # fmt: skip


def _paper_numbers(settings: PaperSettings, folder: Path, bars: ProgressBars) -> Trial:
    """The paper's calibration of one shaken board."""
    simulation = _simulations(settings, settings.paper_numbers)["board_1"]
    write_simulation(simulation, folder / "board_1", bars)
    scan = read_scan(folder / "board_1")
    corners = find_corners(scan, settings.board, settings.corners)
    result = calibrate([corners], scan.rig, settings.two_step)
    write_calibration(result, folder / "calibration_two_step.json")
    return Trial(result, simulation.trajectory.n)


def _scenario(settings: PaperSettings, motion: MotionConfig, folder: Path, bars: ProgressBars) -> Scenario:
    """Render, read back, calibrate by both methods, correct and measure, for one motion."""
    simulations = _simulations(settings, motion)
    with scan_pool(settings.threads) as pool:

        def rendered(name: str) -> Scan:
            write_simulation(simulations[name], folder / name, bars)
            return read_scan(folder / name)

        scans = map_names(pool, rendered, simulations)
        boards = [name for name in scans if name.startswith(("board", HELD_OUT))]
        corners = map_names(pool, lambda name: find_corners(scans[name], settings.board, settings.corners), boards)

        seen = [corners[name] for name in boards if name != HELD_OUT]
        joint = calibrate(seen, scans["sheet"].rig, settings.joint)
        two_step = calibrate(seen[:1], scans["sheet"].rig, settings.two_step)
        write_calibration(joint, folder / "calibration_joint.json")
        write_calibration(two_step, folder / "calibration_two_step.json")

        processing = Processing(settings.disparity, settings.correction, repair_encoder=False, worker_memory_mb=None)

        def corrected(name: str) -> Product:
            planned = plan_one(folder / name, folder / "calibration_joint.json", processing)
            return read_product(make_product(planned, processing, folder, bars).path)

        products = map_names(pool, corrected, scans)
        checks = map_names(pool, lambda name: check_board(settings.board, corners[name], products[name]), boards)
    sheet = simulations["sheet"]
    n_true = sheet.trajectory.n

    def tried(result: Calibration) -> Trial:
        return Trial(result, n_true, fitted_rmse_mm(corners[HELD_OUT], result.motion.n))

    trials = {"joint": tried(joint), "two_step": tried(two_step)}
    steadied = None
    if joint.errors_along_scan:
        lines = replace(settings.joint, line_motion="auto")
        shaken = ShakenScans(folder, settings.board, scans, corners, sheet, lines, processing)
        steadied = shaken.steadied(settings.threads, bars)
        trials["joint with line motion"] = steadied.trial
    color, height = in_memory(products["sheet"])
    return Scenario(
        trials=trials,
        held_out_before_mm=fitted_rmse_mm(corners[HELD_OUT], NOMINAL),
        boards=corners,
        checks=checks,
        sheet_before=points_in_scan(scans["sheet"], depth_of(scans["sheet"], settings.disparity), sheet),
        sheet_after=points_in_product(color, height, products["sheet"].grid, joint.motion.n, sheet),
        scans=scans,
        products=products,
        steadied=steadied,
    )


def _simulations(settings: PaperSettings, motion: MotionConfig) -> dict[str, Simulation]:
    """The scans of a scenario by name: board_1, board_2, .., sheet, rail, the board that is held out."""
    scenes = {
        f"board_{index}": replace(settings.scene, **asdict(pose)) for index, pose in enumerate(settings.poses, start=1)
    }
    held_out = replace(settings.scene, **asdict(settings.held_out))
    scenes |= {"sheet": settings.sheet, "rail": settings.rail, HELD_OUT: held_out}
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
