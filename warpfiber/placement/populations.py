"""Fibers of one table that differ in length, or lie in layers: drawn, packed, and measured.

All fibers of a table are drawn together, put in where they are drawn, and pushed apart as chains of
the run's own segments. Small overlaps stay: up to DEPTH radii, which the first contacts remove.

Symbols: L length tip to tip (m), L_N, L_W its averages, a_ij orientation tensor.
Limits: boxes only; centers are random. Directions and centers change a little in packing: the
    report has the tensors of the drawn and of the packed fibers, by length and by number.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from warpfiber.placement.capsules import Capsules, Floats, Ints
from warpfiber.placement.chains import Chains, Outcome, relax_chains
from warpfiber.placement.groups import asked_tensor
from warpfiber.placement.layers import Drawn, Stack, draw_fibers
from warpfiber.placement.lengths import averages
from warpfiber.placement.orientations import orientation_tensor, values_from_tensor
from warpfiber.placement.parts import table_law
from warpfiber.placement.slices import largest_a33, layer_averages, slices, votes
from warpfiber.placement.space import Cell
from warpfiber.placement.wedged import are_wedged
from warpfiber.scene import Fault, FiberGroup, Scene, SceneError

DEPTH = 0.05
"""Deepest overlap that is left, radii."""
SWEEPS = 3000
"""Most sweeps of the relaxation."""
MISSED = 0.01
"""Difference of a tensor component, and relative one of a volume fraction, that is told."""


@dataclass
class Population:
    """The fibers of one table while they are placed."""

    table: int
    groups: list[tuple[int, FiberGroup]]
    """number in the scene, and group, shortest fibers first"""
    cell: Cell
    stack: Stack
    seed: int
    chains: list[Floats] = field(default_factory=list)
    """nodes of each fiber, m, (n_f, 3)"""

    def __post_init__(self) -> None:
        count = [group.count for _, group in self.groups]
        self.member = np.repeat([index for index, _ in self.groups], count)
        self.half = np.repeat([0.5 * group.centerline_length for _, group in self.groups], count)
        self.segments = np.repeat([group.segments for _, group in self.groups], count)
        self.length = np.repeat([group.length for _, group in self.groups], count)
        self.radius = self.groups[0][1].radius
        order = np.argsort(self.half, kind="stable")
        drawn = draw_fibers(self.stack, self.half[order], self.radius, self.cell, self.seed)
        back = np.argsort(order)
        self.stuck = None if drawn.stuck is None else order[drawn.stuck]
        self.drawn = Drawn(
            drawn.direction[back],
            drawn.center[back],
            drawn.layer[back],
            drawn.redrawn,
            drawn.mirrored,
        )

    def straight(self) -> list[Floats]:
        """Nodes of the fibers as drawn."""
        made = []
        for f, segments in enumerate(self.segments):
            along = (2.0 * np.arange(segments + 1) / segments - 1.0) * self.half[f]
            made.append(self.drawn.center[f] + along[:, None] * self.drawn.direction[f])
        return made


def populations(scene: Scene, cell: Cell, rng: np.random.Generator) -> list[Population]:
    """The populations of a scene whose tables are split; raises SceneError with all faults."""
    made: list[Population] = []
    faults: list[Fault] = []
    tables = dict.fromkeys(g.table for g in scene.fibers if g.table is not None)
    for table in tables:
        groups = [(k, g) for k, g in enumerate(scene.fibers) if g.table == table]
        try:
            stack = stack_of(scene, table, groups[0][1])
        except SceneError as error:
            faults += error.faults
            continue
        population = Population(table, groups, cell, stack, int(rng.integers(2**31)))
        if population.stuck is not None:
            f = int(population.stuck[-1])
            k = int(population.drawn.layer[f])
            long, key = float(population.length[f]), "orientation"
            what = "between the walls"
            if groups[0][1].layers:
                thick = stack.edges[k + 1] - stack.edges[k]
                key, what = "layers", f"in layer {k} ({thick:.4g} m thick)"
            remedy = f"no direction of its tensor fits a fiber of {long:.4g} m {what}"
            remedy += "; make the layer thicker, the tensor flatter or the fibers shorter"
            faults.append(Fault(scene.path, f"fibers.{table}.{key}", None, remedy))
        made.append(population)
    if faults:
        raise SceneError(faults)
    return made


def stack_of(scene: Scene, table: int, group: FiberGroup) -> Stack:
    """The layers of a table; without layers the whole box is one."""
    assert scene.box is not None
    height = scene.box.size[2]
    key = f"fibers.{table}.orientation"
    mirror = shear_sign(scene) if group.wedged == "mirror" else 0.0
    try:
        if group.layers is None:
            fraction = np.array([group.volume_fraction or 0.0])
            return Stack(
                np.array([0.0, height]),
                np.ones(1),
                fraction,
                asked_tensor(group.orientation, group.direction)[None],
                False,
                group.orientation_law,
                mirror,
            )
        tensor = []
        for k, layer in enumerate(group.layers):
            key = f"fibers.{table}.layers.{k}.orientation"
            tensor.append(asked_tensor(layer.orientation, layer.direction))
    except ValueError as error:
        raise SceneError(Fault(scene.path, key, group.orientation, str(error))) from error
    thickness = np.array([layer.thickness for layer in group.layers])
    fraction = np.array([layer.volume_fraction for layer in group.layers])
    edges = np.append(0.0, np.cumsum(thickness))
    edges *= height / edges[-1]
    share = thickness * fraction
    inside = group.layer_mode == "inside"
    law = group.orientation_law
    return Stack(edges, share / share.sum(), fraction, np.array(tensor), inside, law, mirror)


def shear_sign(scene: Scene) -> float:
    """1 or -1 in a simple shear between walls of z, 0 in all else."""
    if scene.flow is None or scene.flow.kind != "simple_shear" or scene.box is None:
        return 0.0
    gradient = scene.flow.velocity_gradient
    assert gradient is not None
    return float(np.sign(gradient[0][2])) if scene.box.boundary[2] == "wall" else 0.0


def pack(
    scene: Scene, cell: Cell, crowd: list[Population], held: list[Capsules]
) -> tuple[Outcome, Floats]:
    """Pushes all populations apart, and off what is held; the outcome and all bending strains.

    Raises SceneError if they jam.
    """
    nodes = [chain for population in crowd for chain in population.straight()]
    count = len(nodes)
    radius = [np.full(len(population.half), population.radius) for population in crowd]
    for capsules in held:
        arm = capsules.half[:, None] * capsules.direction
        nodes += list(np.stack([capsules.center - arm, capsules.center + arm], axis=1))
        radius.append(capsules.radius)
    start = np.cumsum([0] + [len(chain) for chain in nodes])
    chains = Chains(
        np.concatenate(nodes), start, np.concatenate(radius), np.arange(len(nodes)) < count
    )
    outcome = Outcome(True, 0, 0.0, (0, 0))
    if scene.contact.law != "none":
        outcome = relax_chains(chains, cell, SWEEPS, DEPTH)
    if not outcome.clear:
        raise _jammed(scene, crowd, chains, outcome)
    first = 0
    for population in crowd:
        for _ in population.half:
            population.chains.append(chains.node_pos[start[first] : start[first + 1]])
            first += 1
    return outcome, chains.bending_strains()


def _jammed(scene: Scene, crowd: list[Population], chains: Chains, outcome: Outcome) -> SceneError:
    """The fault that names the worst pair and what to change."""
    table = crowd[-1].table
    group = crowd[-1].groups[0][1]
    key = next(
        (name for name in ("layers", "volume_fraction") if getattr(group, name) is not None),
        "count",
    )
    i, j = outcome.worst
    z = float(np.mean(chains.node_pos[chains.start[i] : chains.start[i + 1], 2]))
    long = [float(np.sum(chains.rest[chains.owner == f])) for f in (i, j)]
    if j < 0:
        pair = f"fiber {i} ({long[0]:.4g} m) is pressed into a wall"
    else:
        pair = f"fibers {i} and {j} ({long[0]:.4g} and {long[1]:.4g} m, at z = {z:.4g} m) overlap"
        pair += f" by {outcome.depth:.3g} radii"
    remedy = (
        f"the fibers jam after {outcome.sweeps} sweeps: {pair}, {DEPTH} radii are allowed; take a "
        "smaller volume fraction, shorter segments (numerics.segment_length) or shorter fibers"
    )
    value = getattr(group, key) if key != "layers" else None
    return SceneError(Fault(scene.path, f"fibers.{table}.{key}", value, remedy))


def population_report(scene: Scene, population: Population, strains: Floats) -> dict[str, Any]:
    """What was asked and what was reached, JSON-ready; lengths in m, tensors of six numbers."""
    stack, asked = population.stack, population.groups[0][1]
    assert scene.box is not None
    nodes = population.chains
    tips = np.array([chain[-1] - chain[0] for chain in nodes])
    tips /= np.linalg.norm(tips, axis=1)[:, None]
    first = np.concatenate([chain[:-1] for chain in nodes])
    last = np.concatenate([chain[1:] for chain in nodes])
    whole = slices(first, last, stack.edges[[0, -1]])
    cut = slices(first, last, stack.edges)
    middle = np.array([chain[:, 2].mean() for chain in nodes])
    home: Ints = np.clip(np.searchsorted(stack.edges, middle) - 1, 0, len(stack) - 1)
    by_number = votes(tips, home, len(stack))
    mean = layer_averages(population.length, home, len(stack))
    volume = sum(g.volume_fraction_achieved or 0.0 for _, g in population.groups)
    fraction = volume * cut.length / cut.length.sum() * stack.edges[-1] / np.diff(stack.edges)
    l_n, l_w = averages(population.length)
    # who has to fit where: a fiber that spans layers only has to fit between the walls
    gap = np.diff(stack.edges) if stack.inside else np.full(len(stack), stack.edges[-1])
    if not (stack.inside or population.cell.wall[2]):
        gap = np.full(len(stack), np.inf)
    between = float(scene.box.size[2]) - 2.0 * population.radius
    wedged = int(np.sum(are_wedged(tips, population.half, between, shear_sign(scene))))
    steepest = []
    for k in range(len(stack)):
        mine = population.length[home == k] if stack.inside else population.length
        steepest.append(largest_a33(mine, 2.0 * population.radius, float(gap[k])))
    report: dict[str, Any] = {
        "table": population.table,
        "groups": len(population.groups),
        "count": len(nodes),
        "volume_fraction": {"asked": asked.volume_fraction, "achieved": volume},
        "number_average_length": {"asked": None, "achieved": l_n},
        "weight_average_length": {"asked": None, "achieved": l_w},
        "orientation": {
            "asked": values_from_tensor(np.einsum("k,kij->ij", stack.share, stack.tensor)),
            "drawn_by_number": values_from_tensor(orientation_tensor(population.drawn.direction)),
            "by_length": values_from_tensor(whole.tensor[0]),
            "by_number": values_from_tensor(orientation_tensor(tips)),
        },
        "directions_redrawn": population.drawn.redrawn,
        "directions_mirrored": population.drawn.mirrored,
        "wedged": wedged,
        "bending_strain": {
            "maximum": float(strains.max(initial=0.0)),
            "mean": float(strains.mean()) if len(strains) else 0.0,
        },
    }
    if asked.length_distribution is not None:
        law = table_law(scene, population.table, asked)
        report["number_average_length"]["asked"] = law.number_average
        report["weight_average_length"]["asked"] = law.weight_average
    if asked.layers is not None:
        report["layer_mode"] = asked.layer_mode
        report["layers"] = [
            {
                "volume_fraction": {"asked": float(stack.fraction[k]), "achieved": fraction[k]},
                "orientation": {
                    "asked": values_from_tensor(stack.tensor[k]),
                    "by_length": values_from_tensor(cut.tensor[k]),
                    "by_number": values_from_tensor(by_number[k]),
                },
                "number_average_length": mean[k][0],
                "weight_average_length": mean[k][1],
                "largest_a33": {"by_number": steepest[k][0], "by_length": steepest[k][1]},
            }
            for k in range(len(stack))
        ]
    report["missed"] = _missed(stack, by_number if stack.inside else cut.tensor, fraction, volume)
    report["missed"] += _beyond_reach(stack, [pair[0 if stack.inside else 1] for pair in steepest])
    if wedged and scene.numerics.method == "rigid_rod":
        line = (
            f"{wedged} straight fibers are too long to turn between the walls; wedged there they "
            'may hold up all others: fibers.wedged = "mirror" lays them to the other side'
        )
        report["missed"].append(line)
        warnings.warn(line, RuntimeWarning, stacklevel=2)
    return report


def _beyond_reach(stack: Stack, most: list[float]) -> list[str]:
    """Layers that ask for steeper fibers than fit, one line each; `most`: their largest a33."""
    lines = []
    for k, (tensor, largest) in enumerate(zip(stack.tensor, most, strict=True)):
        if tensor[2, 2] > largest:
            name = f"layer {k}: " if len(stack) > 1 else ""
            lines.append(
                f"{name}a33 = {tensor[2, 2]:.4f} cannot be reached: straight fibers of these "
                f"lengths fit with at most {largest:.4f}"
            )
    return lines


def _missed(stack: Stack, tensor: Floats, fraction: Floats, volume: float) -> list[str]:
    """What differs from what was asked, one line each; tensors as the layer mode counts them."""
    lines = []
    for k in range(len(stack)):
        name = f"layer {k}: " if len(stack) > 1 else ""
        pairs = zip(values_from_tensor(stack.tensor[k]), values_from_tensor(tensor[k]), strict=True)
        for component, (want, got) in zip(("11", "22", "33", "12", "13", "23"), pairs, strict=True):
            if abs(got - want) > MISSED:
                lines.append(f"{name}a{component} is {got:.4f}, not {want:.4f}")
        want = float(stack.fraction[k])
        if len(stack) > 1 and want and abs(fraction[k] / want - 1.0) > MISSED:
            lines.append(f"{name}volume fraction is {fraction[k]:.4f}, not {want:.4f}")
    want = float(stack.share @ stack.fraction) if len(stack) == 1 else 0.0
    if want and abs(volume / want - 1.0) > MISSED:
        lines.append(f"volume fraction is {volume:.4f}, not {want:.4f}")
    return lines
