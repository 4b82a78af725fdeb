"""Which instances of the two epochs are one object (paper, section 4.1 on the instances of section 4.2).

The paper assigns instances of one class to each other one by one. Segmentation is not that stable: a terrace is one
instance in one survey and three in the other, a hedge is vegetation here and `other` there. So an instance that the
assignment leaves over, but whose surface the other survey shows too, joins the object that occupies the same space
(METHOD 2b); only what occupies space of its own can be Added or Removed.

And where it is of another kind than that object (a bin that one survey shows beside a vehicle and the other in one
piece with it), the object gives up the points that belong to it instead: the survey that tells things apart is right.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from loda_pdal.kernels.clusters import components
from loda_pdal.kernels.neighbours import nearest
from loda_pdal.model.cloud import BoolArray, ByteArray, FloatArray, IntArray
from loda_pdal.model.groups import Groups, favourites
from loda_pdal.model.labels import OBJECT_CLASSES, ObjectClass
from loda_pdal.model.pair import Pair
from loda_pdal.params import AssociationParams
from loda_pdal.stages.association import Descriptors, Matches, associate
from loda_pdal.stages.instances import Instances

_MIN_SHARED = 0.5  # an instance of which the other epoch shows at least this share joins the object that shows most


@dataclass(frozen=True)
class Objects:
    """Objects over both epochs.

    Attributes
    ----------
    of_instance : Pair of (o,) int32
        Object of instance ``i + 1`` of each epoch, 0 to ``n - 1``.
    object_class : (n,) uint8
        Class of the largest instance of each object.
    matched : (p, 2) int32
        Instance pairs (0-based, before and after) that the assignment accepted.
    support : Pair of (o,) float64
        Share of each instance's voxels that have a surface of the other epoch's instances in reach.
    owner : Pair of (m,) int32
        Object of each voxel, -1 where it belongs to no instance: that of its instance, but for what was merged.
    """

    of_instance: Pair[IntArray]
    object_class: ByteArray
    matched: IntArray
    support: Pair[FloatArray]
    owner: Pair[IntArray]

    def __len__(self) -> int:
        return len(self.object_class)


def match_instances(
    xyz: Pair[FloatArray],
    instances: Pair[Instances],
    bodies: Pair[tuple[FloatArray, IntArray]],
    descriptors: Pair[Descriptors],
    proxy_pairs: tuple[Pair[IntArray], Matches] | None,
    reach_m: float,
    params: AssociationParams,
    *,
    has_sides: bool,
) -> Objects:
    """Objects from the instances of both epochs.

    Parameters
    ----------
    xyz : Pair of (m, 3) float64, m
        Fused points in the analysis frame.
    instances, descriptors : Pair
        What was segmented, and its descriptors.
    bodies : Pair of ((k, 3) float64 m, (k,) int32)
        Points that say what space the instances take, and the instance of each.
    proxy_pairs : (Pair of (m,) int32, Matches) or None
        Proxy of each voxel and the matched proxies (paper, section 4.1): instances of one class that lie in matched
        proxies and in no pair of their own are paired too. None where the preset has no proxies.
    reach_m : float
        Surfaces closer than this are the same surface.
    has_sides : bool
        Whether the surveys show the sides of things: then what takes one's space is told well enough to keep what lies
        in one proxy from being paired across.
    """
    pairs = _assign_by_class(instances, descriptors, params)
    n_before, n_after = len(instances.before), len(instances.after)
    votes = Pair(
        _shared_space(*bodies.before, n_before, *bodies.after, reach_m),
        _shared_space(*bodies.after, n_after, *bodies.before, reach_m),
    )
    if proxy_pairs is not None:
        by_proxy = _pairs_by_proxy(instances, *proxy_pairs, pairs)
        own, other = by_proxy.T
        is_elsewhere = _is_with_another(own, other, votes) | _is_with_another(other, own, votes.swapped)
        is_elsewhere &= np.isin(instances.before.object_class[own], (ObjectClass.MOBILE, ObjectClass.OTHER)) & has_sides
        pairs = np.concatenate([pairs, by_proxy[~is_elsewhere]])
    left = Pair(_left_over(votes.before, pairs[:, 0]), _left_over(votes.after, pairs[:, 1]))
    is_apart = left.map(lambda side: np.zeros(len(side), np.bool_))
    if params.splits_merged:
        kinds = instances.map(lambda side: side.object_class)
        is_apart = Pair(
            _stands_apart(left.before, votes, kinds), _stands_apart(left.after, votes.swapped, kinds.swapped)
        )
    joined = left.join(is_apart, lambda side, apart: side[~apart])
    apart = left.join(is_apart, lambda side, is_one: side[is_one])
    joins = [
        pairs + np.array([0, n_before]),
        np.column_stack([joined.before, votes.before.partner[joined.before] + n_before]),
        np.column_stack([votes.after.partner[joined.after], joined.after + n_before]),
    ]
    component = components(np.concatenate(joins).astype(np.int64), n_before + n_after)
    of_instance = Pair(component[:n_before], component[n_before:])
    owner = Pair(
        _owners(instances.before, of_instance, votes, apart.after),
        _owners(instances.after, of_instance.swapped, votes.swapped, apart.before),
    )
    return _numbered(xyz, instances, of_instance, owner, pairs, votes, has_sides=has_sides)


@dataclass(frozen=True)
class _Votes:
    """For each instance: share of voxels near any instance of the other epoch, and the one nearest to most of them.

    ``nearest`` (k,) is the instance of the other epoch, 0-based, that is nearest to each point, -1 none in reach.
    """

    support: FloatArray
    partner: IntArray
    nearest: IntArray


def _assign_by_class(instances: Pair[Instances], descriptors: Pair[Descriptors], params: AssociationParams) -> IntArray:
    """Accepted pairs (p, 2), class by class."""
    found = [np.zeros((0, 2), np.int32)]
    for code in OBJECT_CLASSES:
        before = np.flatnonzero(instances.before.object_class == code)
        after = np.flatnonzero(instances.after.object_class == code)
        matches = associate(descriptors.before.subset(before), descriptors.after.subset(after), params)
        found.append(np.column_stack([before[matches.before_idx], after[matches.after_idx]]).astype(np.int32))
    return np.concatenate(found)


def _pairs_by_proxy(instances: Pair[Instances], proxy: Pair[IntArray], matches: Matches, pairs: IntArray) -> IntArray:
    """Unmatched instances of one class that are the largest of it in a matched pair of proxies, (p, 2)."""
    found = []
    taken = Pair(set(pairs[:, 0].tolist()), set(pairs[:, 1].tolist()))
    largest = instances.join(proxy, _largest_by_proxy_and_class)
    for before_proxy, after_proxy in zip(matches.before_idx.tolist(), matches.after_idx.tolist(), strict=True):
        for code in OBJECT_CLASSES:
            i = largest.before.get((before_proxy + 1, int(code)))
            j = largest.after.get((after_proxy + 1, int(code)))
            if i is not None and j is not None and i not in taken.before and j not in taken.after:
                found.append((i, j))
                taken.before.add(i)
                taken.after.add(j)
    return np.array(found, dtype=np.int32).reshape(-1, 2)


def _is_with_another(own: IntArray, other: IntArray, votes: Pair[_Votes]) -> BoolArray:
    """Whether the instances ``own`` (p,) of one epoch take the same space as an instance of the other epoch that is not
    ``other`` (p,): of two vans in one proxy each epoch may call another one a vehicle."""
    host = votes.before.partner[own]
    is_mutual = (host >= 0) & (votes.before.support[own] >= _MIN_SHARED)
    is_mutual &= (votes.after.partner[host] == own) & (votes.after.support[host] >= _MIN_SHARED)
    return np.asarray(is_mutual & (host != other))


def _largest_by_proxy_and_class(instances: Instances, proxy: IntArray) -> dict[tuple[int, int], int]:
    """Instance (0-based) with most voxels for each (proxy, class); ties: lowest."""
    is_member = (instances.instance > 0) & (proxy > 0)
    key = proxy[is_member].astype(np.int64) * len(instances) + instances.instance[is_member] - 1
    key, count = np.unique(key, return_counts=True)
    best: dict[tuple[int, int], tuple[int, int]] = {}
    owner_of, index_of = np.divmod(key, max(len(instances), 1))
    for owner, index, n in zip(owner_of.tolist(), index_of.tolist(), count.tolist(), strict=True):
        slot = (owner, int(instances.object_class[index]))
        if slot not in best or n > best[slot][0]:
            best[slot] = (n, index)
    return {slot: index for slot, (_, index) in best.items()}


def _shared_space(
    xyz: FloatArray, instance: IntArray, n: int, other_xyz: FloatArray, other: IntArray, reach_m: float
) -> _Votes:
    """Votes of the points of instances 1 to ``n`` for those of the other epoch."""
    support, partner, nearest_of = np.zeros(n), np.full(n, -1, np.int32), np.full(len(xyz), -1, np.int32)
    if len(xyz) == 0 or len(other_xyz) == 0:
        return _Votes(support, partner, nearest_of)
    found, _ = nearest(other_xyz, xyz, reach_m)
    own = instance - 1
    points = np.maximum(np.bincount(own, minlength=n), 1)
    is_near = found >= 0
    support = np.bincount(own[is_near], minlength=n) / points
    nearest_of[is_near] = theirs = other[found[is_near]] - 1
    voter, favourite, _ = favourites(own[is_near], theirs)
    partner[voter] = favourite
    return _Votes(support, partner, nearest_of)


def _left_over(votes: _Votes, matched: IntArray) -> IntArray:
    """Unmatched instances most of whose surface the other epoch's instances show too."""
    is_free = np.ones(len(votes.support), np.bool_)
    is_free[matched] = False
    return np.flatnonzero(is_free & (votes.support >= _MIN_SHARED) & (votes.partner >= 0)).astype(np.int32)


def _stands_apart(left: IntArray, votes: Pair[_Votes], kinds: Pair[ByteArray]) -> BoolArray:
    """Which of the instances left over are things of their own, merged with something else in the other epoch.

    Not those of the same kind as the instance that occupies their space (crowns and houses are taken apart at will),
    and not those that occupy each other's space: they are one thing with two names.
    """
    host = votes.before.partner[left]
    is_mutual = (votes.after.partner[host] == left) & (votes.after.support[host] >= _MIN_SHARED)
    kind, of_host = kinds.before[left], kinds.after[host]
    is_same = (kind == of_host) & np.isin(kind, (ObjectClass.BUILDING, ObjectClass.VEGETATION))
    return np.asarray(~is_same & ~is_mutual)


def _owners(instances: Instances, of_instance: Pair[IntArray], votes: Pair[_Votes], apart: IntArray) -> IntArray:
    """Object (m,) of each voxel, -1 none: that of its instance, or of the thing that the other epoch shows ``apart``.

    ``of_instance`` and ``votes`` are of this epoch and the other.
    """
    table = np.concatenate([np.array([-1], dtype=np.int32), of_instance.before])
    owner = table[instances.instance].astype(np.int32)
    member = np.flatnonzero(instances.instance > 0)
    host = np.full(len(of_instance.after) + 1, -1, dtype=np.int32)
    host[apart] = votes.after.partner[apart]
    nearest_of = votes.before.nearest[: len(member)]
    is_given = (nearest_of >= 0) & (host[nearest_of] == instances.instance[member] - 1)
    owner[member[is_given]] = of_instance.after[nearest_of[is_given]]
    return owner


def _numbered(
    xyz: Pair[FloatArray],
    instances: Pair[Instances],
    of_instance: Pair[IntArray],
    owner: Pair[IntArray],
    pairs: IntArray,
    votes: Pair[_Votes],
    *,
    has_sides: bool,
) -> Objects:
    n = max((int(side.max()) + 1 for side in of_instance if len(side)), default=0)
    rank = rank_by_place(xyz, owner, n)
    of_instance = of_instance.map(lambda side: rank[side])
    voxels = of_instance.join(instances, lambda side, own: _voxels_per_class(side, own, n))
    both = voxels.before + voxels.after
    if not has_sides:  # of a van from above one survey met the bonnet, and to the other it is what is left
        mobile, other = (OBJECT_CLASSES.index(kind) for kind in (ObjectClass.MOBILE, ObjectClass.OTHER))
        both[:, mobile] += np.where(both[:, mobile] > 0, both[:, other], 0.0)
    object_class = _most_common_class(both)
    if has_sides:  # a lorry in the slot of a van is as large as a building, but no van grew into one
        before, after = voxels.map(_most_common_class)
        is_vehicle = (before == ObjectClass.MOBILE) & (after == ObjectClass.BUILDING)
        is_vehicle |= (before == ObjectClass.BUILDING) & (after == ObjectClass.MOBILE)
        object_class = np.where(is_vehicle, np.uint8(ObjectClass.MOBILE), object_class)
    owner = owner.map(lambda side: np.append(rank, np.int32(-1))[side])
    return Objects(of_instance, object_class, pairs, votes.map(lambda side: side.support), owner)


def _voxels_per_class(of_instance: IntArray, instances: Instances, n: int) -> FloatArray:
    """Fused points (n, classes) of each object in one epoch, by the class of their instances."""
    voxels = np.bincount(instances.instance, minlength=len(instances) + 1)[1:]
    is_of_class = instances.object_class[:, None] == np.array(OBJECT_CLASSES)
    return Groups(of_instance, n).sum(voxels[:, None] * is_of_class)


def _most_common_class(voxels: FloatArray) -> ByteArray:
    """The class (n,) of most of each object's fused points (n, classes), the first of `OBJECT_CLASSES` at a tie."""
    return np.asarray(np.array(OBJECT_CLASSES, dtype=np.uint8)[np.argmax(voxels, axis=1)])


def rank_by_place(xyz: Pair[FloatArray], owner: Pair[IntArray], n: int) -> IntArray:
    """Numbers (n,) for objects by their lowest corner over both epochs, x first, so that epochs may change places."""
    before, after = xyz.join(owner, lambda points, side: Groups(side, n).minimum(points))
    low = np.fmin(before, after)
    rank = np.empty(n, dtype=np.int32)
    rank[np.lexsort((low[:, 2], low[:, 1], low[:, 0]))] = np.arange(n, dtype=np.int32)
    return rank
