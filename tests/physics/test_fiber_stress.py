"""Stress of fibers without inertia: bead by bead, free rods, chains, pairs pressed together.

Tolerances: sums to rounding, k eps of the largest term; exact rods to rounding; chains to C dt;
pairs to the tolerance of the gaps, 1e-3 radii, or the last step's motion.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from tests.cell import Kind, bent_fiber, isotropic, start_cell, straight_fiber
from tests.reference.stress import bead_middle, drag_moment, rod_moment, symmetric
from tests.scene_text import changed, faults_of
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

BOX = {"size": [60.0, 60.0, 60.0], "boundary": ["periodic"] * 3}
SHEAR = {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 1.0}
SIX = ("11", "22", "33", "12", "13", "23")


def tensor(row: dict[str, float], name: str = "stress") -> np.ndarray:
    """Columns of a row as a matrix (3, 3)."""
    s11, s22, s33, s12, s13, s23 = (row[f"{name}_{k}"] for k in SIX)
    return np.array([[s11, s12, s13], [s12, s22, s23], [s13, s23, s33]])


def cell(kind: Kind, fibers: list[Any], method: str, **tables: Any) -> Simulation:
    """Fibers in a periodic box in shear; without contact unless `tables` say so."""
    numerics = {"method": method, **tables.pop("numerics", {})}
    quantities = ["orientation", "orientation4", "stress"]
    given: dict[str, Any] = {"box": BOX, "flow": SHEAR} | tables
    return start_cell([kind], fibers, quantities=quantities, numerics=numerics, **given)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_drag_is_summed_over_beads(precision: str) -> None:
    """Any shape and velocity: the nodal sum with the Galerkin matrix is that over all beads."""
    kind, rng = Kind(4, 5.0), np.random.default_rng(2)
    fibers = [bent_fiber(kind, rng, 60.0 * rng.random(3)) for _ in range(20)]
    sim = cell(kind, fibers, "overdamped", numerics={"precision": precision})
    velocity = rng.normal(size=(100, 3))
    sim.state.node_velocity.assign(velocity.astype(sim.model.precision.numpy))
    sim.state.step.assign(np.array([1], dtype=np.int64))
    gradient = np.array([[0, 0, 1.0], [0, 0, 0], [0, 0, 0]])
    wanted = np.zeros((3, 3))
    for k, nodes in enumerate(fibers):
        moving = velocity[5 * k : 5 * k + 5]
        wanted += drag_moment(nodes, moving, 5, 1.0, 1.0, gradient, np.full(3, 30.0))
    wanted /= 60.0**3
    eps = {"float64": 2.3e-16, "float32": 1.2e-7}[precision]
    np.testing.assert_allclose(tensor(sim.measure()), wanted, atol=100 * eps * np.abs(wanted).max())


def test_free_rods_have_the_stress_of_their_model() -> None:
    """300 rods after a strain of 2: closed form in directions, and in the measured moments."""
    kind, rng = Kind(1, 19.0), np.random.default_rng(3)
    fibers = [straight_fiber(kind, p, 60.0 * rng.random(3)) for p in isotropic(rng, 300)]
    sim = cell(kind, fibers, "rigid_rod", numerics={"dt": 0.5})
    sim.step(4)
    row = sim.measure()
    ends = sim.node_pos.reshape(300, 2, 3)
    axis = np.diff(ends, axis=1)[:, 0] / 38.0
    strain = symmetric(np.array([[0, 0, 1.0], [0, 0, 0], [0, 0, 0]]))
    wanted = sum(rod_moment(p, 20.0, 1.0, 1.0, strain) for p in axis) / 60.0**3
    np.testing.assert_allclose(tensor(row), wanted, rtol=1e-12, atol=1e-12 * np.abs(wanted).max())
    shape = 399.0 / 403.0
    mean = shape * row["a1133_fiber"] + 0.25 * (1.0 - shape) * (row["a11_fiber"] + row["a33_fiber"])
    shear = 300 / 60.0**3 * 2.0 * np.pi * 20.0 * 399.0 * mean
    assert row["relative_viscosity"] == pytest.approx(1.0 + shear, rel=1e-12)
    assert row["normal_difference_1"] == pytest.approx(wanted[0, 0] - wanted[2, 2], rel=1e-12)
    assert row["normal_difference_2"] == pytest.approx(wanted[2, 2] - wanted[1, 1], rel=1e-12)
    assert tensor(row, "stress_contact") == pytest.approx(np.zeros((3, 3)), abs=0.0)


def test_stiff_chains_come_to_that_of_rods_with_the_step() -> None:
    """Three segments that keep their length, of so stiff fibers that bending does not show.

    First order: lengths are right at the ends of a step, so velocities along them are means of it.
    """
    kind, axis = Kind(3, 6.0, modulus=1e9), np.array([0.5, 0.4, 0.7])
    strain = symmetric(np.array([[0, 0, 1.0], [0, 0, 0], [0, 0, 0]]))
    errors = []
    for dt in (0.1, 0.05, 0.025):
        fibers = [straight_fiber(kind, axis, (30.0, 30.0, 30.0))]
        sim = cell(kind, fibers, "overdamped", numerics={"dt": dt}, groups={"inextensible": True})
        sim.step(round(1.0 / dt))
        ends = sim.node_pos[-1] - sim.node_pos[0]
        wanted = rod_moment(ends / np.linalg.norm(ends), 19.0, 1.0, 1.0, strain) / 60.0**3
        errors.append(np.abs(tensor(sim.measure()) - wanted).max() / np.abs(wanted).max())
    assert errors[0] < 0.01
    assert errors[1] < 0.55 * errors[0] and errors[2] < 0.55 * errors[1]


def test_crossed_rods_pressed_together() -> None:
    """Extension brings two crossed rods together: f = eps a xi, its virial -2 a f/V along z.

    Both rods lie in the plane of the fluid that rests, at the height of the other's touch.
    """
    kind, rate = Kind(1, 19.0), 0.1
    fibers = [
        straight_fiber(kind, (0.0, 1.0, 0.0), (30.0, 30.0, 29.0)),
        straight_fiber(kind, (1.0, 0.0, 0.0), (30.0, 30.0, 31.0)),
    ]
    flow = {"kind": "planar_extension", "extension_rate": rate, "viscosity": 1.0}
    sim = cell(
        kind,
        fibers,
        "rigid_rod",
        flow=flow,
        contact={"law": "exponential"},
        numerics={"dt": 1e-3, "contact_tolerance": 1e-7},
    )
    sim.step(20)
    row = sim.measure()
    force = rate * 6.0 * np.pi * 20.0
    contact = tensor(row, "stress_contact")
    assert contact[2, 2] == pytest.approx(-2.0 * force / 60.0**3, rel=1e-3)
    assert np.abs(contact - np.diag(np.diag(contact))).max() < 1e-6 * force / 60.0**3
    volume = sim.lattice is not None and np.linalg.det(sim.lattice)
    assert volume == pytest.approx(60.0**3, rel=1e-9)


def test_contacts_are_told_as_they_begin() -> None:
    """Two crossed rods that an extension brings together: nothing before they touch, then 2 F."""
    kind, rate = Kind(1, 19.0), 0.1
    fibers = [
        straight_fiber(kind, (0.0, 1.0, 0.0), (30.0, 30.0, 28.975)),
        straight_fiber(kind, (1.0, 0.0, 0.0), (30.0, 30.0, 31.025)),
    ]
    flow = {"kind": "planar_extension", "extension_rate": rate, "viscosity": 1.0}
    contact, numerics = {"law": "exponential"}, {"dt": 0.05, "contact_tolerance": 1e-7}
    sim = cell(kind, fibers, "rigid_rod", flow=flow, contact=contact, numerics=numerics)
    sim.step()
    assert not tensor(sim.measure(), "stress_contact").any()
    sim.step(20)
    found = tensor(sim.measure(), "stress_contact")
    assert found[2, 2] == pytest.approx(-2.0 * rate * 6.0 * np.pi * 20.0 / 60.0**3, rel=1e-2)


@pytest.mark.parametrize("method", ["rigid_rod", "overdamped"])
@pytest.mark.parametrize("boundary", ["periodic", "wall"])
def test_contacts_pass_on_force_times_the_way_between_middles(method: str, boundary: str) -> None:
    """A crowded sheared cell: arms and line between center lines add up to x_c,j - x_c,i.

    Rows are those of the last step, their places those at its end: the ways agree to the bits in
    which fractions s, t and places are kept.
    """
    kind = Kind(1 if method == "rigid_rod" else 2, 12.0)
    tables = {
        "box": {"size": [60.0, 60.0, 40.0], "boundary": ["periodic", "periodic", boundary]},
        "flow": SHEAR,
        "fibers": [{**kind.table(150), "orientation": [0.6, 0.35, 0.05, 0, 0, 0]}],
        "stage": [{"kind": "flow", "end_time": 1.0}],
        "record": {"quantities": ["stress"]},
        "numerics": {
            "method": method,
            "segments": kind.segments,
            "strain_step": 0.05,
            "device": "cpu",
        },
    }
    sim = Simulation(scene_from_dict(tables))
    sim.step(20)
    contact = sim.method.contact  # type: ignore[attr-defined]
    rows = contact.solves[0][0]
    count = int(rows.row_count.numpy()[0])
    force = rows.row_force.numpy()[:count]
    assert np.count_nonzero(force) > 10
    x = sim.state.node_pos.numpy()
    box, back = sim.state.lattice.numpy()[0], np.linalg.inv(sim.state.lattice.numpy()[0])
    wraps = np.array(sim.model.domain.periodic, dtype=float)
    node, owner = sim.model.host["segment_node"], sim.model.host["segment_fiber"]
    start = sim.fiber_node_start
    row_i, row_j = rows.row_i.numpy(), rows.row_j.numpy()
    row_s, row_t, normal = rows.row_s.numpy(), rows.row_t.numpy(), rows.row_normal.numpy()
    wanted, walls = np.zeros((3, 3)), 0
    for r in np.flatnonzero(force):
        push = -force[r] * normal[r]
        i = row_i[r]
        fiber = owner[i]
        middle_i = bead_middle(x[start[fiber] : start[fiber + 1]], 12)
        place_i = x[node[i]] + row_s[r] * (x[node[i] + 1] - x[node[i]])
        if row_j[r] < 0:
            wanted += symmetric(np.outer(place_i + normal[r] - middle_i, push))
            walls += 1
            continue
        j = row_j[r]
        other = owner[j]
        middle_j = bead_middle(x[start[other] : start[other + 1]], 12)
        place_j = x[node[j]] + row_t[r] * (x[node[j] + 1] - x[node[j]])
        across = place_j - place_i
        shift = -box @ (wraps * np.round(back @ across))
        assert np.linalg.norm(across + shift) < 2.6
        wanted += symmetric(np.outer(middle_j + shift - middle_i, push))
    assert (walls > 0) == (boundary == "wall")
    found = tensor(sim.measure(), "stress_contact") * np.linalg.det(box)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())


def test_nothing_is_known_before_the_first_step() -> None:
    """No velocity has been found yet: nan, not zero."""
    kind = Kind(1, 9.0)
    sim = cell(kind, [straight_fiber(kind, (1.0, 0.0, 1.0), (9.0, 9.0, 9.0))], "rigid_rod")
    assert np.isnan([value for name, value in sim.measure().items() if "stress" in name]).all()


def test_stress_needs_a_box_and_a_method_without_inertia() -> None:
    """Faults name what to change."""
    asked: dict[str, Any] = {"record.quantities": ["stress"], "contact.lubrication": "none"}
    tables = changed(asked)
    assert "overdamped" in faults_of(tables)[0].remedy
    tables = changed(asked | {"numerics.method": "overdamped", "contact.law": "none"})
    del tables["box"]
    assert [fault.key for fault in faults_of(tables)] == ["record.quantities"]
