"""Errors whose cause is the data, a file or an option, not the caller's code."""

from collections.abc import Sequence
from pathlib import Path


class LsvisionError(Exception):
    """Base of the errors that a command reports in one line; ``exit_code`` is the command's."""

    exit_code = 1


class FileFormatError(LsvisionError):
    """A file that is missing or not of the expected format.

    Args:
        path: the file at fault.
        problem: what was expected and what was found, in words.
        key: the entry within the file, if it has entries ("principal_point_px.left").
    """

    def __init__(self, path: Path | str, problem: str, key: str | None = None) -> None:
        where = f"{path}: {key}" if key else f"{path}"
        super().__init__(f"{where}: {problem}")
        self.path, self.key, self.problem = Path(path), key, problem

    def __reduce__(self) -> tuple[type, tuple[Path, str, str | None]]:
        return type(self), (self.path, self.problem, self.key)


class ScanChangedError(LsvisionError):
    """A scan whose files are not those any more that a run planned to read."""

    def __init__(self, path: Path | str) -> None:
        super().__init__(f"{path}: changed while it was being read; the next run starts it afresh")
        self.path = Path(path)

    def __reduce__(self) -> tuple[type, tuple[Path]]:
        return type(self), (self.path,)


class WriteError(LsvisionError):
    """A file that cannot be written, as on a full disk; the message names it."""


class BoardNotFoundError(LsvisionError):
    """A scan that does not show the calibration board."""


class CalibrationError(LsvisionError):
    """A calibration that cannot be computed, or does not fit the scan that it should correct."""


class UnusableCalibrationError(CalibrationError):
    """A calibration without a usable n, by its file, its verdict and the reasons for it."""

    def __init__(self, path: str, verdict: str, reasons: Sequence[str]) -> None:
        super().__init__(f"{path}: the calibration is {verdict}: {'; '.join(reasons) or 'it gives no reason'}")
        self.path, self.verdict, self.reasons = path, verdict, tuple(reasons)

    def __reduce__(self) -> tuple[type, tuple[str, str, tuple[str, ...]]]:
        return type(self), (self.path, self.verdict, self.reasons)


class ResponseError(LsvisionError):
    """References or an archive from which the response of the cameras cannot be measured; says which and why."""


class NothingMeasuredError(LsvisionError):
    """A product of which next to nothing was measured: its scan, calibration or options do not fit each other."""


class ConfigError(LsvisionError):
    """An option with an impossible value; the message names the option."""


class ScansFailedError(LsvisionError):
    """A run over many scans, some of which failed; the exit code is their number, up to 100."""

    def __init__(self, failed: int, scans: int, where: str) -> None:
        super().__init__(f"{failed} of {scans} scans failed; {where} gives the reasons")
        self.exit_code = min(failed, 100)
