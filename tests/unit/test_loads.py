"""Forces on nodes, held nodes and frozen fibers of fibers without inertia.

Steps against their float64 restatement, 1e-12 of the largest value: rounding of an elimination of
well conditioned blocks.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, place, straight_fiber
from tests.reference import loads as restated
from tests.reference import overdamped as od
from tests.reference.bead_chain import Array
from tests.unit.test_responses import Chains, Response, random_rows
from warpfiber.scene import SceneError, scene_from_dict
from warpfiber.scene.tables import strain_rate
from warpfiber.simulation import Simulation

Start = Callable[..., Simulation]
ROUGH = np.array([[0.1, 0.2, 1.0], [-0.3, 0.05, 0.1], [0.2, 0.0, -0.15]])
GRADIENT = ROUGH / strain_rate(tuple(map(tuple, ROUGH)))  # rate 1: the run's units are SI
FLOW = {"kind": "gradient", "viscosity": 1.0, "gradient": GRADIENT.tolist()}
REST = {"kind": "rest", "viscosity": 1.0}
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
FORCE, OTHER, SPEED = [3.0, -2.0, 4.0], [-30.0, 0.0, 10.0], [0.2, -0.1, 0.3]
LOADS: dict[str, list[dict[str, Any]]] = {
    "forces": [{"node": 2, "force": FORCE}, {"force": OTHER}],
    "first held": [{"node": 0, "hold": "position"}, {"force": FORCE}],
    "last moved": [{"hold": "position", "velocity": SPEED}, {"node": 0, "force": FORCE}],
    "clamped": [{"node": 0, "hold": "clamp"}, {"force": OTHER}],
    "clamp at the end": [{"hold": "clamp", "velocity": SPEED}],
    "held inside": [{"node": 3, "hold": "position", "velocity": SPEED}],
    "clamped inside": [{"node": 2, "hold": "clamp"}, {"force": FORCE}],
    "two held": [{"node": 1, "hold": "position"}, {"node": 4, "hold": "position"}],
}
BOTH_ENDS = ("two held", "inextensible")
HELD = {
    "first held": ([0], 0.0),
    "last moved": ([-1], 1.0),
    "clamped": ([0, 1], 0.0),
    "clamp at the end": ([-2, -1], 1.0),
    "held inside": ([3], 1.0),
    "clamped inside": ([2, 3], 0.0),
    "two held": ([1, 4], 0.0),
}


def loaded(start: Start, kinds: list[Kind], fibers: list[Array], **keys: Any) -> Simulation:
    """Simulation of one fiber per kind; `numerics` are added to."""
    numerics = {"method": "overdamped", "dt": 0.05, **keys.pop("numerics", {})}
    which = list(range(len(kinds)))
    return start(kinds, fibers, which, numerics=numerics, **{"flow": FLOW, **keys})


def restated_loads(name: str, nodes: int) -> restated.Loads:
    """The same loads by node."""
    force, velocity = np.zeros((nodes, 3)), np.zeros((nodes, 3))
    held = np.zeros(nodes, dtype=bool)
    for row in LOADS[name]:
        if "force" in row:
            force[row.get("node", -1)] = row["force"]
    where, share = HELD.get(name, ([], 0.0))
    held[where] = True
    velocity[where] = share * np.array(SPEED)
    return restated.Loads(force, held, velocity)


@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2"])
@pytest.mark.parametrize(
    ("name", "form"),
    # two held nodes of a straight fiber that cannot stretch are refused
    [(n, f) for n in LOADS for f in ("compliant", "inextensible") if (n, f) != BOTH_ENDS],
)
def test_one_step(start: Start, name: str, form: str, scheme: str) -> None:
    """A fiber without loads and one with them."""
    rng = np.random.default_rng(5)
    kinds = [Kind(4, 3.0), Kind(6, 2.71)]
    fibers = [bent_fiber(kind, rng, stretch=0.002) for kind in kinds]
    sim = loaded(
        start,
        kinds,
        fibers,
        load=[{"group": 1, **row} for row in LOADS[name]],
        groups={"inextensible": form == "inextensible"},
        numerics={"integrator": scheme},
    )
    nodes, segments = sim.model.node_count, sim.model.segment_count
    drift, motion = rng.normal(size=(nodes, 3)), 0.05 * rng.normal(size=(nodes, 3))
    tension, before = 3.0 * rng.normal(size=(2, segments))
    sim.state.node_velocity.assign(drift)
    sim.method.node_motion.assign(motion)
    sim.method.tension.assign(tension)
    sim.method.tension_back.assign(before)
    sim.state.step.assign([1])
    sim.step()
    for f, begin in enumerate(sim.fiber_node_start[:2]):
        x = fibers[f]
        mine = slice(begin, begin + len(x))
        parts = slice(begin - f, begin - f + kinds[f].segments)
        which = restated_loads(name if f else "none", len(x)) if f else None
        loads = which or restated.Loads(np.zeros_like(x), np.zeros(len(x), bool), np.zeros_like(x))
        fiber = od.Fiber(kinds[f].chain(), GRADIENT, form)
        now = od.Shape(x, tension[parts])
        if scheme == "sdirk2":
            shape, velocity = restated.step_sdirk2(fiber, now, 0.05, drift[mine], loads)
        else:
            last = od.Shape(x - motion[mine], before[parts])
            shape = restated.step_bdf2(fiber, now, last, 0.05, loads)
            velocity = (shape.node_pos - (x + motion[mine] / 3.0)) / (2.0 * 0.05 / 3.0)
        for got, expected in (
            (sim.node_pos[mine], shape.node_pos),
            (sim.node_velocity[mine], velocity),
            (sim.method.tension.numpy()[parts], shape.tension),
        ):
            assert np.abs(got - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2"])
@pytest.mark.parametrize("name", HELD)
def test_held_nodes_move_as_given(start: Start, name: str, scheme: str, precision: str) -> None:
    """At rest to the last bit, else V t to rounding (one per step)."""
    kind = Kind(6, 2.71, modulus=1e5)
    x = bent_fiber(kind, np.random.default_rng(5), stretch=0.0)
    numerics = {"integrator": scheme, "precision": precision}
    sim = loaded(start, [kind], [x], load=LOADS[name], numerics=numerics)
    where, share = HELD[name]
    begin = sim.node_pos
    sim.step(200)
    moved = (sim.node_pos - begin)[where]
    eps = 1e-15 if precision == "float64" else 1e-6
    bound = 200 * eps * np.abs(begin).max() * share
    assert np.abs(moved - share * sim.time * np.array(SPEED)).max() <= bound
    assert np.isfinite(sim.node_pos).all()
    others = np.ones(len(x), dtype=bool)
    others[where] = False
    assert np.linalg.norm((sim.node_pos - begin)[others], axis=1).min() > 0.1


@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2"])
def test_no_force_is_no_load(start: Start, scheme: str) -> None:
    """A force of 0 leaves the motion as without the table, but for rounding."""
    kind = Kind(6, 2.71)
    x = bent_fiber(kind, np.random.default_rng(5), stretch=0.002)
    ends = []
    for rows in ([], [{"force": [0.0, 0.0, 0.0]}]):
        sim = loaded(start, [kind], [x], load=rows, numerics={"integrator": scheme})
        sim.step(50)
        ends.append(sim.node_pos)
    assert np.abs(ends[0] - ends[1]).max() < 1e-11


@pytest.mark.parametrize("form", ["compliant", "inextensible"])
@pytest.mark.parametrize("name", ["first held", "clamped", "clamped inside", "held inside"])
def test_contacts_do_not_move_held_nodes(start: Start, name: str, form: str) -> None:
    """Motion of the others by forces on rows: both solves of a step without the held unknowns."""
    kind = Kind(6, 2.71)
    x = bent_fiber(kind, np.random.default_rng(5), stretch=0.002)
    chains = Chains(functools.partial(start, load=LOADS[name]), [kind], [x], form=form, dense=False)
    loads = restated_loads(name, len(x))
    fiber, h = od.Fiber(kind.chain(), GRADIENT, form), restated.CHI * 0.05
    share = (1.0 - restated.CHI) / restated.CHI
    first = restated.solve_loaded(fiber, h, x, x, np.zeros(kind.segments), loads)
    moved = first.node_pos - x
    problem = od.linearize(
        fiber, h, x + share * moved, x + moved / restated.CHI, first.tension, loads.force
    )
    matrix, _ = od.multiplier_system(problem)
    tau = od.torque_strength(kind.chain(), np.full(kind.segments, kind.chain().rest_length))
    across = np.eye(3) - od.outer(problem.axis)
    resist = od.drag_matrix(kind.chain()) + od.segment_sum(tau[:, None, None] * across)
    between = loads.held[1:] & loads.held[:-1] & (form == "inextensible")
    free = ~np.concatenate([np.repeat(loads.held, 3), between])

    def solve(right: Array) -> Array:
        solution = np.zeros((len(matrix), right.shape[1]))
        solution[: x.size] = right
        solution[free] = np.linalg.solve(matrix[np.ix_(free, free)], solution[free])
        solution[~free] = 0.0
        return solution

    push = h * np.eye(x.size)
    whole = solve(push + share * resist @ solve(push)[: x.size])
    chains.dense = [Response(whole[: x.size], whole[x.size :] / h)]
    rows = random_rows(kind.segments, 20)
    got = chains.solve(rows, most=0)
    shift, _ = chains.respond(chains.jacobian(rows).T @ np.array([row.force for row in rows]))
    assert np.abs(shift).max() > 1e-3
    assert np.abs(got.shift - shift).max() < 1e-11 * np.abs(shift).max()
    assert not got.shift[loads.held].any()


def test_held_rods_carry_their_drag(start: Start) -> None:
    """A fiber of free joints held at one end in extension: its tension is the drag behind it.

    Free joints, for the bending energy also counts a stretch that changes along the fiber.
    """
    kind = Kind(8, 1.5, modulus=2e4)
    flow = {"kind": "uniaxial_extension", "extension_rate": 1.0, "viscosity": 1.0}
    rows = [{"node": 0, "hold": "position"}]
    x = straight_fiber(kind, (1, 0, 0), (12.0, 0, 0))
    groups = {"bending_modulus": 0.0}
    sim = loaded(start, [kind], [x], load=rows, flow=flow, groups=groups, numerics={"dt": 0.1})
    sim.step(100)
    drag = kind.chain().drag * kind.chain().matrix @ sim.node_pos[:, 0]
    pull = drag[::-1].cumsum()[::-1][1:]
    stretch = np.diff(sim.node_pos[:, 0]) - 3.0
    assert stretch * kind.chain().stretching_stiffness == pytest.approx(pull, rel=1e-9)
    assert sim.method.tension.numpy() * sim.model.units.force == pytest.approx(pull, rel=1e-9)


FROZEN_KINDS = [Kind(4, 3.0), Kind(6, 2.0)]


def half_frozen(**keys: Any) -> tuple[Simulation, list[Array]]:
    """A free fiber and a frozen one."""
    rng = np.random.default_rng(7)
    fibers = [bent_fiber(kind, rng, (10.0, 10.0, 10.0)) for kind in FROZEN_KINDS]
    groups = [kind.table(1, position=[0.0, 0.0, 0.0]) for kind in FROZEN_KINDS]
    groups[1]["frozen"] = True
    numerics = keys.pop("numerics", {"dt": 0.05})
    tables = {
        "flow": FLOW,
        "fibers": groups,
        "contact": {"law": "none"},
        "stage": [{"kind": "flow", "end_time": 1.0}],
        "numerics": {"method": "overdamped", "segments": [4, 6], "device": "cpu", **numerics},
        **keys,
    }
    scene = scene_from_dict(tables)
    return Simulation(scene, placement=place(fibers, [0, 1])), fibers


@pytest.mark.parametrize(
    "numerics", [{"dt": 0.05}, {"dt": 0.05, "integrator": "bdf2"}, {"tolerance": 1e-4}]
)
def test_frozen_fibers(numerics: dict[str, Any]) -> None:
    """They rest, or move by their velocity; the free fiber does as without them."""
    rows = [{"group": 1, "velocity": SPEED}]
    runs = [half_frozen(load=load, numerics=numerics) for load in ([], rows)]
    for share, (sim, fibers) in enumerate(runs):
        sim.step(40)
        given = share * sim.time * np.array(SPEED)
        assert np.abs(sim.node_pos[5:] - fibers[1] - given).max() <= share * 1e-12
        assert np.abs(sim.node_velocity[5:] - share * np.array(SPEED)).max() < 1e-15
        assert not sim.method.tension.numpy()[4:].any()
    both = [sim.node_pos[:5] for sim, _ in runs]
    assert both[0].tobytes() == both[1].tobytes()
    scene = dataclasses.replace(runs[0][0].scene, fibers=runs[0][0].scene.fibers[:1])
    alone = Simulation(scene, placement=place(runs[0][1][:1], [0]))
    alone.step(40)
    assert np.abs(both[0] - alone.node_pos).max() < 1e-10


def image_error(scheme: str, flow: dict[str, Any], dt: float) -> float:
    """Largest distance after a strain of 0.6 between fibers stored as images and as they are."""
    box = {"size": [40.0, 40.0, 40.0]}
    rows = [{"node": 0, "hold": "position"}, {"group": 1, "velocity": SPEED}]
    numerics = {"integrator": scheme, "dt": dt}
    ends = []
    for image in ([0, 0, 0], [1, 0, -1]):
        sim, _ = half_frozen(flow=flow, box=box, load=rows, numerics=numerics)
        nodes = sim.state.node_pos.numpy() - 40.0 * np.array(image)
        sim.state.node_pos.assign(nodes)
        sim.state.fiber_image.assign(np.array([image, image]))
        sim.step(round(0.6 / dt))
        ends.append(sim.node_pos)
    return float(np.abs(ends[0] - ends[1]).max())


@pytest.mark.parametrize("scheme", ["sdirk2", "bdf2"])
def test_images_of_held_and_frozen_fibers(scheme: str) -> None:
    """In a deforming box they move as the fibers: exactly in shear, else to second order in dt."""
    assert image_error(scheme, SHEAR, 0.02) < 1e-12 * 80.0
    extension = {"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0}
    errors = [image_error(scheme, extension, dt) for dt in (0.02, 0.01)]
    assert 3.4 < errors[0] / errors[1] < 4.6  # 2^1.8 ... 2^2.2
    assert errors[1] < 0.01


def test_loads_beyond_a_node_file(tmp_path: Path) -> None:
    """Fibers of a file are counted when they are placed."""
    nodes = np.array([[[0.0, 0, 0], [4, 0, 0], [8, 0, 0]], [[0, 0, 9], [4, 0, 9], [8, 0, 9]]])
    np.savez(tmp_path / "nodes.npz", node_pos=nodes)
    table = {
        "diameter": 2.0,
        "youngs_modulus": 1e3,
        "node_file": str(tmp_path / "nodes.npz"),
    }
    tables = {
        "flow": REST,
        "fibers": [table],
        "contact": {"law": "none"},
        "stage": [{"kind": "flow", "end_time": 1.0}],
        "numerics": {"method": "overdamped", "dt": 0.1, "device": "cpu"},
    }
    for key, count in (("fiber", "2 per group"), ("node", "3 per fiber")):
        scene = scene_from_dict({**tables, "load": [{"force": [0, 0, 1], key: 3}]})
        with pytest.raises(SceneError, match=f"load.0.{key}.*{count}"):
            Simulation(scene)
    sim = Simulation(scene_from_dict({**tables, "load": [{"force": [0, 0, 1], "fiber": 1}]}))
    before = sim.node_pos
    sim.step(3)
    moved = np.abs(sim.node_pos - before).max(axis=1)
    assert (moved[:3] == 0.0).all() and moved[3:].max() > 0.0
    sim.close()
