"""The report of a calibrated raw rig."""

from pathlib import Path

from lsvision.geometry import quantities_of
from lsvision.report.drawing import AFTER, BEFORE, label_axes, new_figure
from lsvision.report.installation_pages import installation_sketch, installation_tables
from lsvision.report.installation_words import installation_lines
from lsvision.report.pages import Headline, Page, ReportFigure, Table, write_report
from lsvision.report.summary import drift_in_words
from lsvision.types import RIG_QUANTITIES, RawRig, RigCalibration


def rig_summary(calibration: RigCalibration) -> str:
    """A calibrated rig in plain words, for the terminal."""
    verdict = calibration.verdict if calibration.usable else calibration.verdict.upper()
    corners = sum(board.corners for board in calibration.boards)
    outliers = sum(board.outliers for board in calibration.boards)
    left_out = f", {outliers} left out" if outliers else ""
    lines = [
        f"rig from {len(calibration.boards)} board scan(s), {corners} corners{left_out}: {verdict}",
        f"  heights      known to {calibration.height_error_um:.3g} um (rms over the field) but for the object's pose",
        f"  noise        {calibration.noise_scale:.2g} times the corners' stated sigmas",
        f"  stretch      {calibration.motion.stretch:.6f}",
        f"  drift        {drift_in_words(calibration.motion)}",
    ]
    lines += [f"  allowed for  {error.in_words}" for error in calibration.errors_along_scan]
    lines += [f"  because      {reason}" for reason in calibration.reasons if reason != calibration.advice]
    lines += [
        f"  not measured {item.in_words}: sigma stays at {item.share:.2f} of the data sheet's"
        for item in calibration.unobserved
    ]
    return "\n".join([*lines, f"  next         {calibration.advice}", *installation_lines(calibration.installation)])


def rig_report(calibration: RigCalibration, start: RawRig, settings: dict, folder: Path) -> None:
    """``report.html`` of a calibrated rig: its quantities with their sigmas, and what was left of the corners.

    Args:
        start: the rig of the data sheet.
    """
    page = Page(
        title=f"Rig from {len(calibration.boards)} board scan(s)",
        lead=". ".join([rig_summary(calibration).splitlines()[0], *calibration.reasons]),
        headlines=[
            Headline("Verdict", calibration.verdict, "usable" if calibration.usable else "not usable"),
            Headline(
                "Heights", f"{calibration.height_error_um:.3g} um", "rms over the field, but for the object's pose"
            ),
            Headline("Noise", f"{calibration.noise_scale:.2f}", "times the corners' stated sigmas"),
            Headline("Stretch", f"{calibration.motion.stretch:.6f}", "true over nominal travel"),
        ],
        tables=[
            _quantities(calibration, start),
            _boards(calibration),
            *_combinations(calibration),
            *installation_tables(calibration.installation),
        ],
        figures=[
            _by("column", calibration),
            _by("depth", calibration),
            _coverage(calibration),
            *installation_sketch(calibration.installation),
        ],
        settings=settings,
        provenance={
            "configuration": f"sha256 {calibration.provenance.config_sha256}",
            **{path: f"sha256 {digest}" for path, digest in calibration.provenance.scans},
        },
    )
    write_report(page, folder)


def _quantities(calibration: RigCalibration, start: RawRig) -> Table:
    before, after, sigma = (
        quantities_of(start).tolist(),
        quantities_of(calibration.rig).tolist(),
        dict(calibration.rig.sigma),
    )
    rows = [
        (name, f"{new:.6g}", f"{sigma[name]:.2g}", f"{old:.6g}")
        for name, old, new in zip(RIG_QUANTITIES, before, after, strict=True)
    ]
    return Table(
        "Rig", ("quantity", "found", "sigma", "data sheet"), rows, "As in rig.yaml; lengths in mm, columns in px."
    )


def _boards(calibration: RigCalibration) -> Table:
    rows = [
        (
            Path(board.scan).name, str(board.corners), str(board.outliers), f"{board.rms:.2f}",
            "" if board.held_out_rms is None else f"{board.held_out_rms:.2f}",
        )
        for board in calibration.boards
    ]  # fmt: skip
    note = (
        "Residuals in sigmas: 1 where the corners are off by as much as they are stated to be. The last column is by "
        "the rig of all other boards, with this board's pose alone fitted."
    )
    return Table("Boards", ("scan", "corners", "left out", "rms [sigma]", "rms, held out [sigma]"), rows, note)


def _combinations(calibration: RigCalibration) -> list[Table]:
    rows = [(item.in_words, f"{item.share:.2f}", f"{item.bend_um:.2g}") for item in calibration.unobserved]
    if not rows:
        return []
    note = "Combinations, in sigmas of the data sheet, of which the scans say less than the data sheet."
    return [Table("Not measured", ("combination", "sigma over the data sheet's", "bends heights by [um]"), rows, note)]


def _by(what: str, calibration: RigCalibration) -> ReportFigure:
    """Residuals of columns and travels in both images against the column or the depth."""
    figure, axes = new_figure(9.5, 5.6, 2, 2, sharex="col" if what == "depth" else "all")
    for side, (name, residuals) in enumerate(zip(("left", "right"), calibration.residuals, strict=True)):
        place = residuals.column_px if what == "column" else residuals.depth_mm
        for row, (quantity, unit, scale) in enumerate((("column", "px", 1.0), ("travel", "um", 1e3))):
            panel = axes[2 * row + side]
            panel.plot(
                place.flatten(), scale * residuals.off[..., row].flatten(), ".", ms=2.5, color=(AFTER, BEFORE)[side]
            )
            panel.axhline(0.0, color="#555555", linewidth=0.6)
            label = "column [px]" if what == "column" else "depth z [mm]"
            label_axes(panel, f"{name} image", label, f"{quantity} off by [{unit}]")
    caption = (
        f"Corners measured less predicted, by {what}. A curve that all boards share is something that the model of "
        "the cameras lacks; a curve of one board is a board that is not flat, or an object that shook."
    )
    return ReportFigure(f"residuals_by_{what}", f"Residuals by {what}", caption, figure)


def _coverage(calibration: RigCalibration) -> ReportFigure:
    figure, (axes,) = new_figure(7.5, 3.8)
    left = calibration.residuals[0]
    seen = left.off.isfinite().all(-1)
    for board, (place, depth, shown) in enumerate(zip(left.column_px, left.depth_mm, seen, strict=True)):
        axes.plot(place[shown], depth[shown], ".", ms=3, label=Path(calibration.boards[board].scan).name)
    axes.set_xlim(0, calibration.rig.width_px - 1)
    label_axes(axes, "What the boards covered", "column of the left image [px]", "depth z [mm]")
    if len(calibration.boards) <= 8:
        figure.legend(loc="outside right upper", fontsize=8)
    caption = (
        "Heights are known where boards were: over the whole line, and over the depth in which objects are measured."
    )
    return ReportFigure("coverage", "Coverage of field and depth", caption, figure)
