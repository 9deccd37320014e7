"""The orientation curve of a run, and the exact one of its fibers if they never touched.

Weightings: `length` counts segments by their length (that is volume, what tomography sees; columns
a11 ...), `number` one vote per fiber by its end-to-end vector (columns a11_fiber ...).
Symbols: A orientation tensor, r_W = sum n L r_f / sum n L aspect ratio weighted by length, lambda
    shape factor of Jeffery's motion (of the model's own fiber: a line of touching beads).
Limits: linear flows of one direction; lambda is that of straight fibers. The exact curve begins
    with the directions of the first frame, or, without a trajectory, with the first tensor and an
    angular central Gaussian distribution that is the same for all lengths.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from warpfiber.output.folder import ResultFolder
from warpfiber.output.scalars import read_scalars
from warpfiber.output.trajectory import TrajectoryReader
from warpfiber.placement.without_contact import (
    direction_tensors,
    population_tensors,
    shape_factor,
)
from warpfiber.scene import Fault, FiberGroup, Scene, SceneError, scene_from_dict
from warpfiber.scene.derived import effective_stiffness, equivalent_aspect_ratio

Floats = NDArray[np.float64]
WEIGHTINGS = ("length", "number")
STIFF = 1.0
"""S_eff from which a fiber in shear stays straight: the threshold of buckling is 0.04."""
INDEX = {"a11": (0, 0), "a22": (1, 1), "a33": (2, 2), "a12": (0, 1), "a13": (0, 2), "a23": (1, 2)}
"""Where the columns of a table stand in A."""


@dataclass(frozen=True)
class OrientationCurve:
    """A of a run at rising strains."""

    strain: Floats
    """(T,)"""
    tensor: Floats
    """(T, 3, 3)"""
    weighting: str
    """length, number"""
    gradient: Floats
    """L_ij = du_i/dx_j per unit of strain, (3, 3)"""
    aspect_ratio: float
    """r_W"""
    shape_factor: float
    """lambda of r_W"""


def read_curve(folder: ResultFolder, weighting: str = "length") -> OrientationCurve:
    """The curve of a run; raises SceneError if it has none, RecordError if it is damaged."""
    scene = _scene_of(folder)
    gradient = _gradient(folder, scene)
    table = read_scalars(folder.scalars_path) if folder.scalars_path.exists() else {}
    names = _columns(weighting)
    if not set(names) <= set(table):
        remedy = 'this run recorded no orientation; run it with "orientation" in record.quantities'
        raise _fault(folder, remedy)
    tensor = np.zeros((len(table["strain"]), 3, 3))
    for name, (i, j) in zip(names, INDEX.values(), strict=True):
        tensor[:, i, j] = tensor[:, j, i] = table[name]
    known = np.isfinite(tensor).all(axis=(1, 2))
    strain = table["strain"].astype(np.float64)[known]
    tensor = tensor[known]
    _, first = np.unique(strain, return_index=True)
    if np.any(np.diff(strain) < 0.0):
        raise _fault(folder, "its strain goes back and forth; a curve needs one that rises")
    length = np.array([group.count * group.length for group in scene.fibers])
    ratio = float(length @ [group.aspect_ratio for group in scene.fibers] / length.sum())
    factor = _factor_of(scene, scene.fibers[0], ratio)
    return OrientationCurve(strain[first], tensor[first], weighting, gradient, ratio, factor)


def exact_orientation(
    folder: ResultFolder | str, strain: ArrayLike, weighting: str = "length"
) -> Floats:
    """A (T, 3, 3) of a run's fibers at strains (T,) had they been rigid and never touched.

    Raises SceneError if the flow of the run is no linear one, RecordError on damage.
    """
    folder = folder if isinstance(folder, ResultFolder) else ResultFolder.open(folder)
    scene = _scene_of(folder)
    gradient, factor = _gradient(folder, scene), _factors(scene)
    own = np.array([g.centerline_length if weighting == "length" else 1.0 for g in scene.fibers])
    strains = np.atleast_1d(np.asarray(strain, dtype=np.float64))
    if folder.trajectory_path.exists():
        with TrajectoryReader(folder.trajectory_path) as reader:
            if reader.frame_count:
                member, axis = reader.fiber_group, reader.fiber_axis(0).astype(np.float64)
                since = strains - reader.strain[0]
                return direction_tensors(axis, gradient, factor[member], own[member], since)
    curve = read_curve(folder, weighting)
    share = own * [group.count for group in scene.fibers]
    since = strains - curve.strain[0]
    return population_tensors(curve.tensor[0], gradient, factor, share, since)


def exact_table(folder: ResultFolder, points: int = 31) -> dict[str, NDArray[Any]]:
    """Columns `strain`, `a11` ... `a23`, `a11_fiber` ... of the exact curve over a run."""
    recorded = read_curve(folder).strain
    strains = np.linspace(float(recorded[0]), float(recorded[-1]), points)
    table: dict[str, NDArray[Any]] = {"strain": strains}
    for weighting in WEIGHTINGS:
        tensor = exact_orientation(folder, strains, weighting)
        for name, (i, j) in zip(_columns(weighting), INDEX.values(), strict=True):
            table[name] = tensor[:, i, j]
    return table


def exact_without_contact(tables: Mapping[str, Any]) -> bool:
    """Whether the exact curve is that of a recorded scene: simple shear, stiff fibers apart."""
    contact, flow = tables.get("contact") or {}, tables.get("flow") or {}
    if contact.get("law") != "none" or flow.get("kind") != "simple_shear":
        return False
    scene = scene_from_dict(tables)
    if scene.contact.lubrication != "none":
        return False
    stiff = (effective_stiffness(scene, group) or 0.0 for group in scene.fibers)
    return scene.numerics.method == "rigid_rod" or min(stiff, default=0.0) >= STIFF


def _columns(weighting: str) -> list[str]:
    return [name if weighting == "length" else f"{name}_fiber" for name in INDEX]


def _scene_of(folder: ResultFolder) -> Scene:
    tables = folder.read_scene()
    if not tables:
        raise _fault(folder, "no scene.json in it; name the folder of a run")
    return scene_from_dict(tables)


def _fault(folder: ResultFolder, remedy: str) -> SceneError:
    return SceneError([Fault("command line", "RESULT", str(folder.path), remedy)])


def _gradient(folder: ResultFolder, scene: Scene) -> Floats:
    flow = scene.flow
    gradient = None if flow is None else flow.velocity_gradient
    if flow is None or gradient is None or flow.rate == 0.0:
        raise _fault(folder, "needs the strain of a linear flow; this run has none")
    return np.array(gradient, dtype=np.float64) / flow.rate


def _factors(scene: Scene) -> Floats:
    """lambda of all groups, (K,)."""
    return np.array([_factor_of(scene, group, group.aspect_ratio) for group in scene.fibers])


def _factor_of(scene: Scene, group: FiberGroup, aspect_ratio: float) -> float:
    long = dataclasses.replace(group, aspect_ratio=aspect_ratio)
    return float(shape_factor(equivalent_aspect_ratio(scene, long) or 1.0))
