"""Signals: raised where they may be, kept back where not, never swallowed; one line and the shells' exit code."""

import signal
import subprocess
import sys
import textwrap

import pytest

from lsvision.interruption import hidden_from_children

pytestmark = pytest.mark.skipif(not hasattr(signal, "pthread_kill"), reason="signals as POSIX has them")


def run_program(body: str, ignored: bool = False) -> subprocess.CompletedProcess:
    """Run a program that does something within ``interruptible``."""
    text = "import os, signal, sys, threading, time\nfrom lsvision.interruption import *\n"
    if ignored:
        text += "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
    text += "with interruptible():\n" + textwrap.indent(textwrap.dedent(body), "    ")
    return subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False, timeout=60)


@pytest.mark.parametrize(("name", "code", "word"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
def test_one_line_and_an_exit_code(name, code, word):
    done = run_program(f"os.kill(os.getpid(), signal.{name}); time.sleep(60)")
    assert done.returncode == code
    assert done.stderr == f"{word}: no file is half-written; run the same command again to go on\n"


def test_what_an_exception_says_is_in_the_line():
    body = """
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("3 of 4 are done") from None
    """
    assert run_program(body).stderr == "interrupted: 3 of 4 are done; run the same command again to go on\n"


@pytest.mark.parametrize("place", ["def __del__(self):", "def called(self, _):"])
def test_where_python_swallows_it_it_comes_again(place):
    """In a finaliser, or in the callback of a weak reference."""
    body = f"""
    import weakref
    class Held:
        {place}
            os.kill(os.getpid(), signal.SIGINT)
            for _ in range(1000):
                pass
    held = Held()
    if hasattr(held, "called"):
        other = type("Other", (), {{}})()
        reference = weakref.ref(other, held.called)
        del other
    else:
        del held
    time.sleep(60)
    """
    done = run_program(body)
    assert done.returncode == 130
    assert done.stderr.startswith("interrupted: ")
    assert len(done.stderr.splitlines()) == 1


def test_nothing_follows_the_line():
    """Neither what was left half-way nor errors that follow from the end are reported."""
    body = """
    async def left(): pass
    kept = left()
    threading.Thread(target=lambda: (time.sleep(0.2), 1 / 0)).start()
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)
    finally:
        raise OSError("closed already")
    """
    done = run_program(body)
    assert done.returncode == 130
    assert len(done.stderr.splitlines()) == 1


def test_a_signal_that_was_turned_off_stays_so():
    done = run_program("os.kill(os.getpid(), signal.SIGINT); print('went on')", ignored=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "went on\n", "")


def test_a_program_that_is_done_is_not_interrupted():
    text = "import os, signal\nfrom lsvision.interruption import interruptible\nwith interruptible():\n    pass\n"
    done = subprocess.run(
        [sys.executable, "-c", text + "os.kill(os.getpid(), signal.SIGINT)"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")


def test_blocks_that_must_not_be_interrupted():
    body = """
    with uninterrupted():
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGINT)
            print("inner")
        print("outer")
    print("after")
    """
    done = run_program(body)
    assert (done.returncode, done.stdout) == (130, "inner\nouter\n")
    assert done.stderr.startswith("interrupted: ")


def test_what_an_ended_process_leaves_is_removed_without_a_word():
    text = """
    import os
    from multiprocessing import resource_tracker
    from lsvision.interruption import start_resource_tracker
    start_resource_tracker()
    resource_tracker.register("/lsvision-left", "semaphore")  # as by a process that was killed
    os._exit(0)
    """
    text = textwrap.dedent(text)
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_children_do_not_see_ctrl_c():
    with hidden_from_children():
        child = subprocess.Popen(
            [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGINT); print('unharmed')"],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
    assert child.communicate(timeout=60)[0] == "unharmed\n"
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)  # visible here as before
