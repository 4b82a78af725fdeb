"""Processing parameters made from what the engine says of its own, so that they never drift apart."""

from __future__ import annotations

import html

from qgis.core import (
    QgsProcessingParameterDefinition,
    QgsProcessingParameterEnum,
    QgsProcessingParameterNumber,
    QgsProcessingParameterString,
)

YES_NO = ("yes", "no")


def generated(definitions, stages=None):
    """``{name: (definition, entry)}`` of the engine's parameters, all advanced and optional.

    What is left empty stays as the preset says. ``stages`` picks some of the stages; None takes all.
    """
    found = {}
    for stage in definitions["stages"]:
        if stages is None or stage["name"] in stages:
            for entry in stage["parameters"]:
                name = f"{stage['name']}_{entry['name']}".upper()
                entry = {**entry, "key": f"{stage['name']}.{entry['name']}", "stage": stage["name"]}
                definition = _definition(name, entry)
                definition.setFlags(definition.flags() | QgsProcessingParameterDefinition.Flag.FlagAdvanced)
                definition.setHelp(_help(stage, entry, definitions["presets"]))
                found[name] = definition, entry
    return found


def settings(entries, parameters):
    """``stage.key=value`` of those generated parameters that the user filled in, as ``--set`` takes them."""
    chosen = []
    for name, (_, entry) in entries.items():
        text = _text(entry, parameters.get(name))
        if text:
            chosen.append(f"{entry['key']}={text}")
    return chosen


def _definition(name, entry):
    unit = f" [{entry['unit']}]" if entry["unit"] else ""
    title = f"{entry['stage'].replace('_', ' ').capitalize()}: {entry['doc'].split(';')[0]}{unit}"
    value = entry["default"]
    if isinstance(value, bool) or entry["choices"]:
        options = list(entry["choices"] or YES_NO)
        return QgsProcessingParameterEnum(name, title, options, optional=True, usesStaticStrings=True)
    if isinstance(value, list):
        return QgsProcessingParameterString(name, f"{title} (comma-separated)", optional=True)
    kind = QgsProcessingParameterNumber.Type
    number = QgsProcessingParameterNumber(
        name, title, kind.Integer if isinstance(value, int) else kind.Double, optional=True
    )
    if entry["low"] is not None:
        number.setMinimum(entry["low"])
    if entry["high"] is not None:
        number.setMaximum(entry["high"])
    return number


def _help(stage, entry, presets):
    doc = html.escape(entry["doc"])
    symbol = f" ({html.escape(entry['symbol'])} in the paper)" if entry["symbol"] else ""
    limits = f" From {entry['low']:g} to {entry['high']:g}." if entry["low"] is not None else ""
    values = {name: preset[stage["name"]][entry["name"]] for name, preset in presets.items()}
    told = ", ".join(f"{name} {_shown(value)}" for name, value in values.items())
    unit = f" {html.escape(entry['unit'])}" if entry["unit"] else ""
    return f"{doc[:1].upper()}{doc[1:]}{symbol}.{limits} Left empty: {html.escape(told)}{unit}."


def _shown(value):
    if isinstance(value, bool):
        return YES_NO[0] if value else YES_NO[1]
    return "/".join(map(str, value)) if isinstance(value, list) else str(value)


def _text(entry, value):
    """One value as the engine reads it; empty where it was left to the preset."""
    if value is None or value == "":
        return ""
    if isinstance(entry["default"], bool):
        named = str(value).lower()
        return "true" if named in ("yes", "true", "1") else "false"
    if entry["choices"]:
        return str(value)
    if isinstance(entry["default"], list):
        numbers = [part.strip() for part in str(value).strip("[]() ").replace(";", ",").split(",")]
        return f"[{', '.join(numbers)}]"
    return str(int(value)) if isinstance(entry["default"], int) else repr(float(value))
