"""Blocks by a second generator, to check what was developed on the first one.

It shares the reader of city models and the format of the truth with `loda_pdal.benchmark.simulate`, and nothing else:
pulses are cast by Open3D, plants are clouds of triangles of which each survey meets other ones, walls have no windows,
the ground undulates, nothing passes by. Edits are drawn by kind. An instance is left out where fewer than 30 returns
show it, or what changed of it. The clouds have no trajectory and one return per pulse.

    pip install 'loda-pdal[compare]'
    python -m benchmarks.second_generator OUT --city MODEL.json --sensor airborne --seed 1
    loda-pdal detect OUT/before.laz OUT/after.laz -o OUT/result
    loda-pdal bench score OUT/result OUT/truth.json
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import click
import laspy
import numpy as np
import shapely
from pyproj import CRS
from scipy.spatial import cKDTree

from loda_pdal.benchmark.simulate.city_model import ModelBuilding, read_city_model
from loda_pdal.benchmark.truth import Truth, TruthInstance
from loda_pdal.model.cloud import FloatArray, IntArray
from loda_pdal.model.labels import ChangeLabel, ObjectClass
from loda_pdal.model.pair import Pair

EPSG = 7415
HALF_M = 60.0
"""Half the edge of a block from the air."""

STREET_M = (100.0, 56.0)
"""Length and width of a block along a drive."""

MIN_RETURNS = 30
NOISE_M = 0.02
SAME_M = 0.35
"""Returns farther than this from all of the same instance in the other survey are of surface that changed."""


@dataclass
class Thing:
    """An annotated object: its triangles (t, 3, 3) in each survey, None where it does not stand."""

    kind: str
    object_class: ObjectClass
    shapes: Pair[FloatArray | None]
    label: ChangeLabel = ChangeLabel.UNCHANGED
    edit: str = ""


@dataclass
class Block:
    """What stands in a block, and where it was surveyed from."""

    centre: FloatArray
    foot_m: float
    tilt: FloatArray
    things: list[Thing] = field(default_factory=list)
    surroundings: list[FloatArray] = field(default_factory=list)
    drive: shapely.LineString | None = None

    def ground(self, x: FloatArray | float, y: FloatArray | float) -> FloatArray:
        """Height of the ground: a tilted plane with waves of 0.15 m."""
        dx, dy = x - self.centre[0], y - self.centre[1]
        waves = 0.15 * np.sin(dx / 17.0) + 0.1 * np.cos(dy / 13.0)
        return np.asarray(self.foot_m + self.tilt[0] * dx + self.tilt[1] * dy + waves)

    @property
    def outline(self) -> shapely.Polygon:
        """What is evaluated."""
        if self.drive is None:
            return shapely.box(*(self.centre - HALF_M), *(self.centre + HALF_M))
        return self.drive.buffer(STREET_M[1] / 2, cap_style="flat")


def make_block(buildings: list[ModelBuilding], sensor: str, rng: np.random.Generator) -> Block:
    """A piece of a city with plants, vehicles and poles, and what changed in it."""
    block = _place(buildings, sensor, rng)
    near = [b for b in buildings if b.footprint.distance(shapely.Point(block.centre)) < 2 * HALF_M]
    inside = [b for b in near if b.footprint.centroid.within(block.outline)]
    built = shapely.union_all([b.footprint for b in near])
    for building in inside:
        thing, annex = _building(building, built, rng)
        block.things.append(thing)
        built = built.union(annex)
    block.surroundings = [b.triangles for b in near if b not in inside]
    taken = built.buffer(1.2) if block.drive is None else built.buffer(1.2).union(block.drive.buffer(2.6))
    counts = ((_tree, 45, 2.0), (_vehicle, 40, 2.4), (_pole, 14, 0.4))
    for make, n, radius in counts:
        for _ in range(n if block.drive is None else n // 2 + 8):
            if (spot := _spot(block, taken, radius, rng)) is not None:
                block.things.append(make(block, *spot, rng))
                taken = taken.union(shapely.Point(spot).buffer(radius))
    return block


def _place(buildings: list[ModelBuilding], sensor: str, rng: np.random.Generator) -> Block:
    """Where the block lies: about a dozen buildings or more, and along a straight drive clear of all of them."""
    centroids = np.array([(b.footprint.centroid.x, b.footprint.centroid.y) for b in buildings])
    for _ in range(200):
        centre = centroids[rng.integers(len(centroids))] + rng.normal(0.0, 20.0, 2)
        near = np.flatnonzero(np.abs(centroids - centre).max(axis=1) < HALF_M)
        if len(near) < 12:
            continue
        foot_m = float(np.median([buildings[i].foot_m for i in near]))
        block = Block(centre, foot_m, rng.normal(0.0, 0.006, 2))
        if sensor == "airborne":
            return block
        built = shapely.union_all([buildings[i].footprint for i in near])
        starts = centre + rng.uniform(-15.0, 15.0, (300, 2))
        angle = rng.uniform(0.0, np.pi, 300)
        reach = STREET_M[0] / 2 * np.column_stack([np.cos(angle), np.sin(angle)])
        drives = shapely.linestrings(np.stack([starts - reach, starts + reach], axis=1))
        clear = shapely.distance(drives, built)
        if clear.max() > 3.5:
            block.drive = drives[np.argmax(clear)]
            return block
    raise click.ClickException("The model has no such place: no dozen of buildings, or no straight street.")


def _building(b: ModelBuilding, built: shapely.Geometry, rng: np.random.Generator) -> tuple[Thing, shapely.Geometry]:
    """A building with what was done to it, and the ground that an annex takes."""
    whole, nothing = b.triangles, shapely.Polygon()
    share, is_small = rng.random(), b.footprint.area < 1500.0

    def thing(label: ChangeLabel, edit: str, before: FloatArray | None, after: FloatArray | None) -> Thing:
        return Thing("building", ObjectClass.BUILDING, Pair(before, after), label, edit)

    def raised() -> FloatArray:
        is_upper = whole[..., 2] > b.foot_m + 1.5
        return np.asarray(whole + np.stack([0.0 * is_upper, 0.0 * is_upper, is_upper * rng.uniform(1.5, 3.2)], axis=-1))

    if share < 0.06 and is_small:
        return thing(ChangeLabel.REMOVED, "building removed", whole, None), nothing
    if share < 0.12 and is_small:
        return thing(ChangeLabel.ADDED, "building added", None, whole), nothing
    if 0.12 < share < 0.18 and b.top_m - b.foot_m > 3.0:
        return thing(ChangeLabel.INCREASED, "storey added", whole, raised()), nothing
    if 0.18 < share < 0.23 and b.top_m - b.foot_m > 3.0:
        return thing(ChangeLabel.DECREASED, "storey taken", raised(), whole), nothing
    if 0.23 < share < 0.35 and (found := _annex(b, built, rng)) is not None:
        with_annex, plan = np.concatenate([whole, found[0]]), found[1]
        if rng.random() < 0.5:
            return thing(ChangeLabel.INCREASED, "building extended", whole, with_annex), plan
        return thing(ChangeLabel.DECREASED, "annex demolished", with_annex, whole), plan
    return thing(ChangeLabel.UNCHANGED, "", whole, whole), nothing


def _annex(
    b: ModelBuilding, built: shapely.Geometry, rng: np.random.Generator
) -> tuple[FloatArray, shapely.Geometry] | None:
    """A box against one of the walls where there is room for it, and its plan."""
    polygon = max(getattr(b.footprint, "geoms", [b.footprint]), key=lambda part: part.area)
    corners = np.array(polygon.exterior.coords)
    for k in rng.permutation(len(corners) - 1):
        start, wall = corners[k], corners[k + 1] - corners[k]
        length = float(np.hypot(*wall))
        if length < 3.2:
            continue
        width, depth, height = min(rng.uniform(2.5, 6.0), length), rng.uniform(2.0, 4.0), rng.uniform(2.4, 3.3)
        along = wall / length
        for outward in (np.array([along[1], -along[0]]), np.array([-along[1], along[0]])):
            middle = start + along * rng.uniform(width / 2, length - width / 2) + outward * (depth / 2 + 0.01)
            angle = float(np.arctan2(along[1], along[0]))
            shape = _box(middle[0], middle[1], b.foot_m - 0.3, (width, depth, height + 0.3), angle)
            plan = shapely.MultiPoint(shape.reshape(-1, 3)[:, :2]).convex_hull
            if plan.buffer(-0.2).disjoint(built):
                return shape, plan
    return None


def _tree(block: Block, x: float, y: float, rng: np.random.Generator) -> Thing:
    """A tree of 3 to 13 m; each survey meets leaves of its own, and another share of them."""
    height = rng.uniform(3.0, 13.0)
    width, grows = height * rng.uniform(0.2, 0.32), rng.uniform(1.2, 1.5)
    foot, share = float(block.ground(x, y)), rng.random()

    def grown(factor: float) -> FloatArray:
        return _leaves_and_trunk(x, y, foot, height * factor, width * factor, rng.uniform(0.75, 1.0), rng)

    def thing(label: ChangeLabel, edit: str, before: FloatArray | None, after: FloatArray | None) -> Thing:
        return Thing("tree", ObjectClass.VEGETATION, Pair(before, after), label, edit)

    if share < 0.12:
        return thing(ChangeLabel.REMOVED, "tree removed", grown(1.0), None)
    if share < 0.24:
        return thing(ChangeLabel.ADDED, "tree added", None, grown(1.0))
    if share < 0.34:
        return thing(ChangeLabel.INCREASED, "tree grown", grown(1.0), grown(grows))
    if share < 0.44:
        return thing(ChangeLabel.DECREASED, "tree pruned", grown(grows), grown(1.0))
    return thing(ChangeLabel.UNCHANGED, "", grown(1.0), grown(1.0))


def _leaves_and_trunk(
    x: float, y: float, foot: float, height: float, radius: float, share: float, rng: np.random.Generator
) -> FloatArray:
    """Small triangles in an ellipsoid, denser towards its surface, above a trunk of six sides."""
    n = int(260 * radius**2 * share)
    place = rng.normal(size=(n, 3))
    place *= (rng.uniform(0.35, 1.0, n) ** 0.6 / np.linalg.norm(place, axis=1))[:, None]
    crown = max(height - max(1.8, 0.3 * height), 1.0)
    middle = foot + height - crown / 2
    place = np.array([x, y, middle]) + place * [radius, radius, crown / 2]
    leaves = place[:, None] + np.stack([np.zeros((n, 3)), *rng.normal(0.0, 0.14, (2, n, 3))], axis=1)
    angle = np.arange(7) * np.pi / 3
    ring = np.column_stack([np.cos(angle), np.sin(angle)]) * (0.06 + 0.012 * height) + [x, y]
    low, high = (np.column_stack([ring, np.full(7, z)]) for z in (foot, middle))
    trunk = [low[:-1], high[:-1], high[1:]], [low[:-1], high[1:], low[1:]]
    return np.concatenate([leaves, *(np.stack(side, axis=1) for side in trunk)])


def _vehicle(block: Block, x: float, y: float, rng: np.random.Generator) -> Thing:
    """A car or a van, along the drive where there is one."""
    angle, is_van, share = 0.0, rng.random() < 0.2, rng.random()
    if block.drive is not None:
        (x_0, y_0), (x_1, y_1) = block.drive.coords
        angle = float(np.arctan2(y_1 - y_0, x_1 - x_0)) + rng.normal(0.0, 0.03)
    foot = float(block.ground(x, y)) + 0.25
    if is_van:
        shape = _box(x, y, foot, (5.2, 2.0, 2.05), angle, 0.95)
    else:
        back = -0.2 * np.array([np.cos(angle), np.sin(angle)])
        cabin = _box(x + back[0], y + back[1], foot + 0.55, (2.6, 1.65, 0.65), angle, 0.7)
        shape = np.concatenate([_box(x, y, foot, (4.3, 1.8, 0.55), angle), cabin])
    kind = "van" if is_van else "car"
    if share < 0.22:
        return Thing(kind, ObjectClass.MOBILE, Pair(shape, None), ChangeLabel.REMOVED, "vehicle removed")
    if share < 0.44:
        return Thing(kind, ObjectClass.MOBILE, Pair(None, shape), ChangeLabel.ADDED, "vehicle added")
    return Thing(kind, ObjectClass.MOBILE, Pair(shape, shape))


def _pole(block: Block, x: float, y: float, rng: np.random.Generator) -> Thing:
    shape = _box(x, y, float(block.ground(x, y)), (0.14, 0.14, rng.uniform(3.5, 7.0)), 0.0)
    share = rng.random()
    if share < 0.1:
        return Thing("pole", ObjectClass.OTHER, Pair(shape, None), ChangeLabel.REMOVED, "pole removed")
    if share < 0.2:
        return Thing("pole", ObjectClass.OTHER, Pair(None, shape), ChangeLabel.ADDED, "pole added")
    return Thing("pole", ObjectClass.OTHER, Pair(shape, shape))


def _spot(block: Block, taken: shapely.Geometry, radius: float, rng: np.random.Generator) -> tuple[float, float] | None:
    """A free place of this radius, no farther than 14 m from a drive; None where none is found."""
    area = block.outline if block.drive is None else block.drive.buffer(14.0)
    west, south, east, north = area.bounds
    shapely.prepare(taken)
    for _ in range(300):
        x, y = rng.uniform((west, south), (east, north))
        place = shapely.Point(x, y)
        if place.within(area) and place.buffer(0.8 * radius).disjoint(taken):
            return float(x), float(y)
    return None


def _box(
    x: float, y: float, foot: float, size: tuple[float, float, float], angle: float, top: float = 1.0
) -> FloatArray:
    """Triangles (10, 3, 3) of a box without a floor, its roof ``top`` times as long as its foot."""
    length, width, height = size
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, width / 2]
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    plans = (corners, foot), (corners * [top, 1.0], foot + height)
    low, high = (np.column_stack([plan @ turn + [x, y], np.full(4, z)]) for plan, z in plans)
    v = np.concatenate([low, high])
    faces = [(0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7), (4, 5, 6, 7)]
    return np.array([v[list(t)] for a, b, c, d in faces for t in ((a, b, c), (a, c, d))])


Caster = Callable[[FloatArray], tuple[FloatArray, IntArray]]
"""Distance (m) and thing (0 ground, else its number; -1 for what is not annotated) of rays (r, 6); inf for none."""


def surfaces(block: Block, epoch: int) -> tuple[FloatArray, IntArray]:
    """Triangles (t, 3, 3) that one survey may meet, and whose they are (t,), numbered as in `Caster`."""
    grid = np.arange(-2 * HALF_M, 2 * HALF_M + 1.0, 3.0)
    x, y = np.meshgrid(block.centre[0] + grid, block.centre[1] + grid, indexing="ij")
    g = np.stack([x, y, block.ground(x, y)], axis=-1)
    parts = [(np.stack([g[:-1, :-1], g[1:, :-1], g[1:, 1:]], axis=2).reshape(-1, 3, 3), 0)]
    parts += [(np.stack([g[:-1, :-1], g[1:, 1:], g[:-1, 1:]], axis=2).reshape(-1, 3, 3), 0)]
    shapes = ([*thing.shapes][epoch] for thing in block.things)
    parts += [(shape, number) for number, shape in enumerate(shapes, 1) if shape is not None]
    parts += [(shape, -1) for shape in block.surroundings]
    owner = np.concatenate([np.full(len(shape), number, np.int32) for shape, number in parts])
    return np.concatenate([shape for shape, _ in parts]), owner


def open3d_caster(block: Block, epoch: int, origin: FloatArray) -> Caster:
    """Rays into what one survey meets, by Open3D (float32: everything is relative to ``origin``)."""
    import open3d

    corners, owner = surfaces(block, epoch)
    vertices = (corners.reshape(-1, 3) - origin).astype(np.float32)
    scene = open3d.t.geometry.RaycastingScene()
    triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(open3d.core.Tensor(vertices), open3d.core.Tensor(triangles))

    def cast(rays: FloatArray) -> tuple[FloatArray, IntArray]:
        answer = scene.cast_rays(open3d.core.Tensor(rays.astype(np.float32)))
        distance, hit = answer["t_hit"].numpy().astype(float), answer["primitive_ids"].numpy()
        found = np.full(len(rays), -1)
        found[np.isfinite(distance)] = owner[hit[np.isfinite(distance)]]
        return distance, found

    return cast


def from_the_air(
    block: Block, cast: Caster, origin: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """Three strips from 450 m, 10 to 24 pulses per m2 together."""
    points, owners = [], []
    density = rng.uniform(10.0, 24.0)
    for beside in (-90.0, 0.0, 90.0):
        n = int(density / 3 * (2 * HALF_M) ** 2)
        target = np.column_stack([rng.uniform(-HALF_M, HALF_M, (n, 2)), np.zeros(n)])
        source = np.column_stack([np.full(n, beside), target[:, 1], np.full(n, 450.0)])
        xyz, owner = _measured(source, target - source, cast, rng)
        points.append(xyz + rng.normal(0.0, 1.0, xyz.shape) * [0.03, 0.03, 0.006])
        owners.append(owner)
    return np.concatenate(points) + origin, np.concatenate(owners)


def from_the_street(
    block: Block, cast: Caster, origin: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, IntArray]:
    """96 beams within 22 degrees of level, 900 azimuths a turn, 110 to 170 turns along the drive, up to 60 m."""
    assert block.drive is not None
    start, end = np.array(block.drive.coords)
    along = (end - start) / np.hypot(*(end - start))
    aside = np.array([-along[1], along[0]]) * rng.normal(0.0, 0.5)
    elevation, azimuth = np.meshgrid(np.deg2rad(np.linspace(-22.0, 22.0, 96)), np.arange(900) * np.pi / 450)
    points, owners = [], []
    for share in (np.arange(n := int(rng.integers(110, 170))) + 0.5) / n:
        x, y = start + (end - start) * share + aside
        turned = azimuth + rng.uniform(0.0, np.pi / 450)
        level = np.cos(elevation)
        ray = np.stack([level * np.cos(turned), level * np.sin(turned), np.sin(elevation)], axis=-1).reshape(-1, 3)
        ray = ray[rng.random(len(ray)) < 0.55]
        source = np.array([x, y, float(block.ground(x, y)) + 2.1]) - origin
        xyz, owner = _measured(np.broadcast_to(source, ray.shape), ray, cast, rng, 60.0)
        points.append(xyz)
        owners.append(owner)
    xyz = np.concatenate(points) + origin
    inside = shapely.contains_xy(block.outline, xyz[:, 0], xyz[:, 1])
    return xyz[inside], np.concatenate(owners)[inside]


def _measured(
    source: FloatArray, toward: FloatArray, cast: Caster, rng: np.random.Generator, most_m: float = np.inf
) -> tuple[FloatArray, IntArray]:
    """Returns of pulses with range noise, and whose they are."""
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    distance, owner = cast(np.column_stack([source, toward]))
    hit = np.isfinite(distance) & (distance < most_m)
    distance = distance[hit] + rng.normal(0.0, NOISE_M, np.count_nonzero(hit))
    return source[hit] + toward[hit] * distance[:, None], owner[hit]


def annotate(block: Block, clouds: Pair[tuple[FloatArray, IntArray]], move: FloatArray, seed: int) -> Truth:
    """The truth of a block from what the surveys met of it."""
    rows = []
    for number, thing in enumerate(block.things, 1):
        own = clouds.map(lambda cloud, number=number: cloud[0][cloud[1] == number])  # type: ignore[misc]
        n, n_changed = own.map(len), Pair(0, 0)
        if thing.label is not ChangeLabel.UNCHANGED:
            n_changed = Pair(_apart(own.before, own.after), _apart(own.after, own.before))
        exists = thing.shapes.map(lambda shape: shape is not None)
        is_more = thing.label in (ChangeLabel.ADDED, ChangeLabel.INCREASED)
        excluded = None
        if any(there and points < MIN_RETURNS for there, points in zip(exists, n, strict=True)):
            excluded = "few returns"
        elif (
            thing.label is not ChangeLabel.UNCHANGED
            and (n_changed.after if is_more else n_changed.before) < MIN_RETURNS
        ):
            excluded = "change not met"
        points = np.concatenate([*own])
        centre = tuple(points.mean(axis=0).tolist()) if len(points) else None
        rows.append(
            TruthInstance(
                number, thing.object_class, thing.label, thing.kind, exists, n, n_changed, Pair(None, None), thing.edit,
                centre=centre, excluded=excluded,
            )
        )  # fmt: skip
    outline = [(float(x), float(y)) for x, y in block.outline.exterior.coords[:-1]]
    made_by = {"program": "benchmarks.second_generator", "seed": seed}
    return Truth(rows, move, outline, float(block.outline.area), f"EPSG:{EPSG}", made_by)


def _apart(own: FloatArray, other: FloatArray) -> int:
    """How many points show surface that the other survey does not."""
    if len(own) == 0 or len(other) == 0:
        return len(own)
    return int(np.count_nonzero(cKDTree(other).query(own)[0] > SAME_M))


def write(path: Path, xyz: FloatArray, owner: IntArray) -> None:
    """A LAS or LAZ file of a survey with ``TruthId``, 0 for what is not annotated."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.offsets, header.scales = np.floor(xyz.min(axis=0)), np.full(3, 0.001)
    header.add_extra_dim(laspy.ExtraBytesParams("TruthId", np.uint32))
    header.add_crs(CRS.from_epsg(EPSG))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las["TruthId"] = np.maximum(owner, 0)
    las.return_number[:] = las.number_of_returns[:] = 1
    las.write(path)


@click.command()
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--city", required=True, type=click.Path(path_type=Path, exists=True), help="CityJSON model.")
@click.option("--sensor", required=True, type=click.Choice(("vehicle", "airborne")))
@click.option("--seed", required=True, type=int)
def main(folder: Path, city: Path, sensor: str, seed: int) -> None:
    """Make a block of a city, survey it twice, and write both surveys and the truth to FOLDER."""
    rng = np.random.default_rng(seed)
    block = make_block(read_city_model(city), sensor, rng)
    origin = np.array([*block.centre, block.foot_m])
    measure = from_the_air if sensor == "airborne" else from_the_street
    before, after = (
        measure(block, open3d_caster(block, e, origin), origin, np.random.default_rng((seed, e))) for e in (0, 1)
    )
    angle, shift = np.deg2rad(rng.normal(0.0, 0.1)), rng.normal(0.0, 1.0, 3) * [0.04, 0.04, 0.02]
    move = np.eye(4)
    move[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    move[:3, 3] = origin + shift - move[:3, :3] @ origin
    folder.mkdir(parents=True, exist_ok=True)
    annotate(block, Pair(before, after), move, seed).write(folder / "truth.json")
    back = np.linalg.inv(move)
    write(folder / "before.laz", before[0] @ back[:3, :3].T + back[:3, 3], before[1])
    write(folder / "after.laz", *after)


if __name__ == "__main__":
    main()
