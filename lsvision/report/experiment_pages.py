"""Reports of a calibration and of a product."""

from collections.abc import Sequence
from pathlib import Path

import torch

from lsvision.io import Product
from lsvision.report.board_motion import board_motion_figures, board_motion_tables
from lsvision.report.calibration_figures import (
    components_by_iteration,
    corner_positions,
    observability_bars,
    rmse_by_iteration,
    stretch_by_iteration,
)
from lsvision.report.installation_pages import installation_sketch, installation_tables
from lsvision.report.line_motion_figures import product_motion_figures
from lsvision.report.line_motion_pages import findings_table
from lsvision.report.line_motion_words import line_motion_words
from lsvision.report.pages import Headline, Page, ReportFigure, Table, write_report
from lsvision.report.product_figures import product_images
from lsvision.report.space_figures import corners_in_space, surface_in_space
from lsvision.report.summary import calibration_summary
from lsvision.stages.correction.uncertainty import drift_per_metre
from lsvision.types import BoardCorners, Calibration

_PROVENANCE = ("scan", "calibration", "calibration_sha256", "key")  # of a product's metadata
_SHOWN_ROWS = 4000  # of a product, from its start: they fit in memory however long the scan is


def calibration_report(calibration: Calibration, boards: Sequence[BoardCorners], settings: dict, folder: Path) -> None:
    """``report.html`` of a calibration: n with its sigma, the observed directions, and the fit of every board."""
    motion = calibration.motion
    sigma = motion.sigma.tolist()
    rows = [
        (
            Path(fit.scan).name, str(fit.corners), f"{fit.rmse_before_mm:.4f}", f"{fit.rmse_after_mm:.4f}",
            "" if fit.reduced_chi_square is None else f"{fit.reduced_chi_square:.2f}",
        )
        for fit in calibration.boards
    ]  # fmt: skip
    curves = {str(calibration.method): calibration}
    page = Page(
        title=f"Calibration from {len(boards)} board scan(s)",
        lead=". ".join([calibration_summary(calibration).splitlines()[0], *_explained(calibration)]),
        headlines=[
            Headline("Verdict", calibration.verdict, "usable" if calibration.usable else "not usable"),
            Headline("RMSE", f"{calibration.rmse_after_mm:.4f} mm", f"before: {calibration.rmse_before_mm:.4f} mm"),
            Headline("Stretch", f"{motion.stretch:.6f}", "true over nominal travel"),
            *(
                Headline(f"n{i + 1}", f"{value:+.6f}", f"± {sigma[i]:.1e} mm per mm")
                for i, value in enumerate(motion.n.tolist())
            ),
        ],
        tables=[
            Table(
                "Boards",
                ("scan", "corners", "RMSE before [mm]", "RMSE after [mm]", "chi-square per degree of freedom"),
                rows,
                "The last column is 1 where the residuals are as large as the corners' stated sigmas; over all boards "
                f"the noise was scaled by {calibration.noise_scale:.3g}.",
            ),
            *board_motion_tables(calibration),
            *installation_tables(calibration.installation),
        ],
        figures=[
            rmse_by_iteration(curves),
            components_by_iteration(curves),
            stretch_by_iteration(curves),
            observability_bars(calibration),
            corners_in_space(boards, calibration),
            *(
                corner_positions(board, calibration, name=f"corner_positions_{index}", label=Path(board.scan).name)
                for index, board in enumerate(boards, start=1)
            ),
            *board_motion_figures(calibration, boards),
            *installation_sketch(calibration.installation),
        ],
        settings=settings,
        provenance={
            "configuration": f"sha256 {calibration.provenance.config_sha256}",
            **{path: f"sha256 {digest}" for path, digest in calibration.provenance.scans},
        },
    )
    write_report(page, folder)


def _motion_headlines(calibration: Calibration) -> list[Headline]:
    """The calibration's verdict, the motion that was corrected and how far positions may drift."""
    sideways, in_depth = calibration.motion.drift_mm_per_m
    drift = max(drift_per_metre(calibration.motion))
    return [
        Headline("Calibration", calibration.verdict, "; ".join(calibration.reasons) or "n is known in every direction"),
        Headline("Motion sideways", f"{sideways:+.3f} mm/m", "corrected"),
        Headline("Motion in depth", f"{in_depth:+.3f} mm/m", "corrected"),
        Headline("Drift", f"{drift:.3f} mm/m", "one sigma, from the uncertainty of n"),
    ]


def _explained(calibration: Calibration) -> list[str]:
    """The reasons for the verdict, what was noticed and allowed for, and the advice where it is not one of them."""
    advice = calibration.observability.advice
    allowed_for = [error.in_words for error in calibration.errors_along_scan]
    return [
        *calibration.reasons,
        *calibration.notes,
        *allowed_for,
        *([] if advice in calibration.reasons else [advice]),
    ]


def product_report(
    product: Product, calibration: Calibration, valid_share: float, settings: dict, folder: Path
) -> None:
    """``report.html`` of a product: size, share of valid cells, its motion, colour and height of its beginning."""
    rows = min(product.shape[0], _SHOWN_ROWS)
    line_motion = product.line_motion_metadata
    height = product.height(0, rows)
    measured = height[torch.isfinite(height)]
    span = f"{float(measured.min()):.2f} .. {float(measured.max()):.2f} mm" if measured.numel() else "nothing measured"
    figures: list[ReportFigure] = [
        product_images(
            "product", "Colour and height", product.color(0, rows), height, product.pitch_mm, product.origin_mm
        ),
        surface_in_space("surface", height, product.pitch_mm, product.origin_mm),
        *product_motion_figures(product),
    ]
    page = Page(
        title=f"Corrected scan {product.path.stem}",
        lead=f"Orthographic product of {product.metadata.get('scan', '')} in the frame of its motion; "
        + ". ".join(line.strip() for line in line_motion_words(line_motion)),
        headlines=[
            Headline("Size", f"{product.shape[0]} x {product.shape[1]} cells", f"of {product.pitch_mm:.4f} mm"),
            Headline("Measured", f"{100 * valid_share:.1f} %", "of all cells"),
            Headline("Heights", span, f"first {rows} rows"),
            *_motion_headlines(calibration),
        ],
        tables=[findings_table(line_motion, settings["registration"])] if line_motion.get("components") else [],
        figures=figures,
        settings=settings,
        provenance={key: str(product.metadata[key]) for key in _PROVENANCE if key in product.metadata},
    )
    write_report(page, folder)
