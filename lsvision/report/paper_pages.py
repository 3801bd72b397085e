"""The report of the paper's experiment: its figures and tables redone, its numbers beside ours."""

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
from lsvision.report.paper_scenario import PAPER, Scenario
from lsvision.report.product_figures import SheetView, height_profile, product_images, sheet_correspondences
from lsvision.simulation.sheet_points import SheetPoints


def write_paper_report(folder: Path, scenarios: Mapping[str, Scenario], settings: dict) -> None:
    """``report.html``: the paper's figures 14-19 redone, its numbers beside ours."""
    still, vibrating = scenarios["still"], scenarios["vibrating"]
    joint = still.results["joint"]
    page = Page(
        title="Motion distortion of a line-scan stereo camera: Wang et al. 2024 redone",
        lead=(
            f"{len(still.boards)} tilted boards, a printed sheet and a rail were rendered as scan files, read back, "
            "calibrated and corrected: once in smooth motion, and once with a vibration, after whose calibration as "
            "large an error remains as in the paper. The joint calibration uses all boards, the paper's two-step "
            "method the first one alone."
        ),
        headlines=[
            Headline("RMSE after, no vibration", f"{joint.rmse_after_mm:.4f} mm", "paper: 0.8794 mm"),
            *(
                Headline(f"Improvement with vibration, {method}", f"{100 * result.improvement:.1f} %", "paper: 57.3 %")
                for method, result in vibrating.results.items()
            ),
            Headline(
                "Board distances in the product",
                f"{max(check.pairs_after_mm for check in still.checks.values()):.3f} mm rms",
                f"as scanned: {max(check.pairs_before_mm for check in still.checks.values()):.2f} mm",
            ),
        ],
        tables=[methods_table(scenarios), distances_table(scenarios)],
        figures=[*_calibration_figures(still, vibrating), *_product_figures(still)],
        settings=settings,
    )
    write_report(page, folder)


def _calibration_figures(still: Scenario, vibrating: Scenario) -> list[ReportFigure]:
    """Convergence of both methods in both scenarios; what the boards measured."""
    curves = {
        f"{method}, {name}": scenario.results[method]
        for name, scenario in (("no vibration", still), ("vibration", vibrating))
        for method in ("joint", "two_step")
    }
    first_board = next(iter(still.boards.values()))
    return [
        rmse_by_iteration(curves, {"paper, after": PAPER["rmse_after_mm"]}),
        components_by_iteration(curves, {"truth": still.n_true.tolist()}),
        stretch_by_iteration(curves, float(still.n_true.norm())),
        corner_positions(first_board, still.results["joint"]),
        *(
            observability_bars(result, name=f"observability_{method}", label=method)
            for method, result in still.results.items()
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


def methods_table(scenarios: Mapping[str, Scenario]) -> Table:
    """The calibrations of all scenarios by all methods, the paper's first."""
    paper = ("paper", "two-step", "2.059", "0.8794", "57.3 %", "5", "1.0246", "", "", "not stated")
    rows = [paper]
    for name, scenario in scenarios.items():
        for method, result in scenario.results.items():
            error = (result.motion.n - scenario.n_true).tolist()
            rows.append(
                (
                    name,
                    method,
                    f"{result.rmse_before_mm:.4f}",
                    f"{result.rmse_after_mm:.4f}",
                    f"{100 * result.improvement:.1f} %",
                    str(len(result.iterations) - 1),
                    f"{result.motion.stretch:.5f}",
                    "  ".join(f"{value:+.1e}" for value in error),
                    "  ".join(f"{value:.1e}" for value in result.motion.sigma.tolist()),
                    result.verdict,
                )
            )
    header = (
        "scenario",
        "method",
        "RMSE before [mm]",
        "after [mm]",
        "improvement",
        "iterations",
        "stretch [mm per mm]",
    )
    return Table(
        "Calibration",
        (*header, "error of n1, n2, n3 [mm per mm]", "σ of n1, n2, n3 [mm per mm]", "verdict"),
        rows,
        "One board cannot distinguish a tilt of the motion in depth from a tilt of the board: in that direction its "
        "result repeats the prior, however small its RMSE.",
    )


def distances_table(scenarios: Mapping[str, Scenario]) -> Table:
    """Errors of the distances between the corners of every board, before and after the correction."""
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
        for name, scenario in scenarios.items()
        for label, check in scenario.checks.items()
    ]
    return Table(
        "Boards measured in the product",
        (
            "scenario", "board", "corners", "neighbours before [mm rms]", "after [mm rms]",
            "all pairs before [mm rms]", "after [mm rms]",
        ),
        rows,
        "Rms error of the distances between corners: before under the nominal motion, after in the product.",
    )  # fmt: skip
