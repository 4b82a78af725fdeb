"""Running a program beside QGIS: its lines as they come, stopped at once, and nothing of it left.

QGIS's own `QgsBlockingProcess` delivers no progress and cannot be cancelled on the main thread, hence a reader thread
per stream and a short wait on their queue.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import subprocess
import threading
import time
from collections import deque
from contextlib import suppress

from .errors import EngineCancelled, EngineError

TERM_S = 3.0
"""A program that was asked to stop gets so long before it is killed."""
POLL_S = 0.05
SILENCE_S = 300.0
"""After so long without a word the user is told that cancelling is possible."""

_LOST = (
    "PYTHONHOME",
    "PYTHONPATH",
    "PYTHONEXECUTABLE",
    "PYTHONSTARTUP",
    "PROJ_LIB",
    "PROJ_DATA",
    "GDAL_DATA",
    "GDAL_DRIVER_PATH",
    "LD_LIBRARY_PATH",
    "LD_PRELOAD",
    "QT_PLUGIN_PATH",
)
"""What QGIS sets for its own Python and libraries, and would break those of another."""
_ADDED = {"PYTHONUNBUFFERED": "1", "PYTHONIOENCODING": "utf-8", "PYTHONNOUSERSITE": "1", "PYTHONSAFEPATH": "1"}

_DEATHS = {
    "SIGKILL": ("was killed, most likely because the memory ran out", "Use smaller surveys or close other programs."),
    "SIGSEGV": ("crashed (segmentation fault)", "Please report it, with the console lines above."),
}


def clean_environment(environment=None):
    """The environment of the engine: that of QGIS without what is meant for QGIS's own Python."""
    given = os.environ if environment is None else environment
    return {**{key: value for key, value in given.items() if key not in _LOST}, **_ADDED}


def run(command, heard, is_cancelled=lambda: False, silence_s=SILENCE_S):
    """Run a program to its end; its exit code and the last lines of its stderr.

    Parameters
    ----------
    command : list of str
        Program and arguments; no shell is involved.
    heard : callable
        ``heard(stream, line)`` for every line, ``stream`` being ``out``, ``err`` or ``note`` (a word of our own).
    is_cancelled : callable
        Asked all the time; True ends the program and raises `EngineCancelled`.
    silence_s : float
        Seconds without a line after which a note is made of it.
    """
    process = _start(command)
    lines = queue.Queue()
    readers = [
        threading.Thread(target=_read, args=(name, stream, lines), daemon=True)
        for name, stream in (("out", process.stdout), ("err", process.stderr))
    ]
    for reader in readers:
        reader.start()
    tail, spoke, open_streams = deque(maxlen=20), time.monotonic(), 2
    try:
        while open_streams:
            if is_cancelled():
                raise EngineCancelled("Stopped.")
            try:
                stream, line = lines.get(timeout=POLL_S)
            except queue.Empty:
                if process.poll() is not None and not any(reader.is_alive() for reader in readers):
                    break
                if process.poll() is not None and time.monotonic() - spoke > TERM_S:
                    break  # a child of its own holds the streams open
                if time.monotonic() - spoke > silence_s and process.poll() is None:
                    spoke = time.monotonic()
                    heard("note", f"Nothing was heard of it for {silence_s:.0f} s; it may still be at work, or hang.")
                continue
            spoke = time.monotonic()
            if line is None:
                open_streams -= 1
                continue
            if stream == "err":
                tail.append(line)
            heard(stream, line)
        while process.poll() is None:
            if is_cancelled():
                raise EngineCancelled("Stopped.")
            time.sleep(POLL_S)
        return process.returncode, list(tail)
    finally:
        _stop(process)


def run_engine(command, listener, is_cancelled=lambda: False):
    """Run a command of the engine with ``--progress json``; its event ``result``.

    Parameters
    ----------
    command : list of str
        As for `run`.
    listener : object
        ``progress(percent, stage)``, ``info(text)``, ``warning(text)`` and ``console(text)`` are called on it.
    """
    ends = {}

    def heard(stream, line):
        event = _event(line) if stream == "out" else None
        kind = event.get("event") if event else None
        if kind == "progress":
            listener.progress(100.0 * event["done"] / max(event["total"], 1), str(event["stage"]))
        elif kind in ("info", "warning"):
            getattr(listener, kind)(str(event["message"]))
        elif kind in ("error", "result"):
            ends[kind] = event
        elif stream == "note":
            listener.warning(line)
        else:
            listener.console(line)

    code, said = run(command, heard, is_cancelled)
    if "error" in ends:
        raise EngineError(str(ends["error"]["message"]), str(ends["error"].get("remedy", "")))
    if code != 0 or "result" not in ends:
        raise death(code, said)
    return ends["result"]


def answer(command, timeout_s=30.0):
    """What a program writes to stdout when it is asked something short."""
    deadline, out = time.monotonic() + timeout_s, []

    def heard(stream, line):
        if stream == "out":
            out.append(line)

    try:
        code, said = run(command, heard, lambda: time.monotonic() > deadline)
    except EngineCancelled:
        raise EngineError(
            f"{command[0]} did not answer within {timeout_s:.0f} s.", "Choose or install the engine again."
        ) from None
    if code != 0:
        raise death(code, said)
    return "\n".join(out)


def death(code, said):
    """The error of a program that ended with ``code`` and these last words."""
    if code < 0:
        try:
            name = signal.Signals(-code).name
        except ValueError:
            name = f"signal {-code}"
        how, remedy = _DEATHS.get(name, (f"was ended by {name}", "Run it again."))
        return EngineError(f"The engine {how}.", remedy)
    words = next((line for line in reversed(said) if line.strip()), "it said nothing")
    what = "ended without a result" if code == 0 else f"failed (exit code {code})"
    return EngineError(f"The engine {what}: {words.removeprefix('loda-pdal: ') if code else words}", "")


def _start(command):
    own_group = {"start_new_session": True}
    if os.name == "nt":
        own_group = {"creationflags": subprocess.CREATE_NEW_PROCESS_GROUP | subprocess.CREATE_NO_WINDOW}
    try:
        return subprocess.Popen(
            command,
            stdin=subprocess.PIPE,  # stays open: when QGIS dies, the engine sees it close and stops
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env=clean_environment(),
            **own_group,
        )
    except OSError as error:
        raise EngineError(
            f"{command[0]} cannot be started ({error.strerror or error}).",
            "Choose another engine in Settings, Options, LoDA Change.",
        ) from error


def _read(name, stream, lines):
    try:
        for line in stream:
            lines.put((name, line.rstrip("\r\n")))
    except ValueError:  # closed while it was read: the run is over
        pass
    lines.put((name, None))


def _event(line):
    try:
        event = json.loads(line)
    except ValueError:
        return None
    return event if isinstance(event, dict) and "event" in event else None


def _stop(process):
    """End the program and all that it started."""
    if process.poll() is None:
        _signal(process, "SIGTERM")
        with suppress(subprocess.TimeoutExpired):
            process.wait(TERM_S)
    _signal(process, "SIGKILL")
    with suppress(subprocess.TimeoutExpired):  # stuck in the kernel, it dies as soon as it comes back
        process.wait(TERM_S)
    for stream in (process.stdin, process.stdout, process.stderr):
        with suppress(OSError):
            stream.close()


def _signal(process, name):
    try:
        if os.name == "nt":
            process.kill()
        else:
            os.killpg(process.pid, getattr(signal, name))
    except OSError:
        pass  # there is nobody left
