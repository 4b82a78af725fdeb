"""The report's map, and its pictures of one change: plan and profile, before and after, as inline SVG."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from loda_pdal.io.colours import LABEL_COLOURS
from loda_pdal.io.pictures import IndexArray, PlanIndex, View, draw_points, palette, png_data_uri
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray
from loda_pdal.model.grid import cells_of
from loda_pdal.model.groups import Groups, unique_inverse
from loda_pdal.model.labels import ChangeLabel
from loda_pdal.model.pair import Pair
from loda_pdal.model.records import UIntArray

PICTURE_PX = 400
"""Columns of a picture of one change."""
MAP_PX = 1400
"""Longer edge of the map's backdrop."""
PLAN_RATIO, PROFILE_RATIO = 0.72, 0.50
"""Height over width of the two kinds of pictures."""
POINT_GROWTH = 1.5
"""Points are drawn this much larger than their spacing: irregular spacing leaves no holes in a surface."""


@dataclass(frozen=True)
class Scene:
    """The points of both epochs in the after frame, ready to be drawn.

    Attributes
    ----------
    xyz : Pair of (n, 3) float64, m
        Fused points.
    object_of_point : Pair of (n,) uint32
        Object of each point; 0 none.
    index : Pair of PlanIndex
        Finds points by place.
    point_m : float
        Spacing of the points, m.
    """

    xyz: Pair[FloatArray]
    object_of_point: Pair[UIntArray]
    index: Pair[PlanIndex]
    point_m: float

    @classmethod
    def of(cls, xyz: Pair[FloatArray], object_of_point: Pair[UIntArray], point_m: float) -> Scene:
        """A scene of these points."""
        return cls(xyz, object_of_point, xyz.map(PlanIndex), point_m)


@dataclass(frozen=True)
class Shape:
    """One outline on the map: where a click leads, what hovering says, and how it looks."""

    footprint: Any
    label: ChangeLabel
    title: str
    target: str
    is_ground: bool = False


def object_pictures(scene: Scene, object_id: int, label: ChangeLabel, footprint: Any) -> str:
    """Before and after of one object, in plan and in profile, as HTML; empty where no point of it is left."""
    low, high = _bounds(footprint)
    nearby = scene.index.map(lambda index: index.near(*(low - 1.0), *(high + 1.0)))
    members = nearby.join(scene.object_of_point, lambda idx, number: idx[number[idx] == object_id])
    return _pictures(scene, members, label, footprint)


def ground_pictures(scene: Scene, label: ChangeLabel, footprint: Any) -> str:
    """The same for a piece of changed ground: the lowest points inside its outline stand for it."""
    low, high = _bounds(footprint)
    shapely.prepare(footprint)

    def members(index: PlanIndex, xyz: FloatArray) -> IndexArray:
        idx = index.near(*low, *(high + _LOWEST_OF_M))
        nearby = xyz[idx]
        cell = unique_inverse(cells_of(nearby[:, :2] - low, _LOWEST_OF_M))
        lowest = Groups(cell, int(cell.max(initial=-1)) + 1).minimum(nearby[:, 2])
        is_inside = shapely.contains_xy(footprint, nearby[:, 0], nearby[:, 1])
        return np.asarray(idx[is_inside & (nearby[:, 2] < lowest[cell] + _GROUND_LAYER_M)])

    return _pictures(scene, scene.index.join(scene.xyz, members), label, footprint)


_LOWEST_OF_M = 2.0
_GROUND_LAYER_M = 0.4


def _pictures(scene: Scene, members: Pair[IndexArray], label: ChangeLabel, footprint: Any) -> str:
    """Pictures of the points ``members`` of both epochs in their surroundings."""
    parts = scene.xyz.join(members, lambda xyz, idx: xyz[idx])
    points = np.concatenate(list(parts))
    if not len(points):
        return ""
    colours = palette(LABEL_COLOURS[label])
    plan, axis = _plan_view(points, footprint), main_axis(points[:, :2])
    profile, slab = _profile_view(points, axis)
    sideways = np.array([-axis[1], axis[0]])
    ends = np.array([profile.u0, profile.u0 + profile.width_m])
    cut_xy = ends[:, None] * axis + (points[:, :2].mean(axis=0) @ sideways) * sideways
    corners = np.array([u * axis + w * sideways for u in ends for w in slab])
    tops = parts.map(lambda part: float(part[:, 2].max()) if len(part) else None)
    plans, profiles = [], []
    for epoch, xyz, index, idx in zip(("before", "after"), scene.xyz, scene.index, members, strict=True):
        is_member = np.zeros(len(xyz), np.bool_)
        is_member[idx] = True
        seen = index.near(plan.u0 - 0.5, plan.v0 - 0.5, plan.u0 + plan.width_m + 0.5, plan.v0 + plan.height_m + 0.5)
        image = _draw_plan(plan, xyz[seen], is_member[seen], scene.point_m)
        overlay = _outline(footprint, plan, LABEL_COLOURS[label]) + _cut_line(cut_xy, plan)
        plans.append(_svg(plan, png_data_uri(image, colours), overlay, f"Plan, {epoch}"))
        seen = index.near(*corners.min(axis=0), *corners.max(axis=0))
        across = xyz[seen, :2] @ sideways
        seen = seen[(across >= slab[0]) & (across <= slab[1])]
        image = _draw_profile(profile, xyz[seen], is_member[seen], axis, scene.point_m)
        overlay = _top_lines(tops, profile, label)
        profiles.append(_svg(profile, png_data_uri(image, colours), overlay, f"Profile, {epoch}"))
    return '<div class="pictures"><b>Before</b><b>After</b>' + "".join(plans + profiles) + "</div>"


def _bounds(footprint: Any) -> tuple[FloatArray, FloatArray]:
    x0, y0, x1, y1 = footprint.bounds
    return np.array([x0, y0]), np.array([x1, y1])


def _plan_view(points: FloatArray, footprint: Any) -> View:
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    edge_low, edge_high = _bounds(footprint)
    low, high = np.minimum(low, edge_low), np.maximum(high, edge_high)
    size = high - low
    pad = max(3.0, 0.35 * float(size.max()))
    width = max(size[0] + 2 * pad, (size[1] + 2 * pad) / PLAN_RATIO)
    height = width * PLAN_RATIO
    centre = (low + high) / 2
    return View(float(centre[0] - width / 2), float(centre[1] - height / 2), float(width), height, width / PICTURE_PX)


def main_axis(xy: FloatArray) -> FloatArray:
    """Unit direction (2,) in which points (n, 2) stretch most, pointing east (north where it runs due north)."""
    centred = xy - xy.mean(axis=0)
    values, vectors = np.linalg.eigh(centred.T @ centred + np.diag([1e-9, 0.0]))
    axis = vectors[:, int(np.argmax(values))]
    is_west = axis[0] < -1e-9 or (abs(axis[0]) <= 1e-9 and axis[1] < 0)
    return np.asarray(-axis if is_west else axis)


def _profile_view(points: FloatArray, axis: FloatArray) -> tuple[View, tuple[float, float]]:
    """View along ``axis`` and z, and the range (m) across the axis of what is drawn."""
    along, across = points[:, :2] @ axis, points[:, :2] @ np.array([-axis[1], axis[0]])
    pad = max(3.0, 0.25 * float(np.ptp(along)))
    height = max(float(np.ptp(points[:, 2])) + 2.5, 4.0)
    width = max(float(np.ptp(along)) + 2 * pad, 1.2 * height / PROFILE_RATIO)
    z0 = float(points[:, 2].min()) - 0.07 * width  # room for the scale bar
    centre = (along.min() + along.max()) / 2
    view = View(float(centre - width / 2), z0, width, width * PROFILE_RATIO, width / PICTURE_PX)
    return view, (float(across.min()) - 1.0, float(across.max()) + 1.0)


def _draw_plan(view: View, xyz: FloatArray, is_object: BoolArray, point_m: float) -> ByteArray:
    picture = np.zeros(view.shape, dtype=np.uint8)
    for ramp, is_drawn, light, spread, floor_m in ((0, ~is_object, 0.95, -0.45, 4.0), (1, is_object, 0.35, 0.60, 0.5)):
        x, y, z = xyz[is_drawn].T
        tone = light + spread * _scaled(z, floor_m)
        draw_points(picture, view, (x, y, z), tone, point_m * POINT_GROWTH, ramp)
    return picture


def _draw_profile(view: View, xyz: FloatArray, is_object: BoolArray, axis: FloatArray, point_m: float) -> ByteArray:
    picture = np.zeros(view.shape, dtype=np.uint8)
    along, across = xyz[:, :2] @ axis, xyz[:, :2] @ np.array([-axis[1], axis[0]])
    nearness = -across  # seen from the right of the axis: small `across` is near
    for ramp, is_drawn, light, spread in ((0, ~is_object, 0.92, -0.37), (1, is_object, 0.55, 0.40)):
        u, v, near = along[is_drawn], xyz[is_drawn, 2], nearness[is_drawn]
        tone = light + spread * _scaled(near, floor_m=1.0)
        draw_points(picture, view, (u, v, near), tone, point_m * POINT_GROWTH, ramp)
    return picture


def _scaled(values: FloatArray, floor_m: float) -> FloatArray:
    """``values`` (n,) from 0 at their 5th to 1 at their 98th percentile, which count as ``floor_m`` apart or more."""
    if not len(values):
        return values
    low, high = np.percentile(values, (5, 98))
    return np.asarray(np.clip((values - low) / max(high - low, floor_m), 0.0, 1.0))


def _svg(view: View, image: str, overlay: str, text: str) -> str:
    """A picture with its overlay; the user unit is one picture pixel."""
    rows, columns = view.shape
    return (
        f'<svg viewBox="0 0 {columns} {rows}" role="img" aria-label="{html.escape(text)}">'
        f'<image href="{image}" width="{columns}" height="{rows}"/>{overlay}{scale_bar(view, columns, rows, 11)}</svg>'
    )


def scale_bar(view: View, columns: float, rows: float, font: float) -> str:
    """A bar of a round length in the lower left corner, in picture pixels."""
    length_m = round_length(view.width_m / 4.5)
    bar, x, y = length_m / view.pixel_m, 0.9 * font, rows - 0.9 * font
    words = f"{length_m:g} m"
    return (
        f'<rect x="{x - 0.4 * font:.1f}" y="{y - 1.6 * font:.1f}" width="{bar + 0.8 * font:.1f}" '
        f'height="{2.1 * font:.1f}" rx="{0.3 * font:.1f}" fill="#fff" fill-opacity=".82"/>'
        f'<path d="M{x:.1f} {y - 0.4 * font:.1f}v{0.4 * font:.1f}h{bar:.1f}v{-0.4 * font:.1f}" fill="none" '
        f'stroke="#20252b" stroke-width="{font / 8:.2f}"/>'
        f'<text x="{x + bar / 2:.1f}" y="{y - 0.45 * font:.1f}" font-size="{font:g}" '
        f'text-anchor="middle">{words}</text>'
    )


def round_length(at_most_m: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above ``at_most_m``."""
    power = 10.0 ** math.floor(math.log10(at_most_m))
    return float(max(step * power for step in (1, 2, 5) if step * power <= at_most_m * (1 + 1e-9)))


def _outline(footprint: Any, view: View, colour: str) -> str:
    path = svg_path(footprint, view, digits=1)
    return (
        f'<path d="{path}" fill="none" stroke="#fff" stroke-width="3" stroke-opacity=".7"/>'
        f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.6" stroke-dasharray="5 3"/>'
    )


def _cut_line(cut_xy: FloatArray, view: View) -> str:
    rows, columns = view.shape
    ends = np.column_stack(
        [(cut_xy[:, 0] - view.u0) / view.pixel_m, (view.v0 + view.height_m - cut_xy[:, 1]) / view.pixel_m]
    )
    box = shapely.box(14, 14, columns - 14, rows - 34)  # clear of the scale bar
    line = shapely.LineString(ends).intersection(box)
    if line.is_empty or line.geom_type != "LineString":
        return ""
    (x0, y0), (x1, y1) = line.coords[0], line.coords[-1]
    dx, dy = (x1 - x0) * 0.09, (y1 - y0) * 0.09
    ticks = f"M{x0:.1f} {y0:.1f}l{dx:.1f} {dy:.1f}M{x1:.1f} {y1:.1f}l{-dx:.1f} {-dy:.1f}"
    words = "".join(
        f'<text x="{x:.1f}" y="{y + 4:.1f}" font-size="12" font-weight="600" text-anchor="middle" stroke="#fff" '
        f'stroke-width="3" paint-order="stroke">{word}</text>'
        for x, y, word in ((x0, y0, "A"), (x1, y1, "B"))
    )
    return f'<path d="{ticks}" stroke="#20252b" stroke-width="1.2" fill="none"/>{words}'


def _top_lines(tops: Pair[float | None], view: View, label: ChangeLabel) -> str:
    if tops.before is None or tops.after is None or abs(tops.after - tops.before) < 0.05:
        return ""
    _, columns = view.shape
    lines = []
    for top, colour in ((tops.before, "#5b636d"), (tops.after, LABEL_COLOURS[label])):
        y = (view.v0 + view.height_m - top) / view.pixel_m
        lines.append(
            f'<path d="M0 {y:.1f}H{columns}" stroke="{colour}" stroke-width="1.4" stroke-dasharray="6 4" fill="none"/>'
        )
    return "".join(lines)


def svg_path(footprint: Any, view: View, digits: int) -> str:
    """Path of all rings of a polygon, in pixels of ``view``; fill it by the even-odd rule."""
    steps = []
    for polygon in getattr(footprint, "geoms", [footprint]):
        for ring in (polygon.exterior, *polygon.interiors):
            xy = np.asarray(ring.coords)[:-1, :2]
            columns = np.round((xy[:, 0] - view.u0) / view.pixel_m, digits)
            rows = np.round((view.v0 + view.height_m - xy[:, 1]) / view.pixel_m, digits)
            steps.append("M" + "L".join(f"{a:g} {b:g}" for a, b in zip(columns, rows, strict=True)) + "Z")
    return "".join(steps)


def map_svg(scene: Scene, shapes: Iterable[Shape]) -> str:
    """Plan map: the shaded surface with the outlines of what changed over it, a scale bar and a north arrow."""
    shapes = list(shapes)
    view = _map_view(scene, shapes)
    rows, columns = view.shape
    picture = np.zeros(view.shape, dtype=np.uint8)
    for xyz in scene.xyz:  # the later survey where it saw anything
        x, y, z = xyz.T
        draw_points(picture, view, (x, y, z), 0.97 - 0.40 * _scaled(z, 10.0), scene.point_m * POINT_GROWTH, ramp=0)
    image = png_data_uri(picture, palette("#000000"))
    font = max(columns, rows) / 85
    parts = [
        f'<svg viewBox="0 0 {columns} {rows}" role="img" aria-label="Map of changes">',
        f'<image href="{image}" width="{columns}" height="{rows}"/>',
    ]
    order = {ChangeLabel.UNCHANGED: 0, ChangeLabel.UNDETERMINED: 1}
    drawn = sorted(shapes, key=lambda s: (order.get(s.label, 2), -s.footprint.area))
    parts += [_map_shape(shape, view, font) for shape in drawn]
    parts += [scale_bar(view, columns, rows, font), _north_arrow(columns, font), "</svg>"]
    return "".join(parts)


def _map_view(scene: Scene, shapes: list[Shape]) -> View:
    bounds = [(*xyz[:, :2].min(axis=0), *xyz[:, :2].max(axis=0)) for xyz in scene.xyz if len(xyz)]
    bounds += [shape.footprint.bounds for shape in shapes if not shape.footprint.is_empty]
    boxes = np.array(bounds or [(0.0, 0.0, 1.0, 1.0)])
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    size = np.maximum(high - low, 1.0)
    pad = 0.02 * float(size.max())
    width, height = size + 2 * pad
    return View(low[0] - pad, low[1] - pad, float(width), float(height), float(max(width, height)) / MAP_PX)


def _map_shape(shape: Shape, view: View, font: float) -> str:
    footprint = shape.footprint.simplify(0.4 * view.pixel_m)
    kind = " ground" if shape.is_ground else " unchanged" if shape.label is ChangeLabel.UNCHANGED else ""
    drawn = f'<path class="shape{kind}" fill-rule="evenodd" d="{svg_path(footprint, view, digits=1)}"/>'
    x0, y0, x1, y1 = footprint.bounds
    if max(x1 - x0, y1 - y0) / view.pixel_m < 0.7 * font and kind != " unchanged":  # too small to see: ring it
        x, y = ((x0 + x1) / 2 - view.u0) / view.pixel_m, (view.v0 + view.height_m - (y0 + y1) / 2) / view.pixel_m
        drawn += f'<circle class="pin" cx="{x:.1f}" cy="{y:.1f}" r="{0.55 * font:.1f}"/>'
    name = f' href="#{html.escape(shape.target)}"' if shape.target else ""
    return (
        f'<a{name} data-label="{shape.label.title}" style="--c:{LABEL_COLOURS[shape.label]}">'
        f"<title>{html.escape(shape.title)}</title>{drawn}</a>"
    )


def _north_arrow(columns: float, font: float) -> str:
    return (
        f'<g transform="translate({columns - 2.6 * font:.1f} {1.4 * font:.1f}) scale({font / 10:.3f})">'
        '<circle cy="14" r="18" fill="#fff" fill-opacity=".82"/>'
        '<path d="M0 0L6 20L0 16L-6 20Z" fill="#20252b"/>'
        '<text y="29" font-size="10" font-weight="600" text-anchor="middle">N</text></g>'
    )
