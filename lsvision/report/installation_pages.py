"""How to align the cameras: tables and a sketch for reports."""

from matplotlib.axes import Axes

from lsvision.report.drawing import BEFORE, TRUTH, new_figure
from lsvision.report.installation_words import after_in_words, angle_in_words, pitch_in_words, turns_in_words
from lsvision.report.pages import Headline, ReportFigure, Table
from lsvision.types import Installation, Turn

_AXES = (
    "X points to the larger columns, Z from the cameras to the object, Y to where the object comes from "
    "(where it goes, if the transport is reversed)"
)
_SHOWN = 0.45  # of an axis, by which the arrow of the motion is off Y, however small the angle


def installation_headline(installation: Installation) -> Headline:
    """The angle and the verdict."""
    return Headline(
        "Installation",
        f"{installation.angle_deg:.2f}°",
        f"{installation.verdict} ({installation.tolerance_deg:g}°)",
    )


def installation_tables(installation: Installation | None) -> list[Table]:
    """What to turn and to set, and by how much each mounting point moves."""
    if installation is None:
        return []
    rows = [(f"turn {i}", sentence) for i, sentence in enumerate(turns_in_words(installation), start=1)]
    rows += [("line pitch", pitch_in_words(installation)), ("then", after_in_words(installation))]
    shifts = [
        (item.name, *(f"{value:g}" for value in item.position_mm), *(f"{value:+.3f}" for value in item.shift_mm))
        for item in installation.shifts
    ]
    header = ("mounting point", "x [mm]", "y [mm]", "z [mm]", "move x [mm]", "move y [mm]", "move z [mm]")
    note = (
        f"By the turns that were observed, about the middle of the points. {_AXES}: positive z is nearer to the object."
    )
    return [
        Table("Align the cameras", ("what", "how"), rows, f"{angle_in_words(installation)}."),
        Table("Mounting points", header, shifts, note),
    ]


def installation_sketch(installation: Installation | None) -> list[ReportFigure]:
    """The cameras' axes and the motion, seen by the cameras and from the side."""
    if installation is None:
        return []
    figure, panels = new_figure(9.0, 3.6, 1, 2)
    _draw(panels[0], installation.about_z, "seen by the cameras", "X", -installation.about_z.angle_deg)
    _draw(panels[1], installation.about_x, "seen from the larger columns", "Z", installation.about_x.angle_deg)
    caption = (
        "Turn the cameras so that their Y axis lies along the orange arrow, whose angle is exaggerated. "
        f"A positive turn about the viewing axis goes from X to Y, one about the sensor from Y to Z. {_AXES}."
    )
    return [ReportFigure("installation", "How the cameras are turned", caption, figure)]


def _draw(panel: Axes, turn: Turn, seen: str, across: str, off_deg: float) -> None:
    """The axis ``across`` and Y, which points down as lines do in an image, and the motion, off Y by an angle."""
    for tip, label in (((1.0, 0.0), across), ((0.0, 1.0), "Y")):
        _arrow(panel, tip, TRUTH)
        panel.text(1.15 * tip[0], 1.15 * tip[1], label, ha="center", va="center", color=TRUTH)
    if turn.observed:
        off = _SHOWN if off_deg > 0 else -_SHOWN
        _arrow(panel, (off, 1.0), BEFORE)
        panel.text(1.15 * off, 1.15, "object", ha="center", va="center", color=BEFORE)
    how = f"turn {turn.angle_deg:+.3f}° about {turn.axis.upper()}" if turn.observed else "not observed"
    panel.set_title(f"{seen}: {how}", fontsize=10)
    panel.set_xlim(-1.3, 1.3)
    panel.set_ylim(1.3, -0.3)
    panel.set_aspect("equal")
    panel.axis("off")


def _arrow(panel: Axes, tip: tuple[float, float], color: str) -> None:
    panel.annotate("", xy=tip, xytext=(0.0, 0.0), arrowprops={"arrowstyle": "-|>", "color": color, "linewidth": 1.6})
