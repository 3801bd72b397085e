"""Options of watching the health of an archive."""

from dataclasses import dataclass

from lsvision.schema import Checked, IntFrom2, NonNegative, Positive


@dataclass(frozen=True)
class HealthConfig(Checked):
    """When a drift of an archive's scans is an alarm.

    Each signal is watched by a self-starting CUSUM over the scans in order of time, which learns from ``learned`` scans
    first. ``allowance`` and ``limit`` are in standard deviations of a scan: changes of less than the allowance count
    for nothing, and an alarm is given where the excess over it adds up to the limit. A change that is smaller than its
    tolerance is none, however significant: degrees of the direction, a relative change of the travel or of the gain,
    lines of the row offset. A value that is known less well than its tolerance counts as not measured.
    """

    learned: IntFrom2 = 8
    allowance: NonNegative = 1.0
    limit: Positive = 4.8
    direction_deg: Positive = 0.05
    travel: Positive = 0.001
    row_offset_lines: Positive = 0.1
    gain: Positive = 0.02
