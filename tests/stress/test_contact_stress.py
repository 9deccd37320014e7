"""Contact of fibers without inertia where it is hardest: large steps, jams, overlaps, odd sizes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, place, straight_fiber
from tests.meeting_cell import (
    HARD,
    LAYER,
    METHODS,
    SHEAR,
    Meeting,
    contact_rows,
    last_rows,
    meeting_scene,
    rejected,
)
from tests.placed import segment_distance
from tests.reference.crossing import crossings
from tests.stress.small_cell import Shell, shell
from warpfiber.output import checkpoint_paths, read_checkpoint
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Diverged, Simulation

__all__ = ["shell"]  # a fixture
REST = {"kind": "rest", "viscosity": 1.0}
LOOSE = {"size": [32.0, 32.0, 32.0]}


@pytest.fixture
def meeting() -> Iterator[Meeting]:
    """Makes cells of fibers that meet."""
    cells = Meeting([])
    yield cells
    for sim in cells.running:
        sim.close()


def step_size(sim: Simulation) -> float:
    """Size of the next step, run units."""
    return float(sim.method.step_size.numpy()[0])  # type: ignore[attr-defined]


def segments(sim: Simulation) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both ends of all segments, and their fibers."""
    node = sim.model.host["segment_node"]
    x = sim.node_pos / sim.model.units.length
    return x[node], x[node + 1], sim.model.host["segment_fiber"]


def count_crossings(before: Any, after: Any, lattices: tuple[np.ndarray, np.ndarray]) -> int:
    """Pairs of segments, nearest images, that met on straight ways between two states."""
    (a0, b0, fiber), (a1, b1, _) = before, after
    i, j = np.triu_indices(len(a0), 1)
    i, j = (k[fiber[i] != fiber[j]] for k in (i, j))
    middle = 0.5 * (a0 + b0)
    image = -np.round(np.linalg.solve(lattices[0], (middle[j] - middle[i]).T))
    start, end = ((lattice @ image).T for lattice in lattices)
    near = segment_distance(a0[i], b0[i], a0[j] + start, b0[j] + start) < 4.0
    met = 0
    for k in np.flatnonzero(near):
        p, q = i[k], j[k]
        ways = (
            np.array([x[p], y[p], x[q] + shift[k], y[q] + shift[k]])
            for x, y, shift in ((a0, b0, start), (a1, b1, end))
        )
        met += crossings(*ways, steps=100)
    return met


@pytest.mark.parametrize("method", METHODS)
def test_steps_that_are_far_too_large(meeting: Meeting, method: str) -> None:
    """They are halved, nothing passes through anything, and large ones are taken again."""
    sim = meeting(method, 75, box=LOOSE, numerics={"dt": 1.0, "allow_unstable_dt": True})
    sizes, strains = [], []
    for _ in range(30):
        before, lattice = segments(sim), sim.state.lattice.numpy()[0].copy()
        start = sim.strain
        sim.step()
        later = lattice.copy()  # unreduced
        later[0, 2] += 32.0 * (sim.strain - start)
        sizes.append(step_size(sim))
        strains.append(sim.strain - start)
        assert count_crossings(before, segments(sim), (lattice, later)) == 0
        assert sim.measure()["overlap_max"] <= 0.05 + 1e-6
    assert rejected(sim) > 3
    assert min(sizes) > 1.0 / 100.0  # no creeping
    assert any(later > size for size, later in zip(strains, strains[1:], strict=False))
    assert np.isfinite(sim.node_pos).all()


@pytest.mark.parametrize("method", METHODS)
def test_the_full_step_is_taken_again(meeting: Meeting, method: str) -> None:
    dt = {"rigid_rod": 0.2, "overdamped": 0.4}[method]
    sim = meeting(method, 75, box=LOOSE, numerics={"dt": dt, "allow_unstable_dt": True})
    sizes, refused = [], []
    for _ in range(30):
        strain = sim.strain
        sim.step()
        sizes.append(sim.strain - strain)
        refused.append(rejected(sim))
    assert refused[-1] > 0 and min(sizes) < 0.9 * dt
    halved = int(np.argmax(np.array(refused) > 0))
    assert max(sizes[halved + 1 :]) == pytest.approx(dt)


@pytest.mark.parametrize("law", ["hard", "linear", "exponential"])
@pytest.mark.parametrize("method", METHODS)
def test_an_overlapping_start_is_pushed_apart(method: str, law: str) -> None:
    """Half a radius of overlap ends within a few steps, without a jump beyond what it takes."""
    kind = METHODS[method][0]
    fibers = [
        straight_fiber(kind, (1, 0, 0), (0.0, 0.0, 0.0)),
        straight_fiber(kind, (0, 1, 0), (1.0, 0.5, 1.5)),
    ]
    contact: dict[str, Any] = {
        "hard": HARD,
        "linear": {"law": "linear", "stiffness": 1e3},
        "exponential": {"law": "exponential", "strength": 1e3},
    }[law]
    scene = meeting_scene(
        method,
        2,
        flow=REST,
        contact=contact,
        box={"size": [60.0, 60.0, 60.0]},
        numerics={"contact": "unilateral" if law == "hard" else "penalty"},
    )
    sim = Simulation(scene, placement=place(fibers, [0, 0]))
    sim.step(40)
    a, b, fiber = segments(sim)
    mine, other = fiber == 0, fiber == 1
    count = int(mine.sum())
    near = segment_distance(
        np.repeat(a[mine], count, 0),
        np.repeat(b[mine], count, 0),
        np.tile(a[other], (count, 1)),
        np.tile(b[other], (count, 1)),
    ).min()
    # a penalty relaxes towards contact: 40 steps are many of its times
    assert near > 2.0 - (2e-3 if law == "hard" else 0.1)
    assert near < 2.1
    sim.close()


def test_frozen_pairs_that_overlap_are_left_alone() -> None:
    """Nothing can move them: their rows stay without force, and the step is not refused."""
    kinds = (Kind(3, 3.0, modulus=1e3), Kind(1, 6.0))
    free = straight_fiber(kinds[0], (1, 0, 0), (0.0, 0.0, 2.5))
    held = [straight_fiber(kinds[1], (0, 1, 0), (x, 0.0, 0.0)) for x in (-4.0, -2.7, 4.0)]
    groups = [
        kind.table(count, position=[[0.0, 0.0, 0.0]] * count)
        for kind, count in zip(kinds, (1, 3), strict=True)
    ]
    groups[1]["frozen"] = True
    scene = scene_from_dict(
        {
            "flow": SHEAR,
            "fibers": groups,
            "contact": HARD,
            "gravity": {"acceleration": [0.0, 0.0, -100.0], "fluid_density": 0.0},
            "stage": [{"kind": "flow", "end_time": 1.0}],
            "numerics": {
                "method": "overdamped",
                "segments": [3, 1],
                "device": "cpu",
                "dt": 0.05,
            },
        }
    )
    sim = Simulation(scene, placement=place([free, *held], [0, 1, 1, 1]))
    sim.step(40)
    assert np.isfinite(sim.node_pos).all()
    assert np.abs(sim.node_pos[4:] - np.concatenate(held)).max() < 1e-12
    rows = last_rows(sim)
    assert np.isfinite(rows["force"]).all()
    assert (rows["force"][rows["i"] < 3] > 0.0).any()
    assert not rows["force"][rows["i"] >= 3].any()
    ends = sim.node_pos[4:].reshape(3, 2, 3)
    for k in range(3):
        mine = (np.tile(x, (3, 1)) for x in sim.node_pos[k : k + 2])
        assert segment_distance(*mine, ends[:, 0], ends[:, 1]).min() > 1.95
    assert rejected(sim) == 0
    sim.close()


@pytest.mark.parametrize("method", METHODS)
def test_rows_and_lists_grow_on_the_way(meeting: Meeting, method: str) -> None:
    """A run whose rows or pairs had no room is the run that had it from the start."""
    runs = [meeting(method, 75, box=LOOSE) for _ in range(2)]
    for rows, _ in runs[1].method.contact.solves:  # type: ignore[attr-defined]
        rows._allocate_rows(3)
    for sim in runs:
        sim.step(20)
    assert contact_rows(runs[1]).capacity > 3
    pairs = runs[1].method.list
    assert pairs is not None
    pairs._drop_executor()
    pairs.pair_capacity = 5
    pairs._allocate_pairs()
    grown = pairs.grow_count
    for sim in runs:
        sim.method.contact.search.refresh(sim.step_count)  # type: ignore[attr-defined]
        sim.method._stop_executor()
        sim.step(20)
    assert pairs.grow_count > grown
    assert runs[0].node_pos.tobytes() == runs[1].node_pos.tobytes()


@pytest.mark.parametrize("method", METHODS)
def test_very_unequal_lengths(meeting: Meeting, method: str) -> None:
    """Fibers of 2 and 40 beads, longer than half the box."""
    per = METHODS[method][0].segments
    kinds = (Kind(per * 2, 19.5 / per, modulus=3e4), Kind(1, 1.0))
    if method == "rigid_rod":
        kinds = (Kind(1, 20.0), Kind(1, 1.0))
    sim = meeting(
        method,
        kinds=kinds,
        which=[0] * 8 + [1] * 150,
        box={"size": [54.0, 54.0, 54.0]},
    )
    sim.step(40)
    assert np.isfinite(sim.node_pos).all()
    assert sim.measure()["overlap_max"] <= 0.05 + 1e-6
    assert len(last_rows(sim)["force"]) > 2


@pytest.mark.parametrize("method", METHODS)
def test_fibers_longer_than_half_the_box(meeting: Meeting, method: str) -> None:
    """They meet their own images and one another more than once."""
    per = 1 if method == "rigid_rod" else 4
    kinds = (Kind(per, 12.0 / per, modulus=3e4),)
    sim = meeting(method, 25, kinds=kinds, box={"size": [32.0, 31.0, 33.0]})
    assert kinds[0].aspect_ratio * 2.0 > 0.5 * 33.0
    sim.step(60)
    assert sim.measure()["overlap_max"] <= 0.05 + 1e-6
    assert np.isfinite(sim.node_pos).all()


@pytest.mark.parametrize("method", METHODS)
def test_fibers_of_several_radii_and_walls(meeting: Meeting, method: str) -> None:
    per = METHODS[method][0].segments
    kinds = tuple(Kind(per, 9.0 / r / per, radius=r, modulus=3e3) for r in (1.0, 0.5))
    sim = meeting(method, kinds=kinds, which=[0] * 25 + [1] * 60, box=LAYER)
    sim.step(60)
    assert sim.measure()["overlap_max"] <= 0.05 * 0.5 + 1e-6
    radius = np.repeat([1.0, 0.5], [25 * (per + 1), 60 * (per + 1)])
    height = sim.node_pos[:, 2]
    assert (height - radius > -0.05).all() and (25.0 - height - radius > -0.05).all()


# -- a cell that jams -----------------------------------------------------------------------------

JAM = """
[box]
size = [2e-4, 2e-4, 1.906e-5]
boundary = ["periodic", "periodic", "wall"]
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
node_file = "fibers.npz"
diameter = 1e-5
youngs_modulus = 1e12
[contact]
[[stage]]
kind = "flow"
end_strain = 3
[record]
scalars = 20
frames = 5
figures = false
[numerics]
method = "METHOD"
device = "cpu"
dt = 5e-4
"""


@pytest.mark.parametrize("method", METHODS)
def test_a_jam_ends_with_names_and_a_checkpoint(shell: Shell, method: str) -> None:
    """Crossed fibers in a gap of less than two diameters overlap, walls or each other."""
    along = np.linspace(-4.5e-5, 4.5e-5, 2 if method == "rigid_rod" else 4)
    nodes = np.full((2, len(along), 3), (1e-4, 1e-4, 0.953e-5))
    nodes[0, :, 0] += along
    nodes[1, :, 1] += along
    nodes[:, :, 2] += np.array([[-4.525e-6], [4.525e-6]])
    np.savez(shell.folder / "fibers.npz", node_pos=nodes)
    assert shell.run("out", text=JAM.replace("METHOD", method)) == 3, shell.err
    message = shell.summary("out")["failure"]["message"]
    assert "no step keeps contacts apart: fiber " in message
    assert re.search(r"overlaps (fiber \d+|a wall) by 0\.\d+ radii", message)
    assert 'numerics.contact = "penalty"' in message and "nan" not in message
    folder = shell.folder / "out"
    (path,) = checkpoint_paths(folder)
    assert str(path) in message
    arrays, _ = read_checkpoint(path)
    assert all(np.isfinite(values).all() for values in arrays.values())
    assert (folder / "diverged.npz").exists()


def test_torn_fiber_that_may_meet_others(meeting: Meeting) -> None:
    """A fiber too soft for the flow is told as torn at twice its length, as without contact."""
    kind = Kind(2, 6.0, modulus=2.0)
    flow = {"kind": "planar_extension", "extension_rate": 1.0, "viscosity": 1.0}
    fibers = [straight_fiber(kind, (1, 0, 0), (0, y, 0)) for y in (-4, 4)]
    box = {"size": [200.0] * 3}
    sim = meeting(
        "overdamped",
        2,
        kinds=[kind],
        flow=flow,
        box=box,
        placement=place([nodes + 100.0 for nodes in fibers], [0, 0]),
    )
    with pytest.raises(Diverged, match=r"fiber \d is torn at node"):
        sim.step(100)
    assert sim.method._segment_stretch().max() < 2.2
