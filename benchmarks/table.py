"""``python -m benchmarks.table RESULT.json``: medians and ratios of a pytest-benchmark run, as Markdown tables."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

OURS = "loda-pdal"
HEADER = ["work", "points", "library", "median (s)", "CPU (s)", "times ours"]


def tables(result: dict[str, Any]) -> str:
    """All measurements by group, then the stages of the whole method, then the machine."""
    machine = result["machine_info"]
    cpu = f"{machine['cpu'].get('brand_raw', machine['processor'])}, {machine['cpu']['count']} processors"
    said = f"{cpu}; Python {machine['python_version']}; {result['datetime'][:10]}."
    return "\n\n".join([measurements(result), *stages(result), said])


def measurements(result: dict[str, Any]) -> str:
    """Rows by group, ours first; ``times ours`` is the ratio of the medians."""
    rows = []
    groups: dict[str, list[dict[str, Any]]] = {}
    for one in result["benchmarks"]:
        groups.setdefault(one["group"], []).append(one)
    for group, members in groups.items():
        members.sort(key=lambda one: (one["extra_info"]["library"] != OURS, one["stats"]["median"]))
        ours = [one["stats"]["median"] for one in members if one["extra_info"]["library"] == OURS]
        for i, one in enumerate(members):
            info, median = one["extra_info"], one["stats"]["median"]
            rows.append(
                [
                    "" if i else group,
                    "" if i else f"{info['points'] / 1e6:.2f} M",
                    info["library"],
                    f"{median:.2f}",
                    f"{info['cpu_s']:.2f}",
                    f"{median / ours[0]:.1f}" if ours and i else "",
                ]
            )
    return markdown(HEADER, rows)


def stages(result: dict[str, Any]) -> list[str]:
    """Seconds of each stage of the whole method, a column for each way to run it; no table where it was not run."""
    runs = {one["extra_info"]["library"]: one["extra_info"].get("stages") for one in result["benchmarks"]}
    known = {library: seconds for library, seconds in runs.items() if seconds}
    names = dict.fromkeys(name for seconds in known.values() for name in seconds)
    return [
        markdown(["stage (s)", *known], [[name, *(f"{s[name]:.2f}" for s in known.values())] for name in names])
    ] * bool(known)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


if __name__ == "__main__":
    print(tables(json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))))
