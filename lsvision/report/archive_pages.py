"""The report of a reprocessed archive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lsvision.archive import Alarm, InspectedScan, ScanRow, health_in_words, product_path, worst_candidates
from lsvision.io import read_product
from lsvision.report import Headline, Page, ReportFigure, Table, write_report
from lsvision.report.drawing import new_figure, show_image, thinned
from lsvision.report.health_figures import health_figures, health_tables
from lsvision.report.surface_pages import WORST, surfaces_tables
from lsvision.stages.health.config import HealthConfig

_MAX_THUMBNAILS = 24
_THUMBNAILS_ACROSS = 6
_ROWS = 1024


@dataclass(frozen=True)
class Run:
    """A run over an archive: where its products lie, how long it took, its options, drifts and surfaces."""

    output: Path
    seconds: float
    settings: dict[str, Any]
    health: HealthConfig
    alarms: Sequence[Alarm] = ()
    surfaces: Sequence[InspectedScan] = ()


def reprocess_report(rows: Mapping[str, ScanRow], processed: Sequence[ScanRow], run: Run, folder: Path) -> None:
    """``report.html`` of a run: every scan of the archive, why some failed, drifts, and the first products it made.

    Args:
        rows: of all scans, as the ledger has them.
        processed: rows of those that this run processed.
    """
    output, seconds = run.output, run.seconds
    failed = [row for row in rows.values() if row.status == "failed"]
    made = [row for row in processed if row.status == "done"]
    lines = sum(row.lines for row in made)
    page = Page(
        title=f"Archive of {len(rows)} scans",
        lead=f"{len(made)} scans were reprocessed into {output}, {len(rows) - len(made) - len(failed)} were up to date "
        f"and {len(failed)} failed.",
        headlines=[
            Headline("Done", str(len(made)), "by this run"),
            Headline("Failed", str(len(failed)), f"of {len(rows)} scans"),
            Headline("Drifts", str(len(run.alarms)), health_in_words(rows, run.alarms, run.health)),
            Headline("Lines", str(lines), f"in {seconds:.1f} s: {lines / max(seconds, 1e-9):.0f} lines per second"),
        ],
        tables=[
            *health_tables(run.alarms),
            *(surfaces_tables(run.surfaces, worst_candidates(output, WORST)) if run.surfaces else ()),
            Table("Failed scans", ("scan", "reason"), [(row.scan, row.error) for row in failed]),
            Table(
                "Scans",
                (
                    "scan", "status", "lines", "measured [%]", "work [s]", "calibration", "verdict",
                    "sideways [mm/m]", "in depth [mm/m]", "drift, one sigma [mm/m]",
                    "δx, rms [mm]", "δz, rms [mm]", "motion from line to line",
                ),
                [
                    (row.scan, row.status, str(row.lines), f"{100 * row.measured_share:.1f}", f"{row.seconds:.1f}",
                     Path(row.calibration).name, row.verdict, *_drift_columns(row), *_line_motion_columns(row))
                    for row in rows.values()
                ],
            ),
        ],
        figures=[*health_figures(rows, run.alarms, run.health), *([_thumbnails(made, output)] if made else [])],
        settings=run.settings,
    )  # fmt: skip
    write_report(page, folder)


def _drift_columns(row: ScanRow) -> list[str]:
    """The corrected motion and its sigma, of a scan whose calibration is known."""
    values = (row.sideways_mm_per_m, row.in_depth_mm_per_m, row.drift_sigma_mm_per_m)
    return [f"{value:.3f}" if row.verdict else "" for value in values]


def _line_motion_columns(row: ScanRow) -> tuple[str, ...]:
    """The rms of the vibration that was corrected, where any was, and all that is known about it."""
    shown = (f"{value:.3f}" if value > 0 else "" for value in (row.rms_dx_mm, row.rms_dz_mm))
    return *shown, row.line_motion


def _thumbnails(made: Sequence[ScanRow], output: Path) -> ReportFigure:
    shown = made[:_MAX_THUMBNAILS]
    down, across = -(-len(shown) // _THUMBNAILS_ACROSS), min(_THUMBNAILS_ACROSS, len(shown))
    figure, axes = new_figure(1.9 * across, 2.1 * down, down, across, squeeze=False)
    for panel in axes:
        panel.set_axis_off()
    for number, (panel, row) in enumerate(zip(axes, shown, strict=False), start=1):
        product = read_product(product_path(output, row.scan))
        image = thinned(product.color(0, min(_ROWS, product.shape[0])), 200)
        show_image(panel, image, (0, image.shape[1], image.shape[0], 0))
        panel.set_title(str(number), fontsize=7)  # no font has the letters of every name
    names = ", ".join(f"{number} {row.scan}" for number, row in enumerate(shown, start=1))
    caption = f"The first {_ROWS} rows of products of this run: {names}."
    return ReportFigure("thumbnails", "Products", caption, figure)
