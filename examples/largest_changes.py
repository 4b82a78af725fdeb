"""The largest changes between two surveys, in a few lines: python examples/largest_changes.py BEFORE AFTER [EPSG]."""

from __future__ import annotations

import sys

import numpy as np

from loda_pdal import detect_changes, read_epochs


def main(before: str, after: str, epsg: str | None = None) -> None:
    """Print the ten changes with the largest outline, with their reasons."""
    surveys = read_epochs(before, after, epsg=int(epsg) if epsg else None)
    result = detect_changes(surveys.before, surveys.after)
    for warning in result.warnings:
        print("warning:", warning)
    for change in sorted(result.changes, key=lambda change: -change.footprint.area)[:10]:
        centre = np.array([[change.footprint.centroid.x, change.footprint.centroid.y, 0.0]])
        x, y, _ = surveys.after.frame.to_map(centre)[0]
        print(f"{change.label.title} {change.object_class.title} at {x:.0f} {y:.0f}: {change.reason}")


if __name__ == "__main__":
    main(*sys.argv[1:])
