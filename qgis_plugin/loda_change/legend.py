"""Codes and colours of the point cloud and the raster; those of the GeoPackage travel inside it."""

CHANGE_CLASSES = (
    (0, "Undetermined", "#a16bb5"),
    (1, "Unchanged", "#9aa0a6"),
    (2, "Added", "#0072b2"),
    (3, "Removed", "#d55e00"),
    (4, "Increased", "#56b4e9"),
    (5, "Decreased", "#e69f00"),
)
"""Values of the dimension ChangeClass with title and colour."""

NO_CHANGE, FAINT = (0, 1), 80
"""Classes whose points stay in the background, and their opacity of 255."""

LOD_CLASSES = (
    (0.02, "#ffffd9"),
    (0.05, "#c7e9b4"),
    (0.10, "#7fcdbb"),
    (0.20, "#2c9fb8"),
    (0.40, "#225ea8"),
    (float("inf"), "#0c2c84"),
)
"""Upper bound (m) and colour of each class of LoD95."""
