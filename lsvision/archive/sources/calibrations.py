"""Which calibration belongs to a scan: one for all, or by rig and date."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import date
from pathlib import Path
from typing import Annotated

from pydantic import BeforeValidator

from lsvision.errors import CalibrationError, FileFormatError, UnusableCalibrationError
from lsvision.io import check_rig_match, read_calibration, rig_difference
from lsvision.io.formats.validation import named_file, read_entries, read_yaml
from lsvision.schema import Checked, Says, Text
from lsvision.types import Calibration, RefusedVerdict, Scan

LIST_FILE = "calibrations.yaml"


def _as_day(value: object) -> object:
    return date.fromisoformat(value) if isinstance(value, str) else value


Day = Annotated[date, BeforeValidator(_as_day), Says("a day as 2024-05-31")]


@dataclass(frozen=True)
class ListedCalibration(Checked):
    """A row of ``calibrations.yaml``."""

    file: Text
    first: Day | None = field(default=None, metadata={"key": "from"})
    last: Day | None = field(default=None, metadata={"key": "to"})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.first is not None and self.last is not None and self.last < self.first:
            raise self.fault("to", f"expected a day from {self.first} on, got {self.last}")


@dataclass(frozen=True)
class DatedCalibration:
    """A calibration, the hash of its file, and its first and last day; None where it has none.

    ``accepted`` says whether it may correct scans: its n is usable, or the caller accepts its verdict.
    """

    path: Path
    calibration: Calibration
    sha256: str
    first: date | None = None
    last: date | None = None
    accepted: bool = True

    def holds_on(self, day: date) -> bool:
        """Whether a day lies within its days."""
        return (self.first is None or self.first <= day) and (self.last is None or day <= self.last)

    def check_accepted(self) -> None:
        """Raise UnusableCalibrationError where it may not correct scans."""
        if not self.accepted:
            raise UnusableCalibrationError(str(self.path), self.calibration.verdict, self.calibration.reasons)

    @property
    def warning(self) -> str | None:
        """The sentence on what to beware of in its products; None where n is determined."""
        verdict, why = self.calibration.verdict, "; ".join(self.calibration.reasons)
        return None if verdict == "determined" else f"{self.path}: the calibration is {verdict}: {why}"


def read_calibrations(path: Path | str, accept: Sequence[RefusedVerdict] = ()) -> list[DatedCalibration]:
    """Read one calibration, or a folder of them.

    A folder holds ``calibrations.yaml``, a list of ``{file: NAME, from: DAY, to: DAY}`` with either day optional, or
    simply one calibration a rig as ``*.json``.

    Args:
        accept: verdicts without a usable n whose calibrations are used all the same.

    Raises:
        FileFormatError: a file is missing or damaged, or a folder holds none.
        UnusableCalibrationError: the one calibration has no usable n. One of a folder is refused by
            ``calibration_for``, to the scans that need it.
    """
    found = [replace(item, accepted=_is_accepted(item.calibration, accept)) for item in _read_all(Path(path))]
    if len(found) == 1:
        found[0].check_accepted()
    return found


def _is_accepted(calibration: Calibration, accept: Sequence[RefusedVerdict]) -> bool:
    return calibration.usable or calibration.verdict.replace(" ", "_") in accept


def _read_all(path: Path) -> list[DatedCalibration]:
    if not path.is_dir():
        return [_read(path)]
    if (path / LIST_FILE).is_file():
        listed = read_yaml(path / LIST_FILE)
        if not isinstance(listed, list) or not listed:
            raise FileFormatError(path / LIST_FILE, "expected a list of calibrations")
        return [_read_listed(path / LIST_FILE, index, item) for index, item in enumerate(listed)]
    files = sorted(path.glob("*.json"))
    if not files:
        raise FileFormatError(path, f"expected {LIST_FILE} or calibrations as *.json")
    return [_read(file) for file in files]


def calibration_for(scan: Scan, calibrations: Sequence[DatedCalibration]) -> DatedCalibration:
    """The one calibration for a scan: made with its rig, and holding on its day where there are several.

    The day is the scan's attribute ``date``, as 2024-05-31 or with a time behind it.

    Raises:
        CalibrationError: none fits, more than one does, or the one that fits has no usable n and was not accepted.
    """
    chosen = _fitting(scan, calibrations)
    chosen.check_accepted()
    return chosen


def _fitting(scan: Scan, calibrations: Sequence[DatedCalibration]) -> DatedCalibration:
    if len(calibrations) == 1 and calibrations[0].first is None and calibrations[0].last is None:
        check_rig_match(calibrations[0].calibration, scan)
        return calibrations[0]
    same_rig = [item for item in calibrations if rig_difference(item.calibration, scan) is None]
    if not same_rig:
        raise CalibrationError(f"{scan.path}: no calibration for its rig among {len(calibrations)}")
    if len(same_rig) == 1 and same_rig[0].first is None and same_rig[0].last is None:
        return same_rig[0]
    day = _day_of(scan)
    fitting = [item for item in same_rig if item.holds_on(day)]
    if len(fitting) != 1:
        names = ", ".join(item.path.name for item in fitting)
        raise CalibrationError(
            f"{scan.path}: {f'several calibrations hold on {day}: {names}' if fitting else f'no calibration for {day}'}"
        )
    return fitting[0]


def _day_of(scan: Scan) -> date:
    text = scan.attributes.get("date")
    if text is None:
        raise CalibrationError(f"{scan.path}: no calibration: its attributes give no date to choose one by")
    try:
        return date.fromisoformat(text[:10])
    except ValueError:
        raise CalibrationError(f"{scan.path}: no calibration: expected a date as 2024-05-31, got {text!r}") from None


def _read(path: Path, first: date | None = None, last: date | None = None) -> DatedCalibration:
    calibration = read_calibration(path)
    return DatedCalibration(path, calibration, hashlib.sha256(path.read_bytes()).hexdigest(), first, last)


def _read_listed(path: Path, index: int, item: object) -> DatedCalibration:
    listed = read_entries(ListedCalibration, item, path, f"[{index}]")
    return _read(named_file(path, f"[{index}].file", listed.file), listed.first, listed.last)
