"""Errors whose cause is the data or the files, not the caller's code."""

from pathlib import Path


class LsvisionError(Exception):
    """Base of the errors that a command reports in one line before it exits with their code."""

    exit_code = 1


class FileFormatError(LsvisionError):
    """A file that cannot be read as what it claims to be.

    Args:
        path: the file at fault.
        problem: what was expected and what came, in words.
        key: the entry within the file, where there is one ("principal_point_px.left").
    """

    def __init__(self, path: Path | str, problem: str, key: str | None = None) -> None:
        where = f"{path}: {key}" if key else f"{path}"
        super().__init__(f"{where}: {problem}")
        self.path, self.key, self.problem = Path(path), key, problem

    def __reduce__(self) -> tuple[type, tuple[Path, str, str | None]]:
        return type(self), (self.path, self.problem, self.key)


class WriteError(LsvisionError):
    """A file that cannot be written, as on a full disk; names the file."""


class BoardNotFoundError(LsvisionError):
    """A scan in which the calibration board was looked for and not found."""


class CalibrationError(LsvisionError):
    """A calibration that cannot be computed or does not fit the scan it is applied to."""


class ConfigError(LsvisionError):
    """An option whose value makes no sense; names the option."""


class ScansFailedError(LsvisionError):
    """A run over many scans of which some failed; the exit code is their number, up to 100."""

    def __init__(self, failed: int, scans: int, where: str) -> None:
        super().__init__(f"{failed} of {scans} scans failed; {where} says why")
        self.exit_code = min(failed, 100)
