"""The report of the paper's experiment: its figures and tables redone, its numbers beside ours."""

import math
from collections.abc import Mapping
from pathlib import Path

from torch import Tensor

from lsvision.report import Headline, Page, ReportFigure, Table, write_report
from lsvision.report.calibration_figures import (
    components_by_iteration,
    corner_positions,
    corners_on_images,
    observability_bars,
    rmse_by_iteration,
    stretch_by_iteration,
)
from lsvision.report.paper_scenario import PAPER, Scenario, Trial
from lsvision.report.product_figures import SheetView, height_profile, product_images, sheet_correspondences
from lsvision.simulation.sheet_points import SheetPoints

# What of the motion was corrected in the sheet's product, by the source of its motion from line to line.
_SHEET_SOURCES = {
    "none": "n of boards with steadied lines",
    "auto": "that n, and lines by the sheet's profile and edges",
    "log": "that n, and lines by an exact log",
}


def write_paper_report(folder: Path, scenarios: Mapping[str, Scenario], paper_numbers: Trial, settings: dict) -> None:
    """``report.html``: the paper's figures 14-19 redone, its numbers beside ours."""
    still, vibrating = scenarios["still"], scenarios["vibrating"]
    numbers = paper_numbers.result
    page = Page(
        title="Motion distortion of a line-scan stereo camera: Wang et al. 2024 redone",
        lead=(
            f"{len(still.boards) - 1} tilted boards, a printed sheet and a rail were rendered as scan files, read "
            "back, calibrated and corrected: once in smooth motion, and once with a vibration. The joint calibration "
            "uses all these boards, the paper's two-step method the first one alone; a further board checks both. The "
            "paper measured a machine: its figures compare with those of one board that moves and shakes as they "
            "suggest, not with boards that move smoothly."
        ),
        headlines=[
            Headline(
                "The paper's scheme on a board shaken as in the paper",
                f"{numbers.rmse_before_mm:.3f} -> {numbers.rmse_after_mm:.4f} mm",
                "paper, measured: 2.059 -> 0.8794 mm",
            ),
            *(
                Headline(
                    f"Board held out, {name}, joint",
                    f"{scenario.trials['joint'].held_out_mm:.3f} mm",
                    f"two-step: {scenario.trials['two_step'].held_out_mm:.3f} mm, "
                    f"nominal motion: {scenario.held_out_before_mm:.2f} mm",
                )
                for name, scenario in (("no vibration", still), ("vibration", vibrating))
            ),
            Headline(
                "Board distances in the product",
                f"{max(check.pairs_after_mm for check in still.checks.values()):.3f} mm rms",
                f"as scanned: {max(check.pairs_before_mm for check in still.checks.values()):.2f} mm",
            ),
        ],
        tables=[methods_table(scenarios, paper_numbers), distances_table(scenarios), sheet_table(scenarios)],
        figures=[*_calibration_figures(still, vibrating, paper_numbers), *_product_figures(still)],
        settings=settings,
    )
    write_report(page, folder)


def _calibration_figures(still: Scenario, vibrating: Scenario, paper_numbers: Trial) -> list[ReportFigure]:
    """Convergence of both methods in all scenarios; what the boards measured."""
    curves = {
        f"{method}, {name}": scenario.trials[method].result
        for name, scenario in (("no vibration", still), ("vibration", vibrating))
        for method in ("joint", "two_step")
    }
    n_true = still.trials["joint"].n_true
    first_board = next(iter(still.boards.values()))
    return [
        rmse_by_iteration(
            {**curves, "two_step, the paper's numbers": paper_numbers.result}, {"paper, after": PAPER["rmse_after_mm"]}
        ),
        components_by_iteration(curves, {"truth": n_true.tolist()}),
        stretch_by_iteration(curves, float(n_true.norm())),
        corner_positions(first_board, still.trials["joint"].result),
        *(
            observability_bars(trial.result, name=f"observability_{method}", label=method)
            for method, trial in still.trials.items()
        ),
    ]


def _product_figures(still: Scenario) -> list[ReportFigure]:
    """A board, the sheet and the rail as scanned and as corrected."""
    board, sheet, rail = next(iter(still.boards)), still.products["sheet"], still.products["rail"]
    height = rail.height(0, rail.shape[0])
    middle_half = height[len(height) // 4 : 3 * len(height) // 4]
    return [
        corners_on_images(still.scanned_board(board), still.corrected_board(board), still.products[board].pitch_mm),
        sheet_correspondences(
            _sheet_view(still.image("sheet"), still.sheet_before),
            _sheet_view(sheet.color(0, sheet.shape[0]), still.sheet_after),
            sheet.pitch_mm,
        ),
        product_images(
            "rail", "The rail, corrected", rail.color(0, rail.shape[0]), height, rail.pitch_mm, rail.origin_mm
        ),
        height_profile("rail_profile", "Cross-section of the rail", middle_half, rail.pitch_mm, rail.origin_mm[1]),
    ]


def _sheet_view(image: Tensor, points: SheetPoints) -> SheetView:
    return SheetView(image, points.true_mm[:, :2], points.measured_mm[:, :2])


def methods_table(scenarios: Mapping[str, Scenario], paper_numbers: Trial) -> Table:
    """The calibrations of all scenarios by all methods, the paper's first."""
    rows = [
        ("paper", "measured", "two-step", "2.059", "0.8794", "57.3 %", "5", "1.0246", "", "", "", "not stated"),
        _row("the paper's numbers", "two_step", paper_numbers),
        *(
            _row(name, method, trial)
            for name, scenario in scenarios.items()
            for method, trial in scenario.trials.items()
        ),
    ]
    return Table(
        "Calibration",
        (
            "scenario", "scans", "method", "RMSE before [mm]", "after [mm]", "improvement", "iterations",
            "stretch [mm per mm]", "board held out [mm]", "error of n1, n2, n3 [mm per mm]",
            "σ of n1, n2, n3 [mm per mm]", "verdict",
        ),
        rows,
        "One board cannot distinguish a tilt of the motion in depth from a tilt of the board: in that direction its "
        "result repeats the prior, however small its RMSE. The board held out is fitted under each method's n, which "
        "has not seen it. A vibration remains in every RMSE, as a constant n does not describe it.",
    )  # fmt: skip


def _row(scenario: str, method: str, trial: Trial) -> tuple[str, ...]:
    result = trial.result
    error = (result.motion.n - trial.n_true).tolist()
    return (
        scenario,
        "simulated",
        method,
        f"{result.rmse_before_mm:.4f}",
        f"{result.rmse_after_mm:.4f}",
        f"{100 * result.improvement:.1f} %",
        str(len(result.iterations) - 1),
        f"{result.motion.stretch:.5f}",
        "" if math.isnan(trial.held_out_mm) else f"{trial.held_out_mm:.4f}",
        "  ".join(f"{value:+.1e}" for value in error),
        "  ".join(f"{value:.1e}" for value in result.motion.sigma.tolist()),
        result.verdict,
    )


def distances_table(scenarios: Mapping[str, Scenario]) -> Table:
    """Errors of the distances between the corners of every board, before and after the correction."""
    named = [(name, scenario.checks) for name, scenario in scenarios.items()]
    named += [
        (f"{name}, lines steadied", scenario.steadied.checks)
        for name, scenario in scenarios.items()
        if scenario.steadied is not None
    ]
    rows = [
        (
            name,
            label.replace("_", " "),
            str(check.corners),
            f"{check.neighbours_before_mm:.3f}",
            f"{check.neighbours_after_mm:.3f}",
            f"{check.pairs_before_mm:.3f}",
            f"{check.pairs_after_mm:.3f}",
        )
        for name, checks in named
        for label, check in checks.items()
    ]
    return Table(
        "Boards measured in the product",
        (
            "scenario", "board", "corners", "neighbours before [mm rms]", "after [mm rms]",
            "all pairs before [mm rms]", "after [mm rms]",
        ),
        rows,
        "Rms error of the distances between corners: before under the nominal motion, after in the product. Where "
        "lines are steadied, each board's scan was corrected with the motion that its own corners and edges show.",
    )  # fmt: skip


def sheet_table(scenarios: Mapping[str, Scenario]) -> Table:
    """The printed sheet against its artwork: as scanned, with n corrected, and with the motion from line to line."""
    rows: list[tuple[str, ...]] = []
    for name, scenario in scenarios.items():
        rows += [
            (name, "nothing", f"{scenario.sheet_before.rms_mm:.3f}", "", "", "", ""),
            (name, "n", f"{scenario.sheet_after.rms_mm:.3f}", "", "", "", ""),
        ]
        sheets = {} if scenario.steadied is None else scenario.steadied.sheets
        rows += [
            (
                name,
                _SHEET_SOURCES[source],
                *(f"{value:.3f}" for value in (sheet.rms_mm, *sheet.by_axis_mm, sheet.unsheared_mm)),
            )
            for source, sheet in sheets.items()
        ]
    return Table(
        "The sheet against its artwork",
        (
            "scenario",
            "corrected",
            "error [mm rms]",
            "across [mm rms]",
            "along [mm rms]",
            "in depth [mm rms]",
            "but for a shear [mm rms]",
        ),
        rows,
        "The profile of a flat sheet shows by how much each line is displaced in depth and rolled. Its straight edges "
        "along the travel show by how much sideways, but for the trend, which looks like a sheared sheet: that follows "
        "from the waves of the motion. Displacement along the travel is not observed, and stays; a log shows it.",
    )
