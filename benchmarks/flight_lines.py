"""Two surveys of one hour: the flight lines of a real airborne tile, some as the before and some as the after survey.

Nothing that is built or grows changed between them; vehicles and people may have moved. Each line meets other walls,
from another side, and hides other ground: what a change map shows here beyond vehicles is a false alarm.

    python -m benchmarks.flight_lines TILE.laz OUT --before 57139 --after 44266 --after 57138
    loda-pdal detect OUT/before.laz OUT/after.laz -o OUT/result --epsg N
"""

from __future__ import annotations

from pathlib import Path

import click
import laspy
import numpy as np

from loda_pdal.model.pair import Pair

NOISE = (7, 18)
"""Classes of points that are no returns of anything."""

CELL_M = 2.0
"""Edge of the cells in which the common area is counted."""


def split(tile: Path, folder: Path, lines: Pair[list[int]]) -> float:
    """Write ``before.laz`` and ``after.laz`` with the points of each epoch's flight lines (point source ids).

    Returns
    -------
    float
        Area (m2) in which both have returns.
    """
    las = laspy.read(tile)
    source, is_noise = np.asarray(las.point_source_id), np.isin(np.asarray(las.classification), NOISE)
    parts = lines.map(lambda own: las[np.isin(source, own) & ~is_noise])
    for side, own, part in zip(("before", "after"), lines, parts, strict=True):
        if len(part) == 0:
            raise click.ClickException(f"{tile.name} has no points of {own}; it has those of {np.unique(source)}.")
        folder.mkdir(parents=True, exist_ok=True)
        part.write(folder / f"{side}.laz")
    cells = parts.map(lambda part: set(zip(*(np.asarray(axis) // CELL_M for axis in (part.x, part.y)), strict=True)))
    return len(cells.before & cells.after) * CELL_M**2


@click.command()
@click.argument("tile", type=click.Path(path_type=Path, exists=True))
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--before", required=True, type=int, multiple=True, help="Point source id, once or more.")
@click.option("--after", required=True, type=int, multiple=True, help="Point source id, once or more.")
def main(tile: Path, folder: Path, before: tuple[int, ...], after: tuple[int, ...]) -> None:
    """Write the flight lines of a TILE to FOLDER as two surveys."""
    area = split(tile, folder, Pair(list(before), list(after)))
    click.echo(f"{folder}: both have returns on {area:.0f} m2.")


if __name__ == "__main__":
    main()
