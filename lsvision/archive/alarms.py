"""The alarms that an archive gives: signals of its scans that have changed, and the calibration that they need."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch

from lsvision.archive.ledger import ScanRow
from lsvision.estimation import ChangeRule, changes
from lsvision.stages.health.config import HealthConfig

_LEAST_SIGMA = 0.1  # of a tolerance: scans that agree better do so by chance


@dataclass(frozen=True)
class Signal:
    """A signal that is watched: its columns in the ledger, its name and unit, and what a drift of it asks for.

    Attributes:
        tolerance: the option with the least change that is one.
    """

    value: str
    sigma: str | None
    tolerance: str
    name: str
    unit: str
    advice: str


SIGNALS = (
    Signal(
        "askew_sideways_deg", "askew_sideways_sigma_deg", "direction_deg", "direction sideways", "°",
        "scan boards and calibrate the motion anew",
    ),
    Signal(
        "askew_in_depth_deg", "askew_in_depth_sigma_deg", "direction_deg", "direction in depth", "°",
        "scan boards and calibrate the motion anew",
    ),
    Signal(
        "travel_rate", "travel_sigma", "travel", "advance per line", "",
        "check the encoder, then scan boards and calibrate the motion anew",
    ),
    Signal(
        "row_offset_lines", "row_offset_sigma_lines", "row_offset_lines", "row offset of the cameras", " lines",
        "check the cameras' triggers and mounting, then calibrate the rig anew",
    ),
    Signal(
        "gain_ratio", None, "gain", "gain of the cameras", "",
        "clean lenses and lights, then measure the response anew",
    ),
)  # fmt: skip


@dataclass(frozen=True)
class Alarm:
    """A drift of a signal over the scans of one calibration.

    Attributes:
        signal: which one. size: of the change, in its unit.
        scans: those after it, in order of time, up to the latest or the next change.
    """

    signal: Signal
    size: float
    scans: tuple[str, ...]

    @property
    def in_words(self) -> str:
        """The alarm in one line."""
        which = f"{self.scans[0]}" if len(self.scans) == 1 else f"{self.scans[0]} to {self.scans[-1]}"
        count = f"{len(self.scans)} scan{'s' * (len(self.scans) > 1)}"
        size = f"{self.size:+.3g}{self.signal.unit}"
        return f"{self.signal.name} changed by {size} with {which} ({count}): {self.signal.advice}"


def alarms(rows: Mapping[str, ScanRow], config: HealthConfig | None = None) -> list[Alarm]:
    """The drifts that the scans of an archive show; those of each calibration are judged by themselves.

    Scans are in order of their attribute ``date``, then of their key.
    """
    config = config or HealthConfig()
    found = []
    for group in groups_of(rows):
        for signal in SIGNALS:
            found += _alarms_of(signal, group, config)
    return found


def groups_of(rows: Mapping[str, ScanRow]) -> list[list[ScanRow]]:
    """Finished scans by calibration, in order of time."""
    done = sorted((row for row in rows.values() if row.status == "done"), key=lambda row: (row.taken, row.scan))
    calibrations = dict.fromkeys(row.calibration_sha256 for row in done)
    return [[row for row in done if row.calibration_sha256 == sha256] for sha256 in calibrations]


def measured_of(signal: Signal, group: Sequence[ScanRow], config: HealthConfig) -> list[ScanRow]:
    """The scans of which a signal is known well enough."""
    most = getattr(config, signal.tolerance)
    seen = [row for row in group if getattr(row, signal.value) is not None]
    return [row for row in seen if signal.sigma is None or (getattr(row, signal.sigma) or 0.0) <= most]


def _alarms_of(signal: Signal, group: Sequence[ScanRow], config: HealthConfig) -> list[Alarm]:
    rows, tolerance = measured_of(signal, group, config), getattr(config, signal.tolerance)
    values = torch.tensor([getattr(row, signal.value) for row in rows], dtype=torch.float64)
    rule = ChangeRule(config.learned, config.allowance, config.limit, _LEAST_SIGMA * tolerance, tolerance)
    found = changes(values, rule)
    ends = [*(change.first for change in found), len(rows)][1:]
    return [
        Alarm(signal, change.size, tuple(row.scan for row in rows[change.first : end]))
        for change, end in zip(found, ends, strict=True)
    ]


def health_in_words(rows: Mapping[str, ScanRow], found: Sequence[Alarm], config: HealthConfig | None = None) -> str:
    """What the signals of an archive's scans show, in one line."""
    config = config or HealthConfig()
    groups = groups_of(rows)
    watched = {
        signal.name: max((len(measured_of(signal, group, config)) for group in groups), default=0) for signal in SIGNALS
    }
    enough = [name for name, scans in watched.items() if scans > config.learned]
    if not enough:
        most = max(watched.values())
        return f"health: no drift can be judged yet: {most} scans have a signal, more than {config.learned} are needed"
    state = f"{len(found)} drift{'s' * (len(found) > 1)}" if found else "no drift"
    missing = [name for name in watched if name not in enough]
    return f"health: {state} in {', '.join(enough)}" + (f"; not measured: {', '.join(missing)}" if missing else "")
