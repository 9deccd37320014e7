"""SIMD sweep over bonded spheres against the plain ones: the same laws, fibers side by side.

Bounds: float64 1e-13, float32 256 eps of the largest change; sums are in another order.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest

from tests.bonded_crowd import crowd
from tests.physics.test_contact_hand_over import STEP, dragged
from tests.physics.test_contact_hand_over import test_lines_over_nodes as lines_over_nodes
from tests.physics.test_contact_hand_over import test_sliding_over_nodes as sliding_over_nodes
from tests.physics.test_contact_hand_over import test_sticking_over_a_node as sticking_over_a_node
from warpfiber.methods import bonded_spheres
from warpfiber.methods.bonded_launches import bond_launch, drift_launch, pair_launches
from warpfiber.model import BAD_FIBER, EXPIRED, HALT, TORN
from warpfiber.passes import native_bonds, native_bonds_source
from warpfiber.passes.executor import Launch, load_kernels
from warpfiber.passes.native_bonds import make_native_bond_sweep
from warpfiber.passes.native_bonds_source import BEGIN, END, FROM_NODES, LOADS, TO_NODES
from warpfiber.simulation import Simulation

BOUND = {"float64": 1e-13, "float32": 256 * np.finfo(np.float32).eps}
PAIR_BOUND = {"float64": 1e-12, "float32": 2e-3}
NODES = "place node_velocity node_turn node_spin node_rate node_spin_rate".split()
KEPT = [*NODES, "still_steps", "wall_memory", "wall_depth"]


def arrays(sim: Simulation) -> dict[str, Any]:
    """All that a sweep changes."""
    method: Any = sim.method
    kept = {name: getattr(method, name) for name in KEPT if hasattr(method, name)}
    state = sim.state
    return kept | {
        "place": method.place,
        "node_pos": state.node_pos,
        "node_velocity": state.node_velocity,
        "status": state.status,
        "acts": method.contacts.acts,
        "grip": method.grips.node_grip,
        "contact_touch": method.native.contact_touch,
        "memory": method.contacts.memory,
        "written": method.contacts.written,
    }


def after(sim: Simulation, launches: Iterable[Launch]) -> dict[str, np.ndarray]:
    """Arrays after the launches; the simulation is left as it was."""
    kept = {name: array.numpy().copy() for name, array in arrays(sim).items()}
    launches = list(launches)
    load_kernels([launch.kernel for launch in launches], "cpu")
    for launch in launches:
        launch.run("cpu")
    found = {name: array.numpy().copy() for name, array in arrays(sim).items()}
    for name, array in arrays(sim).items():
        array.assign(kept[name])
    return found


def pair_arrays(method: Any) -> dict[str, np.ndarray]:
    """What the pair sweep stores."""
    names = "acts force arms memory written".split()
    return {name: getattr(method.contacts, name).numpy().copy() for name in names}


def assert_near(sim: Simulation, found: Any, expected: Any, precision: str) -> None:
    """Every array to the bound times its largest change."""
    before = {name: array.numpy() for name, array in arrays(sim).items()}
    for name in NODES:
        change = np.abs(expected[name] - before[name]).max()
        assert change > 0.0, name
        error = np.abs(found[name].astype(float) - expected[name]).max()
        scale = change if "place" not in name and "turn" not in name else np.abs(before[name]).max()
        assert error < BOUND[precision] * scale, name
    assert np.abs(found["grip"] - expected["grip"]).max(initial=0.0) < BOUND[precision] * np.abs(
        expected["grip"]
    ).max(initial=1.0)
    for name in ("status", "still_steps"):
        np.testing.assert_array_equal(found[name], expected[name])


ALONE = FROM_NODES | TO_NODES
LOAD = [
    {"fiber": 3, "node": 0, "hold": "clamp", "velocity": [0.01, 0.0, 0.0]},
    {"fiber": 9, "node": 3, "hold": "position"},
    {"fiber": 10, "node": -1, "force": [0.0, 2e-3, 0.0]},
]
SCENES: dict[str, dict[str, Any]] = {
    "all": {},
    "loads": {"load": LOAD},
    "grips": {
        "stage": [
            {
                "kind": "shear",
                "speed": 0.01,
                "freeze_below": 0.004,
                "freeze_above": 0.016,
                "end_strain": 1.0,
            }
        ]
    },
    "smooth": {"contact": {"friction": 0.0, "wall_friction": 0.0, "damping": 0.0}},
    "planes": {
        "wall": [
            {"name": "z-", "velocity": [0.1, -0.05, 0.0]},
            {"name": "y+", "friction": 0.9},
            {"name": "z+", "friction": 0.0},
        ]
    },
    "open": {
        "box": {"size": [0.06, 0.04, 0.02], "boundary": ["open"] * 3},
        "contact": {"friction": 0.5, "damping": 0.113},
    },
}


@pytest.mark.parametrize("precision", BOUND)
@pytest.mark.parametrize("turn", [0.1, 0.9])
@pytest.mark.parametrize("name", SCENES)
def test_same_as_plain(precision: str, turn: float, name: str) -> None:
    """Begin and end of a step; turns of neighbors by up to 3 rad take the long series."""
    sim = crowd(precision, turn, **SCENES[name])
    sim.prepare()
    native = sim.method.native  # type: ignore[attr-defined]
    assert native is not None
    sim.method.contacts.allocate_scratch()  # type: ignore[attr-defined]
    plain_pairs = pair_launches(sim.method, sim.method.dt)  # type: ignore[arg-type]
    begun = [drift_launch(sim.method), native.launch(BEGIN | ALONE)]  # type: ignore[arg-type]
    plain, simd = (after(sim, [launch]) for launch in begun)
    for kept in ("node_rate", "node_spin_rate"):
        np.testing.assert_array_equal(simd[kept], plain[kept])
    for kept in ("place", "node_velocity", "node_turn", "node_spin"):
        scale = np.abs(plain[kept]).max()
        assert np.abs(simd[kept] - plain[kept]).max() < BOUND[precision] * scale
    ends = bond_launch(sim.method, drifts=False, kicks=True)  # type: ignore[arg-type]
    first = begun[0]
    expected = after(sim, [first, *plain_pairs, ends])
    assert expected["acts"].any()
    pairs = native.pair_launch(sim.method.dt)
    found = after(sim, [first, pairs, native.launch(LOADS | END | ALONE)])
    assert not found["contact_touch"].any()  # ready for the next step
    assert_near(sim, found, expected, precision)
    assert (name == "grips") == bool(expected["grip"].any())
    if "wall" in str(sim.scene.box) and name != "smooth" and name != "open":
        assert expected["wall_depth"].any()
        memories = expected["wall_memory"]
        error = np.abs(found["wall_memory"] - memories).max()
        assert error <= BOUND[precision] * np.abs(memories).max()
    check_pairs(sim, precision)


def check_pairs(sim: Simulation, precision: str) -> None:
    """What every pair does, stored by pair, after the begin of a step."""
    method: Any = sim.method
    contacts, native = method.contacts, method.native
    for launch in (native.launch(BEGIN | ALONE), *pair_launches(method, method.dt)):
        launch.run("cpu")
    expected = pair_arrays(method)
    native.pair_launch(method.dt, keeps=True).run("cpu")
    found = pair_arrays(method)
    touching = expected["acts"].astype(bool)
    assert touching.sum() > 10
    np.testing.assert_array_equal(found["acts"], expected["acts"])
    if contacts.features.friction:
        np.testing.assert_array_equal(found["written"], expected["written"])
    kept = "memory" if contacts.features.friction else "force"
    sides = [pairs[kept][..., touching, :] for pairs in (found, expected)]
    assert np.abs(sides[0] - sides[1]).max() < 10.0 * PAIR_BOUND[precision] * np.abs(sides[1]).max()
    for name in ("force", "arms"):
        scale = np.abs(expected["arms" if name == "arms" else "force"][touching]).max()
        error = np.abs(found[name][touching] - expected[name][touching]).max()
        # where they are goes with eps over the squared sine of the angle of two fibers
        slack = 100.0 if name == "arms" else 1.0
        assert error < slack * PAIR_BOUND[precision] * scale, name


@pytest.mark.parametrize("precision", BOUND)
def test_joined(precision: str) -> None:
    """End and begin in one launch or in two: the same bits."""
    sim = crowd(precision, load=LOAD)
    sim.prepare()
    native = sim.method.native  # type: ignore[attr-defined]
    pairs = native.pair_launch(sim.method.dt)
    begin, end = native.launch(BEGIN | ALONE), native.launch(LOADS | END | ALONE)
    apart = after(sim, [begin, pairs, end, begin])
    assert apart["wall_depth"].any()
    for touches in (native.touches, native.fiber_touches):
        touches.zero_()  # only where fibers are says that these are at a wall
    parts = [native.launch(BEGIN | FROM_NODES), native.launch(LOADS | END | BEGIN | TO_NODES)]
    joined = after(sim, [parts[0], pairs, parts[1]])
    for name in apart:
        if name not in ("node_rate", "node_spin_rate"):
            np.testing.assert_array_equal(joined[name], apart[name], name)


@pytest.mark.parametrize(("precision", "told"), [("float64", []), ("float32", ["energy"])])
def test_runs(precision: str, told: list[str]) -> None:
    """Any parts of a run, and any workers: the same bits; with lists built on the way."""
    record = {"quantities": told}
    runs = [crowd(precision, workers=workers, record=record) for workers in (1, 2)]
    for sim in runs:
        sim.step(120)
    parts = crowd(precision, record=record)
    for count in (1, 1, 2, 57, 59):
        parts.step(count)
    builds = parts.method.list.build_count  # type: ignore[union-attr]
    assert builds > 2
    first = runs[0].snapshot()
    for other in (runs[1], parts):
        for name, value in other.snapshot().items():
            assert value.tobytes() == first[name].tobytes(), name
    for sim in runs:
        sim.close()


def test_run_as_plain(monkeypatch: pytest.MonkeyPatch) -> None:
    """100 steps: the same motion, the same contacts."""
    sim = crowd()
    before = sim.node_pos
    monkeypatch.setattr(bonded_spheres, "NATIVE", False)
    plain = crowd()
    assert plain.method.native is None  # type: ignore[attr-defined]
    for run in (sim, plain):
        run.step(100)
    moved = np.abs(plain.node_pos - before).max()
    assert np.abs(sim.node_pos - plain.node_pos).max() < 1e-9 * moved
    assert touching(sim) == touching(plain)


def touching(sim: Simulation) -> set[tuple[int, int]]:
    """Segments in contact."""
    method: Any = sim.method
    i, j, _ = method.list.host_pairs()
    acts = method.contacts.acts.numpy()[: len(i)].astype(bool)
    return set(zip(i[acts].tolist(), j[acts].tolist(), strict=True))


def test_restored() -> None:
    """A run that goes on from a snapshot is the run without a break, to the last bit."""
    run, again = crowd(), crowd()
    run.step(50)
    again.restore(run.snapshot())
    for sim in (run, again):
        sim.step(60)
    first, second = run.snapshot(), again.snapshot()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


@pytest.mark.parametrize("velocity", [[0.1, 0.0, 0.0], [0.08, -0.06, 0.0]])
def test_hand_over(monkeypatch: pytest.MonkeyPatch, velocity: list[float]) -> None:
    """A contact that passes nodes, stuck and sliding, at a right angle and along a line."""
    monkeypatch.setattr(native_bonds, "FIBERS_PER_BLOCK", 0)
    assert dragged(90.0, 0.3, velocity, 0.2).method.native is not None  # type: ignore[attr-defined]
    sliding_over_nodes(velocity, STEP)
    sticking_over_a_node(0.98, velocity)
    lines_over_nodes(8.0)


@pytest.mark.parametrize("bad", [np.nan, 100.0])
@pytest.mark.parametrize("fiber", [2, 39])
def test_torn(bad: float, fiber: int) -> None:
    """A torn fiber is told; 39 is the last one of a padded block."""
    sim = crowd()
    sim.prepare()
    place = sim.method.place.numpy()  # type: ignore[attr-defined]
    place[sim.fiber_node_start[fiber] + 1, 1] += bad
    native = sim.method.native  # type: ignore[attr-defined]
    found = after(sim, [native.launch(LOADS | END | ALONE)])
    assert found["status"][TORN] == 1 and found["status"][BAD_FIBER] == fiber
    others = np.delete(np.arange(len(place)), np.arange(*sim.fiber_node_start[fiber : fiber + 2]))
    assert np.isfinite(found["node_velocity"][others]).all()


def test_flags() -> None:
    """A node that has moved past the skin is told; a halted launch changes nothing."""
    sim = crowd()
    sim.prepare()
    native = sim.method.native  # type: ignore[attr-defined]
    native.near.block_skin.fill_(10.0)
    assert after(sim, [native.launch(BEGIN)])["status"][EXPIRED] == 0
    skin = native.near.block_skin.numpy()
    skin[native.blocks.slot[-1]] = 0.0
    native.near.block_skin.assign(skin)
    assert after(sim, [native.launch(BEGIN)])["status"][EXPIRED] == 1
    words = sim.state.status.numpy().copy()
    words[HALT] = 1
    sim.state.status.assign(words)
    before = {name: array.numpy().copy() for name, array in arrays(sim).items()}
    for name, value in after(sim, [native.launch(LOADS | END | BEGIN)]).items():
        np.testing.assert_array_equal(value, before[name], name)


def test_scratch(monkeypatch: pytest.MonkeyPatch) -> None:
    """What only the plain sweeps use is not there where vectors run."""
    names = "moment pair_hit beside hit_pair hit_closest hit_count acting node_force".split()
    contacts = crowd().method.contacts  # type: ignore[attr-defined]
    assert not any(hasattr(contacts, name) for name in names)
    monkeypatch.setattr(bonded_spheres, "NATIVE", False)
    contacts = crowd().method.contacts  # type: ignore[attr-defined]
    assert all(hasattr(contacts, name) for name in names)


def test_where_it_applies() -> None:
    """Fibers that do not meet leave the plain sweeps."""
    alone = crowd(contact={"law": "none"})
    assert alone.method.native is None  # type: ignore[attr-defined]
    assert crowd().method.native is not None  # type: ignore[attr-defined]


def test_large(monkeypatch: pytest.MonkeyPatch) -> None:
    """What large beds fetch ahead changes no bit, nor is anything read behind the ends."""
    found = []
    for large in (native_bonds_source.LARGE, 0):
        monkeypatch.setattr(native_bonds_source, "LARGE", large)
        make_native_bond_sweep.cache_clear()
        sim = crowd()
        sim.step(40)
        assert sim.method.contacts.acts.numpy().any()  # type: ignore[attr-defined]
        found.append((sim.node_pos, sim.method.node_turn.numpy()))  # type: ignore[attr-defined]
    for small, big in zip(*found, strict=True):
        np.testing.assert_array_equal(big, small)
    make_native_bond_sweep.cache_clear()
