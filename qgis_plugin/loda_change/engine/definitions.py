"""What parameters the engine has: asked of the engine, kept in the profile, and shipped for when there is none yet."""

from __future__ import annotations

import json
import os
from pathlib import Path

from .errors import EngineError
from .locate import engine_version
from .process import answer

SHIPPED = Path(__file__).resolve().parent.parent / "parameters.json"


def ask(engine, timeout_s=30.0):
    """The definitions as the engine gives them."""
    text = answer([*engine.command, "params", "--json"], timeout_s)
    try:
        found = json.loads(text)
    except ValueError as error:
        raise EngineError(f"{engine.command[0]} does not say its parameters ({error}).") from error
    if not {"version", "presets", "stages"} <= set(found):
        raise EngineError(f"{engine.command[0]} does not say its parameters.", "Install a newer engine.")
    return found


def shipped():
    """The definitions that came with the plugin."""
    return json.loads(SHIPPED.read_text(encoding="utf-8"))


def current(engine, cache_folder, timeout_s=10.0):
    """The definitions of the engine in use; asks it only when it is another one than last time.

    Never fails: without an engine, or with one that does not answer, those that were shipped must do.
    """
    known = shipped()
    if engine is None:
        return known
    cache = Path(cache_folder) / "parameters.json"
    identity = [*engine.command, _changed_at(engine.command[0])]
    try:
        kept = json.loads(cache.read_text(encoding="utf-8"))
        if kept["identity"] == identity:
            return kept["definitions"]
    except (OSError, ValueError, KeyError, TypeError):
        pass
    try:
        version = engine_version(engine, timeout_s)
        definitions = known if version == known["version"] else ask(engine, timeout_s)
        _keep(cache, {"identity": identity, "definitions": definitions})
    except (EngineError, OSError):
        return known
    return definitions


def _keep(cache, content):
    cache.parent.mkdir(parents=True, exist_ok=True)
    part = cache.with_suffix(f".{os.getpid()}.part")
    part.write_text(json.dumps(content), encoding="utf-8")
    part.replace(cache)


def _changed_at(program):
    try:
        return Path(program).stat().st_mtime_ns
    except OSError:
        return None
