"""Beds that fall and are pressed fast with strong friction: no energy out of nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest

from warpfiber.scene import SceneError, scene_from_dict
from warpfiber.simulation import Diverged, Simulation

FIBERS = {
    "centerline_length": 0.0312,
    "diameter": 2.4e-3,
    "density": 1340.0,
    "youngs_modulus": 7.5e5,
    "bond_damping": 0.0335,
    "shape": {"kind": "s", "curvature": 20.0},
}
FRICTION = {"friction": 1.4, "wall_friction": 0.6}
COUNT = 16
PRESS = {"kind": "compress", "wall": "z+", "speed": 1.0, "end_volume_fraction": 0.45}


def bed(fraction: float = 0.3, **tables: object) -> Simulation:
    """Fibers above a wall, thrown down."""
    scene = {
        "box": {"size": [0.03, 0.03, 0.12], "boundary": ["periodic", "periodic", "wall"]},
        "gravity": {},
        "fibers": [{**FIBERS, "count": COUNT, "initial_velocity": [0.0, 0.0, -1.0]}],
        "contact": FRICTION | {"damping": 0.113},
        "stage": [{"kind": "settle", "end_time": 0.06, "damping": 0.0}, PRESS],
        "record": {"quantities": ["energy", "stress"]},
        "numerics": {
            "method": "bonded_spheres",
            "segments": 13,
            "device": "cpu",
            "dt_fraction": fraction,
            "allow_unstable_dt": fraction > 1.0,
        },
    }
    return Simulation(scene_from_dict(scene | tables))


def stored(row: dict[str, float]) -> float:
    """Energies of the present state."""
    return math.fsum(v for k, v in row.items() if k.startswith("energy"))


def followed(sim: Simulation, stage: int, time: float, looks: int) -> list[dict[str, float]]:
    """Rows of a stage that runs for a time."""
    sim.begin_stage(sim.scene.stages[stage])
    rows = []
    for instant in np.linspace(sim.time, sim.time + time, looks + 1)[1:]:
        sim.run(time=instant)
        rows.append(sim.measure())
    return rows


def gains(sim: Simulation, fall: float, press: float) -> tuple[float, list[dict[str, float]]]:
    """Largest gain of the present energy over what was put in, of what was put in."""
    first = sim.measure()
    rows = followed(sim, 0, fall, 30) + followed(sim, 1, press, 20)
    fallen = first["energy_gravity"] - min(row["energy_gravity"] for row in rows)
    put_in = first["energy_kinetic"] + fallen
    gained = [stored(row) - stored(first) - row["wall_work"] for row in rows]
    return max(g / (put_in + r["wall_work"]) for g, r in zip(gained, rows, strict=True)), rows


@pytest.mark.parametrize("damped", [True, False])
def test_falling_and_pressed(damped: bool) -> None:
    """The present energy never exceeds what was put in, a fall and a thrust at 1 m/s included."""
    beta = {"damping": 0.113 * damped}
    fibers = {**FIBERS, "count": COUNT, "initial_velocity": [0.0, 0.0, -1.0]}
    fibers["bond_damping"] = 0.0335 * damped
    gained, rows = gains(bed(contact=FRICTION | beta, fibers=[fibers]), 0.06, 0.022)
    assert gained < 1e-3
    assert rows[-1]["volume_fraction"] > 0.3
    assert rows[-1]["wall_work"] > 3.0 * rows[0]["energy_kinetic"]
    assert rows[-1]["dissipated_friction"] > 0.5 * rows[0]["energy_kinetic"]


def test_most_is_accounted_for() -> None:
    """What is stored and dissipated is what was put in, to 0.5 %; 0.3 here, 0.1 for half of dt."""
    sim = bed()
    first = sim.measure()
    _, rows = gains(sim, 0.06, 0.022)
    for row in rows:
        lost = math.fsum(v for k, v in row.items() if k.startswith("dissipated"))
        error = stored(row) + lost - stored(first) - row["wall_work"]
        assert abs(error) < 0.005 * (first["energy_kinetic"] + row["wall_work"])


def test_stiff_contacts_set_the_step() -> None:
    """Contacts a thousand times stiffer than the bonds: no gain below the limit, blow-up above.

    The overlaps of this fall are a hundredth of what the limit is taken at, so it is not sharp.
    """
    stiff = FRICTION | {"damping": 0.0, "modulus": 7.5e8}
    sim = bed(fraction=0.5, contact=stiff)
    assert sim.limits[0].term == "contacts"
    bonds = min(limit.dt for limit in sim.limits if limit.term.startswith("bond"))
    assert 4.0 * sim.limits[0].dt < 0.2 * bonds
    assert gains(sim, 0.03, 0.0)[0] < 1e-3
    loose = bed(contact=stiff, fraction=4.0)
    with pytest.raises((Diverged, SceneError)):  # torn, or farther in a step than any list lasts
        loose.step(20_000)


@pytest.mark.slow
def test_half_the_limit_for_ten_seconds() -> None:
    """Pressed and left to itself at half of the limit: it calms down and stays calm."""
    _calm(10.0)


def test_half_the_limit_for_a_while() -> None:
    """The same for three tenths of a second."""
    _calm(0.3)


def _calm(time: float) -> None:
    sim = bed(fraction=0.5)
    _, rows = gains(sim, 0.06, 0.022)
    pressed = stored(rows[-1])
    last = [stored(row) for row in followed(sim, 0, time, 20)]
    assert max(last) < pressed
    assert all(b < a + 1e-3 * abs(a) for a, b in zip(last, last[1:], strict=False))
