"""Stopping at once: Ctrl-C, SIGTERM, or a front end that died; nothing half-written stays behind.

Kernels run without the interpreter lock and the main thread may be inside one for long. So the C-level signal handler
wakes a thread of its own, which cleans up and ends the process.
"""

from __future__ import annotations

import os
import signal
import socket
import stat
import sys
import threading
from collections.abc import Callable

MESSAGE = b"loda-pdal: stopped.\n"
SHOW_CURSOR = b"\x1b[?25h\r"
GRACE_S = 0.3

_cleanups: list[Callable[[], object]] = []
_is_stopping = threading.Lock()


def before_stopping(cleanup: Callable[[], object]) -> None:
    """Have ``cleanup`` called, from another thread, if the process is stopped from outside."""
    _cleanups.append(cleanup)


def on_signals() -> None:
    """Stop on SIGINT, SIGTERM and SIGHUP with exit code 128 + signal; those that are ignored stay so."""
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, lambda number, frame: None)
    threading.Thread(target=_wait_for_signal, args=(ours, theirs), name="signals", daemon=True).start()


def when_parent_dies() -> None:
    """Stop when stdin, if it is a pipe, is closed: a front end holds it open as long as it lives.

    A terminal, a file or /dev/null says nothing about a parent and is left alone.
    """
    try:
        mode = os.fstat(0).st_mode
    except OSError:
        return
    if stat.S_ISFIFO(mode) or stat.S_ISSOCK(mode):
        threading.Thread(target=_wait_for_end_of_stdin, name="parent", daemon=True).start()


def settle() -> None:
    """Returns at once, except while the process is being stopped: then never, so that no other ending comes first.

    What a stop clears away makes a run fail; that is no error to report.
    """
    with _is_stopping:
        pass


def _wait_for_signal(ours: socket.socket, theirs: socket.socket) -> None:
    number = ours.recv(1)
    _stop(128 + number[0] if number else 1)


def _wait_for_end_of_stdin() -> None:
    try:
        while os.read(0, 4096):
            pass
    except OSError:
        pass
    _stop(1)


def _stop(code: int) -> None:
    """Clean up and end the process, whatever its other threads are doing."""
    _is_stopping.acquire()
    for cleanup in _cleanups:
        try:
            cleanup()
        except Exception as error:  # the process ends here: what fails must not keep the others from cleaning
            _say(f"loda-pdal: {error}\n".encode())
    _say(MESSAGE)
    os._exit(code)


def _say(message: bytes) -> None:
    """Write to stderr, but wait for nobody who does not read."""
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    writer = threading.Thread(target=os.write, args=(2, SHOW_CURSOR + message if is_terminal else message), daemon=True)
    writer.start()
    writer.join(GRACE_S)
