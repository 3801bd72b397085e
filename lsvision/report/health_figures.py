"""What an archive shows of drifts: a table of the alarms, and every signal by scan."""

from collections.abc import Mapping, Sequence
from typing import Any

from lsvision.archive import SIGNALS, Alarm, ScanRow, Signal, groups_of, measured_of
from lsvision.report.drawing import AFTER, BEFORE, label_axes, new_figure, whole_ticks
from lsvision.report.pages import ReportFigure, Table
from lsvision.stages.health.config import HealthConfig

_FEWEST = 2  # scans, of which a figure is drawn


def health_tables(alarms: Sequence[Alarm]) -> list[Table]:
    """The drifts; none where there are none."""
    if not alarms:
        return []
    rows = [
        (
            alarm.signal.name, f"{alarm.size:+.3g}{alarm.signal.unit}", alarm.scans[0], str(len(alarm.scans)),
            alarm.signal.advice,
        )
        for alarm in alarms
    ]  # fmt: skip
    header = ("signal", "change", "from scan", "scans affected", "what to do")
    return [Table("Drifts", header, rows, "Each is judged over the scans of one calibration in order of time.")]


def health_figures(rows: Mapping[str, ScanRow], alarms: Sequence[Alarm], config: HealthConfig) -> list[ReportFigure]:
    """Every signal that some scans have, by scan in order of time; scans after a drift in another colour."""
    groups = groups_of(rows)
    shown = [
        signal for signal in SIGNALS if max((len(measured_of(signal, g, config)) for g in groups), default=0) >= _FEWEST
    ]
    if not shown:
        return []
    order = {row.scan: number for number, row in enumerate((row for group in groups for row in group), start=1)}
    figure, axes = new_figure(9.5, 1.0 + 1.8 * len(shown), len(shown), 1, sharex="all")
    for panel, signal in zip(axes, shown, strict=True):
        drifted = {scan for alarm in alarms if alarm.signal == signal for scan in alarm.scans}
        for after, color in ((False, AFTER), (True, BEFORE)):
            seen = [row for g in groups for row in measured_of(signal, g, config) if (row.scan in drifted) == after]
            _draw(panel, signal, seen, order, color)
        unit = signal.unit.strip()
        label_axes(panel, signal.name, "", f"[{unit}]" if unit else "ratio")
    axes[-1].set_xlabel("scan, in order of time by calibration")
    whole_ticks(axes[-1])
    caption = (
        "Signals that need no target, with one sigma where it is known. Orange: scans after a drift. The direction is "
        "that of the object's own axis against its motion: an object that runs along its axis does not show n."
    )
    return [ReportFigure("health", "Signals of drift", caption, figure)]


def _draw(panel: Any, signal: Signal, rows: Sequence[ScanRow], order: Mapping[str, int], color: str) -> None:
    place, value = [order[row.scan] for row in rows], [getattr(row, signal.value) for row in rows]
    sigma = None if signal.sigma is None else [getattr(row, signal.sigma) or 0.0 for row in rows]
    panel.errorbar(place, value, sigma, fmt="o", ms=3.5, linewidth=0.8, color=color)
