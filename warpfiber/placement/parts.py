"""Splits a fiber table with a length distribution into groups of one length each.

A group has one number of segments and one rest length, so lengths are gathered into bins that are
narrower than the changes of the segment number, 1 % of the longest fiber and 14 % of their own
length: some hundred groups. Each group takes the mean length of its bin, which keeps L_N and the
volume exactly and lowers L_W by the spread inside the bins (about 1e-4).

Symbols: L length tip to tip (m), d diameter (m).
Limits: fibers of one bin are equally long.
"""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from warpfiber.placement.cells import Floats
from warpfiber.placement.lengths import LengthLaw, length_law
from warpfiber.scene import Fault, FiberGroup, Scene, SceneError
from warpfiber.scene.derived import fiber_volume

FINE = 0.01
"""Widest bin over the longest length."""
NARROW = 0.14
"""Widest bin over its lower edge."""


def split_tables(scene: Scene) -> Scene:
    """The scene with one group per length; scenes without distributions and layers as they are.

    Groups of one table know its number, the first of them also what the table asked for.
    """
    groups: list[FiberGroup] = []
    faults: list[Fault] = []
    place: list[int] = []
    for index, group in enumerate(scene.fibers):
        place.append(len(groups))
        if group.table is not None or (group.length_distribution is None and not group.layers):
            groups.append(group)
        elif group.length_distribution is None:
            groups.append(dataclasses.replace(group, table=index))
        else:
            try:
                groups += _split(scene, index, group)
            except SceneError as error:
                faults += error.faults
    for row, load in enumerate(scene.loads):
        if scene.fibers[load.group].length_distribution and scene.fibers[load.group].table is None:
            remedy = "its fibers differ in length; load a table of fibers of one length"
            faults.append(Fault(scene.path, f"load.{row}.group", load.group, remedy))
    if faults:
        raise SceneError(faults)
    loads = tuple(dataclasses.replace(load, group=place[load.group]) for load in scene.loads)
    return dataclasses.replace(scene, fibers=tuple(groups), loads=loads)


def table_law(scene: Scene, index: int, group: FiberGroup) -> LengthLaw:
    """The law of lengths of one table; raises SceneError."""
    asked = group.length_distribution
    assert asked is not None
    try:
        return length_law(asked, asked.minimum, asked.maximum)
    except ValueError as error:
        key = f"fibers.{index}.length_distribution"
        value = asked.weight_average if asked.histogram is None else None
        key += ".histogram" if asked.histogram is not None else ".weight_average"
        remedy = f"{error}; change the averages, the limits or kind"
        raise SceneError(Fault(scene.path, key, value, remedy)) from error


def _split(scene: Scene, index: int, group: FiberGroup) -> list[FiberGroup]:
    asked, box = group.length_distribution, scene.box
    assert asked is not None and box is not None
    law = table_law(scene, index, group)
    volume = fiber_volume(box.volume_rule, group.diameter, law.number_average) / box.volume
    count = group.count or max(1, round((group.volume_fraction or 0.0) / volume))
    if count > 2**31 - 1:
        key = "layers" if group.layers else "volume_fraction"
        remedy = "too many fibers for the box; check powers of ten"
        raise SceneError(Fault(scene.path, f"fibers.{index}.{key}", group.volume_fraction, remedy))
    length = law.sample(count)
    edges, segments = _bins(scene, index, group, asked.minimum, asked.maximum)
    home = np.clip(np.searchsorted(edges, length, side="right") - 1, 0, len(segments) - 1)
    made: list[FiberGroup] = []
    for k in np.unique(home):
        mean = float(length[home == k].mean())
        share = fiber_volume(box.volume_rule, group.diameter, mean) / box.volume
        number = int(np.sum(home == k))
        part = dataclasses.replace(
            group,
            count=number,
            volume_fraction_achieved=number * share,
            length=mean,
            aspect_ratio=mean / group.diameter,
            centerline_length=mean - group.diameter,
            segments=int(segments[k]),
            table=index,
        )
        if made:
            part = dataclasses.replace(
                part, length_distribution=None, layers=None, layer_mode=None, volume_fraction=None
            )
        made.append(part)
    return made


def _bins(
    scene: Scene, index: int, group: FiberGroup, shortest: float, longest: float
) -> tuple[Floats, Floats]:
    """Edges of the bins in m, (n + 1,), and the segments of a fiber of each, (n,)."""
    d, numerics = group.diameter, scene.numerics
    asked = numerics.segments
    number = asked[index] if isinstance(asked, tuple) else asked
    if number is not None:
        if number * d > (shortest - d) * (1.0 + 1e-9):
            remedy = f"too many for the shortest of fibers.{index}, {shortest:.4g} m; "
            remedy += "give segment_length, or a longer minimum"
            raise SceneError(Fault(scene.path, "numerics.segments", asked, remedy))
        unit = math.inf
    else:
        reduced = numerics.reduced_beads
        beads = reduced[index] if isinstance(reduced, tuple) else reduced
        given = numerics.segment_length
        unit = given[index] if isinstance(given, tuple) else given or 0.0
        unit = d * (beads + 1.0) if beads is not None else unit
        if unit < d * (1.0 - 1e-9):
            remedy = f"shorter than the diameter of fibers.{index}; give at least {d:.4g}"
            raise SceneError(Fault(scene.path, "numerics.segment_length", unit, remedy))
    changes = np.zeros(0)
    if math.isfinite(unit):
        changes = d + unit * np.arange(1.5, longest / unit + 1.0)
    inner = changes[(changes > shortest) & (changes < longest)]
    edges = [shortest]
    for end in [*inner, longest]:
        while edges[-1] < end * (1.0 - 1e-12):
            start = edges[-1]
            width = min(FINE * longest, NARROW * start)
            pieces = max(1, math.ceil((end - start) / width - 1e-6))
            edges.append(float(end) if pieces == 1 else start + min(width, (end - start) / pieces))
    middle = 0.5 * (np.array(edges[1:]) + np.array(edges[:-1]))
    if number is not None:
        return np.array(edges), np.full(len(middle), number, dtype=np.float64)
    most = np.maximum(1.0, np.floor((np.array(edges[:-1]) / d - 1.0) * (1.0 + 1e-9)))
    return np.array(edges), np.clip(np.floor((middle - d) / unit + 0.5), 1.0, most)
