"""What the command line says and what it answers: texts in any language in, one line of error out."""

import re
import sys
from collections.abc import Sequence

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from lsvision.errors import ConfigError, LsvisionError

# Expected failures: what is wrong with data, files, the disk or the command; anything else is a fault of the program.
EXPECTED = (LsvisionError, HydraException, OmegaConfBaseException, OSError)

_VALUE = re.compile(r"(?P<key>[~+]*[\w./@]+=)(?P<value>[^'\"({]*[^\x00-\x7f][^'\"({]*)")


def in_one_line(error: BaseException) -> str:
    """An expected failure in words, of printable signs alone."""
    return "".join(sign if sign.isprintable() else repr(sign)[1:-1] for sign in _in_words(error))


def _in_words(error: BaseException) -> str:
    if isinstance(error, MissingConfigException):
        group, _, name = (error.missing_cfg_file or "").rpartition("/")
        return f"{group or 'config'}: there is no {name!r}; choose one of {', '.join(error.options or ())}"
    if isinstance(error, OverrideParseException):
        return f"{error.override}: cannot be understood; put quotes around a value with special signs: \"key='value'\""
    if isinstance(error, OSError):
        return f"{error.filename}: {error.strerror}" if error.filename and error.strerror else _joined(str(error))
    if isinstance(error, HydraException) and error.__cause__ is not None:
        return f"{_first_line(error)} {_first_line(error.__cause__)}"
    return _joined(str(error)) if isinstance(error, LsvisionError) else _first_line(error)


def quoted(arguments: Sequence[str]) -> list[str]:
    """Arguments as Hydra can read them: its grammar knows letters beyond ASCII within quotes only.

    Raises:
        ConfigError: an argument that is no text in the console's encoding.
    """
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:
            shown = argument.encode("utf-8", "backslashreplace").decode()
            raise ConfigError(f"{shown}: not UTF-8") from None
    return [_quoted(argument) for argument in arguments]


def print_any_letter() -> None:
    """Letters that the console does not have are printed as their numbers, instead of ending the program."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")


def _quoted(argument: str) -> str:
    match = _VALUE.fullmatch(argument)
    if match is None:
        return argument
    pieces = re.split(r"(\s*[,\[\]]\s*)", match["value"])
    return match["key"] + "".join(piece if piece.isascii() else f"'{piece}'" for piece in pieces)


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0].strip()


def _joined(text: str) -> str:
    return " ".join(text.split("\n"))
