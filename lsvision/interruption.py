"""Ctrl-C and SIGTERM: a run ends where nothing is lost by it, says so in one line, and prints nothing after that."""

import logging
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

if TYPE_CHECKING:
    from sys import UnraisableHookArgs

_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
# Launchers pass on a Ctrl-C that the terminal has sent to all already: what comes so soon after is the same one.
_ONE_PRESS_SECONDS = 1.0
_AGAIN_SECONDS = 0.02
# Of what was left half-way they report that it never ended.
_LOGGERS = ("asyncio", "concurrent.futures", "distributed", "tornado")


class _State:
    """What has arrived in this process; ``held`` counts the blocks that must not be interrupted."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Start afresh."""
        self.received: signal.Signals | None = None
        self.last = -_ONE_PRESS_SECONDS
        self.held = 0
        self.waiting = False


_state = _State()


def was_interrupted() -> bool:
    """Whether this run is being ended: errors are its consequence then."""
    return _state.received is not None


@contextmanager
def interruptible() -> Iterator[None]:
    """Turn a signal within the block into ``KeyboardInterrupt``, and that into one line and the shells' exit code.

    The line is the exception's text, or that no file is half-written. A signal that the parent has turned off (as
    ``nohup`` and ``&`` do) stays so. After the block, which is all that the program does, signals are ignored: nothing
    is left to be interrupted, and the interpreter would print a trace.

    Raises:
        SystemExit: 130 after Ctrl-C, 143 after SIGTERM.
    """
    hooks = sys.unraisablehook, threading.excepthook
    _state.forget()
    try:
        sys.unraisablehook, threading.excepthook = _swallowed, _in_thread
        _handle(_interrupt)
        yield
    except BaseException as error:
        if not isinstance(error, KeyboardInterrupt) and not was_interrupted():
            raise
        _end(str(error) if isinstance(error, KeyboardInterrupt) else "")
    finally:
        if not was_interrupted():
            sys.unraisablehook, threading.excepthook = hooks
            _handle(signal.SIG_IGN)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let what arrives within the block interrupt at its end: for steps that must not be left half-way."""
    if not _in_main_thread():  # which alone is interrupted
        yield
        return
    _state.held += 1
    try:
        yield
    finally:
        _state.held -= 1
        if _state.waiting and not _state.held:
            _state.waiting = False
            raise KeyboardInterrupt


@contextmanager
def hidden_from_children() -> Iterator[None]:
    """Keep Ctrl-C from the processes that are started within the block: a terminal sends it to all of them.

    They are ended by this process; interrupted while they import, they would print a trace.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_resource_tracker() -> None:
    """Start the process in which multiprocessing removes what ended processes have left behind, semaphores above all.

    At its start it would make Ctrl-C visible again within ``hidden_from_children``: it is started before that. It does
    not report what it removes: a run that was ended leaves such things, and its line is the last one.
    """
    from multiprocessing import resource_tracker  # here, so that the handler is there before anything heavy

    quiet = "ignore::UserWarning:multiprocessing.resource_tracker"
    sys.warnoptions.append(quiet)  # which children get
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(quiet)


def _in_main_thread() -> bool:
    return threading.current_thread() is threading.main_thread()


def _handle(handler: Callable[[int, FrameType | None], None] | signal.Handlers) -> None:
    for number in _WORDS:
        if signal.getsignal(number) is not signal.SIG_IGN and _in_main_thread():
            signal.signal(number, handler)


def _interrupt(number: int, _: FrameType | None) -> None:
    """The handler of signals."""
    now = time.monotonic()
    same = now - _state.last < _ONE_PRESS_SECONDS
    _state.last = now
    if same:
        return
    _state.received = _state.received or signal.Signals(number)
    warnings.simplefilter("ignore")
    for name in _LOGGERS:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    if _state.held:
        _state.waiting = True
        return
    raise KeyboardInterrupt


def _swallowed(raised: "UnraisableHookArgs") -> None:
    """Where an exception cannot be raised, as in ``__del__`` and callbacks of weak references, interrupt once more."""
    if issubclass(raised.exc_type, KeyboardInterrupt):
        _state.last = -_ONE_PRESS_SECONDS
        again = threading.Timer(_AGAIN_SECONDS, _deliver_again)
        again.daemon = True
        again.start()
    elif not was_interrupted():
        sys.__unraisablehook__(raised)


def _deliver_again() -> None:
    number = _state.received or signal.SIGINT
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, number)  # wakes it where it waits
    else:
        signal.raise_signal(number)


def _in_thread(failed: threading.ExceptHookArgs) -> None:
    """What other threads meet while the run ends is a consequence of that."""
    if not was_interrupted():
        threading.__excepthook__(failed)


def _end(done: str) -> NoReturn:
    received = _state.received or signal.SIGINT
    code = 128 + received
    _handle(lambda *_: os._exit(code))  # threads that the interpreter waits for may take long
    warnings.simplefilter("ignore")
    line = f"{_WORDS[received]}: {done or 'no file is half-written'}; run the same command again to go on"
    print(line, file=sys.stderr, flush=True)
    raise SystemExit(code) from None
