"""Cells of fibers that packing has bent: others hold them, and they move by whole steps.

Source: a fiber that springs back without contact leaves every row made for that motion behind; with
the forces of the last step on it a step is as long as the motion of the cell allows.
Tolerance: forces on nodes are sums of the rows' to rounding; a step is halved for an overlap of
more than 0.05 radii, or 20 tolerances of contact.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from tests.meeting_cell import last_rows, rejected
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

DT = 0.05


def packed_scene(
    longest: float = 1e-3,
    averages: tuple[float, float] = (4e-4, 5.3e-4),
    *,
    height: float | None = None,
    shortest: float = 1e-4,
    **numerics: Any,
) -> Any:
    """Glass in a melt, in layers of a plate: 160 fibers that random straight ones cannot be."""
    side, height = 1.1 * longest, 0.2 * longest if height is None else height
    return scene_from_dict(
        {
            "seed": 3,
            "box": {"size": [side, side, height], "boundary": ["periodic", "periodic", "wall"]},
            "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 300.0},
            "fibers": [
                {
                    "diameter": 19e-6,
                    "density": 2500.0,
                    "youngs_modulus": 7e10,
                    "length_distribution": {
                        "number_average": averages[0],
                        "weight_average": averages[1],
                        "maximum": longest,
                        "minimum": shortest,
                    },
                    "volume_fraction": 0.0793,
                    "orientation": [0.36, 0.62, 0.02, 0, 0, 0],
                }
            ],
            "contact": {"law": "exponential"},
            "stage": [{"kind": "flow", "end_strain": 2.0}],
            "numerics": {
                "method": "overdamped",
                "segment_length": 2e-4,
                "dt": DT,
                "contact": "unilateral",
                **numerics,
            },
        }
    )


@pytest.fixture(scope="module", params=["relaxed", "gradients"])
def packed(request: pytest.FixtureRequest) -> Iterator[Simulation]:
    """The cell after its first step that was kept, by both solvers of contact forces."""
    sim = Simulation(packed_scene(), workers=1)
    for _, dual in sim.method.contact.solves:  # type: ignore[attr-defined]
        dual.relaxes = request.param == "relaxed"
        if not dual.relaxes:
            dual.node_push = dual.node_push[:0]
    assert sim.model.starts_bent
    assert not sim.method.load.contact_load.numpy().any()  # type: ignore[attr-defined]
    sim.step(1)
    yield sim
    sim.close()


def row_loads(sim: Simulation) -> np.ndarray:
    """(N, 3) forces of the last rows of both solves on the nodes."""
    host = sim.model.host
    load = np.zeros((sim.model.node_count, 3))
    for rows in (last_rows(sim, solve) for solve in (0, 1)):
        push = rows["force"][:, None] * rows["normal"]
        for side, share, sign in (("i", rows["s"], -1.0), ("j", rows["t"], 1.0)):
            met = rows[side] >= 0
            node = host["segment_node"][rows[side][met]]
            np.add.at(load, node, sign * (1.0 - share[met])[:, None] * push[met])
            np.add.at(load, node + 1, sign * share[met][:, None] * push[met])
    return load


def test_forces_of_a_step_that_is_kept_stay(packed: Simulation) -> None:
    """Also after steps that were taken back: the first were, their fibers sprang too far."""
    assert rejected(packed) > 0
    kept = packed.method.load.contact_load.numpy()  # type: ignore[attr-defined]
    expected = row_loads(packed)
    assert np.abs(expected).max() > 0.0
    eps = np.finfo(float).eps
    assert np.abs(kept - expected).max() < 100.0 * eps * np.abs(expected).max()


def test_free_ends_near_a_fiber_have_rows(packed: Simulation) -> None:
    """Every fiber less than 1.5 radii from a free end at the start of the step, by brute force."""
    host, radius = packed.model.host, packed.model.group_rows[0]["radius"]
    method = packed.method
    nodes = method.node_back.numpy().astype(float)  # type: ignore[attr-defined]
    fiber, first = host["segment_fiber"], host["segment_node"]
    start, span = nodes[first], nodes[first + 1] - nodes[first]
    box = np.asarray(packed.model.domain.size)
    rows = last_rows(packed)
    met = {
        frozenset((fiber[i], fiber[j])) for i, j in zip(rows["i"], rows["j"], strict=True) if j >= 0
    }
    near = set()
    turns = [np.array([u, v, 0.0]) * box for u in (-1, 0, 1) for v in (-1, 0, 1)]
    begin = host["fiber_node_start"]
    for f, (low, high) in enumerate(zip(begin, begin[1:], strict=False)):
        for end in (nodes[low], nodes[high - 1]):
            for turn in turns:
                apart = end + turn - start
                s = np.clip((apart * span).sum(1) / (span**2).sum(1), 0.0, 1.0)
                gap = np.linalg.norm(apart - s[:, None] * span, axis=1) - 2.0 * radius
                near |= {frozenset((f, k)) for k in fiber[gap < 1.5 * radius] if k != f}
    assert len(near) > 20
    assert near <= met


def test_packed_cell_moves_by_whole_steps() -> None:
    """900 fibers as bent as in the whole plate: few steps are halved, and soon hardly any.

    Without the forces of the last step on the fibers: 94 steps and as many halved to a strain of 1,
    27 halved in its second half; with them 33, 18 and 1.
    """
    sim = Simulation(packed_scene(2e-3, (6e-4, 1e-3)), workers=1)
    sim.run(until=0.5)
    taken, turned_down = sim.step_count, rejected(sim)
    assert taken <= 4.0 * (0.5 / DT)
    assert turned_down <= taken
    sim.run(until=1.0)
    assert sim.step_count - taken <= 1.6 * (0.5 / DT)
    assert rejected(sim) - turned_down <= 0.8 * (0.5 / DT)
    assert sim.method.contact.check.largest.numpy()[0] <= 0.05  # type: ignore[attr-defined]
    assert sim.method.contact.check.found.numpy()[0] == 0  # type: ignore[attr-defined]
    sim.close()


def test_tolerance_of_contact_hardly_matters() -> None:
    """The orientation after a strain of 1 with four times the tolerance, to 0.01."""
    found = []
    for tolerance in (1e-2, 2.5e-3):
        sim = Simulation(packed_scene(contact_tolerance=tolerance), workers=1)
        sim.run(until=1.0)
        found.append(sim.measure()["a11"])
        sim.close()
    assert abs(found[0] - found[1]) < 0.01


def test_continued_cell_is_the_same() -> None:
    """Forces of contact are carried into a continued run, for one and for two workers."""
    first = Simulation(packed_scene(), workers=1)
    first.step(12)
    kept = first.snapshot()
    first.step(6)
    again = Simulation(packed_scene(), workers=2)
    again.restore(kept)
    again.step(6)
    assert again.node_pos.tobytes() == first.node_pos.tobytes()
    for sim in (first, again):
        sim.close()


def test_a_step_that_tears_a_fiber_is_taken_by_halves() -> None:
    """979 fibers, one of which contact forces would throw to twice its length in one step."""
    averages, tolerance = (4.15e-4, 7.65e-4), 1e-2
    scene = packed_scene(2e-3, averages, height=3e-4, shortest=5e-5, contact_tolerance=tolerance)
    sim = Simulation(scene, workers=1)
    sim.run(until=1.5)
    assert rejected(sim) > 0
    assert sim.method._segment_stretch().max() < 1.1
    sim.close()
