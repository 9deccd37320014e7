"""Beds that are pulled and sheared: stiffness of a fiber, balance of forces, what grips hold."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from tests.reference import bonded_spheres as ref
from tests.rods import start_rods
from warpfiber.methods.grips import Grips
from warpfiber.passes.bonds import CLAMPED, FREE, LOWER, UPPER
from warpfiber.scene import SceneError
from warpfiber.simulation import Simulation

RADIUS, STEP, MODULUS, POISSON = 1.2e-3, 2.4e-3, 7.5e5, 0.5
EDGE, HEIGHT = 0.03, 0.05
AREA = math.pi * RADIUS**2
BOX = {"size": [EDGE, EDGE, HEIGHT], "boundary": ["periodic", "periodic", "wall"]}
HAIR = 1e-8  # m, from a plane of a grip to the node just inside: more than float32 rounds


def grips_of(sim: Simulation) -> Grips:
    """The grips of a simulation."""
    grips = sim.method.grips  # type: ignore[attr-defined]
    assert isinstance(grips, Grips)
    return grips


def upright(segments: int, foot: float = 0.01, tilt: float = 0.0, **keys: Any) -> ref.Rod:
    """A fiber that stands, or leans by `tilt` (rad) in the x-z plane."""
    along = np.arange(segments + 1)[:, None] * STEP
    ahead = np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    rest = np.array([0.5 * EDGE, 0.5 * EDGE, foot]) + along * ahead
    return ref.Rod(rest, RADIUS, modulus=MODULUS, caps="capsule", **keys)


def draw(kind: str, below: float, above: float, speed: float, **keys: Any) -> dict[str, Any]:
    """A stage of two grips that just take in nodes at these heights."""
    planes = {"freeze_below": below + HAIR, "freeze_above": above - HAIR}
    return {"kind": kind, **planes, "speed": speed, "end_strain": 0.01, **keys}


def drawn(rods: list[ref.Rod], stage: dict[str, Any], **keys: Any) -> Simulation:
    """Rods without weight or contact in a stage."""
    keys = {"contact": {"law": "none"}, "quantities": ["stress", "energy"]} | keys
    return start_rods(rods, box=BOX, stage=[stage], **keys)


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_modulus_of_one_fiber(precision: str) -> None:
    """One bond between two grips: E A strain on either, E A L_s strain^2 / 2 of work."""
    rod = upright(3)
    stage = draw("pull", 0.01 + STEP, 0.01 + 2.0 * STEP, 0.01, freeze="nodes")
    sim = drawn([rod], stage, numerics={"precision": precision, "dt": 1e-6})
    sim.run()
    strain = 0.01 * sim.time / STEP
    row = sim.measure()
    assert row["grip_strain"] == pytest.approx(strain * STEP / (STEP - 2.0 * HAIR), rel=1e-9)
    assert strain == pytest.approx(0.01, rel=1e-3)
    found = grips_of(sim).grip.numpy() * sim.model.units.force
    pull = MODULUS * AREA * strain
    # lengths are differences of places that are rounded at 0.015 m; in float32 only where it starts
    eps = float(np.finfo(sim.model.precision.numpy).eps)
    error = 10.0 * eps * 0.015 / (strain * STEP) + 1e-9
    assert found[1, 2] == pytest.approx(-pull, rel=error)
    assert found[0, 2] == pytest.approx(pull, rel=error)
    # the mean of a ramp lags 49 steps behind
    late = pull * 49.0 * sim.dt / sim.time
    assert row["stress_zz"] * EDGE**2 == pytest.approx(pull - late, rel=2.0 * error)
    assert row["stress_zz_low"] == pytest.approx(row["stress_zz"], rel=1e-12)
    assert abs(row["stress_xz"]) < 1e-9 * row["stress_zz"]
    work = 0.5 * pull * strain * STEP
    # the first of n trapezoids is missing its lower half: (1 / n)^2
    assert row["grip_work"] == pytest.approx(work, rel=2.0 * error + 2.0 / sim.step_count**2)
    result = sim.method.stage_result(sim.scene.stages[0])
    assert result["yield_stress_zz"] == pytest.approx(row["stress_zz"], rel=1e-12)
    assert result["yield_strain"] == pytest.approx(row["grip_strain"], rel=1e-12)


@pytest.mark.parametrize("segments", [1, 6])
def test_shear_of_a_clamped_fiber(segments: int) -> None:
    """Moved sideways between two clamps: 1 / (L^3 / 12 E I + L / G A) of a Timoshenko beam."""
    rod = upright(segments + 2, damping=1.0)
    length = segments * STEP
    speed = 2e-3 * length
    stage = draw("shear", 0.01 + STEP, 0.01 + STEP + length, speed, freeze="nodes")
    stage["end_strain"] = 1e-3
    sim = drawn([rod], stage, numerics={"dt_fraction": 0.1} if segments > 1 else {"dt": 1e-5})
    sim.run()
    inertia = math.pi * RADIUS**4 / 4.0
    shear = MODULUS / (2.0 * (1.0 + POISSON)) * AREA
    stiffness = 1.0 / (length**3 / (12.0 * MODULUS * inertia) + length / shear)
    found = grips_of(sim).grip.numpy() * sim.model.units.force
    push = stiffness * speed * sim.time
    # dashpots: b sqrt(2 m K) v over K x, b = 1, of a time of 1e-4 s in 0.5 s; angle squared
    assert found[1, 0] == pytest.approx(-push, rel=2e-3)
    assert found[0, 0] == pytest.approx(push, rel=2e-3)


def tangle(**keys: Any) -> Simulation:
    """Leaning fibers that touch and meet both grips, with friction."""
    rods = [upright(8, 0.004 + 0.002 * k, 0.3 * (-1) ** k, damping=0.0335) for k in range(3)]
    for k, rod in enumerate(rods):
        rod.rest[:, 1] += (k - 1) * 1.9 * RADIUS
        rods[k] = ref.Rod(rod.rest, RADIUS, modulus=MODULUS, caps="capsule", damping=0.0335)
    stage = draw(keys.pop("kind", "pull"), 0.008, 0.02, 0.2, freeze="nodes", end_strain=1.0)
    contact = {"law": "hertz", "friction": 1.0, "damping": 0.113}
    open_top = {"size": [EDGE, EDGE, HEIGHT], "boundary": ["periodic", "periodic", "open"]}
    return start_rods(
        rods,
        box=open_top,
        contact=contact,
        stage=[stage],
        quantities=["stress", "energy", "contacts"],
        **keys,
    )


@pytest.mark.parametrize("kind", ["pull", "shear"])
def test_the_rest_gains_what_the_grips_give(kind: str) -> None:
    """Momentum of the free nodes changes by minus the forces on both grips, step by step."""
    sim = tangle(kind=kind)
    free = sim.method.holds.hold.numpy() == FREE  # type: ignore[attr-defined]
    mass = np.concatenate([upright(8).mass] * 3)
    grips, force = grips_of(sim), sim.model.units.force

    def momentum() -> np.ndarray:
        values: np.ndarray = (mass[free, None] * sim.node_velocity[free]).sum(axis=0)
        return values

    sim.step(200)
    assert sim.measure()["contacts_per_fiber"] > 0.0
    largest = 0.0
    for _ in range(20):
        before, acted = momentum(), grips.grip.numpy().sum(axis=0)
        sim.step()
        acted = 0.5 * (acted + grips.grip.numpy().sum(axis=0)) * force
        largest = max(largest, float(np.abs(acted).max()))
        gained = (momentum() - before) / sim.dt
        # differences of momentum: eps m v / dt
        assert np.abs(gained + acted).max() < 1e-9 * max(largest, 1.0)
    assert largest > 1e-3


def test_workers_and_resume() -> None:
    """1 = 2 = 3 workers, steps in odd parts, and a restored run, to the last bit."""
    runs = [tangle(workers=n) for n in (1, 2, 3)]
    for sim in runs:
        sim.step(300)
    parts, again = tangle(), tangle()
    for count in (1, 7, 142):
        parts.step(count)
    again.restore(parts.snapshot())
    again.begin_stage(again.scene.stages[0], resumed=True)
    for sim in (parts, again):
        sim.step(150)
    first = runs[0].snapshot()
    assert first["grips_grip"].any()
    for other in (*runs[1:], parts, again):
        for name, value in other.snapshot().items():
            assert value.tobytes() == first[name].tobytes(), name
    for sim in (*runs, parts, again):
        sim.close()


def holds(sim: Simulation) -> list[list[int]]:
    """How the nodes are held, fiber by fiber."""
    found = sim.method.holds.hold.numpy()  # type: ignore[attr-defined]
    return [part.tolist() for part in np.split(found, sim.fiber_node_start[1:-1])]


def test_what_is_gripped() -> None:
    """Fibers: whole ones that reach into a grip, the one that holds more, else the lower.

    Nodes: those inside.
    """
    low, high, between = upright(3, 0.01), upright(3, 0.018), upright(1, 0.014)
    rods = [low, high, upright(6, 0.01), upright(6, 0.01 + STEP), upright(6, 0.0105), between]
    planes = draw("pull", 0.01 + STEP, 0.018 + 2.0 * STEP, 0.1)
    whole = drawn(rods, planes)
    assert holds(whole) == [
        [LOWER] * 4,
        [UPPER] * 4,
        [LOWER] * 7,
        [UPPER] * 7,
        [LOWER] * 7,
        [FREE, FREE],
    ]
    nodes = drawn(rods, planes | {"freeze": "nodes"})
    assert holds(nodes)[:2] == [[LOWER, LOWER, FREE, FREE], [FREE, FREE, UPPER, UPPER]]
    with pytest.raises(SceneError) as caught:
        drawn([upright(3)], draw("pull", 0.005, 0.03, 0.1))
    assert [fault.key for fault in caught.value.faults] == [
        "stage 'pull': freeze_below",
        "stage 'pull': freeze_above",
    ]
    assert "between 0.01 and 0.0172 m" in str(caught.value)


def test_grips_let_go() -> None:
    """Held nodes move as told and do not turn; afterwards only what a load holds is held."""
    stages = [
        draw("pull", 0.01, 0.01 + 6.0 * STEP, 0.1, end_strain=0.05, freeze="nodes"),
        {"kind": "settle", "end_time": 0.01},
    ]
    rod = upright(6, tilt=0.0)
    keys: dict[str, Any] = {"load": [{"node": 0, "hold": "clamp"}], "contact": {"law": "none"}}
    sim = start_rods([rod], box=BOX, stage=stages, quantities=["stress"], **keys)
    spins = np.full((7, 3), 0.01)
    sim.method.node_spin.assign(spins)  # type: ignore[attr-defined]
    sim.begin_stage(sim.scene.stages[0])
    sim.step(50)
    moved = sim.node_pos - rod.rest
    assert moved[0].tolist() == [0.0, 0.0, 0.0]
    assert moved[6] == pytest.approx([0.0, 0.0, 0.1 * sim.time], abs=1e-15)
    turn = sim.method.node_turn.numpy()  # type: ignore[attr-defined]
    assert turn[0].tolist() == turn[6].tolist() == [0.0, 0.0, 0.0, 1.0]
    assert turn[3].tolist() != [0.0, 0.0, 0.0, 1.0]
    sim.begin_stage(sim.scene.stages[1])
    assert holds(sim) == [[CLAMPED] + [FREE] * 6]
    sim.step(50)
    assert math.isnan(sim.measure()["stress_zz"])
    assert not math.isclose(sim.node_velocity[6, 2], 0.1, rel_tol=1e-3)
    assert sim.method.stage_result(sim.scene.stages[1]) == {}


SCENE = """
seed = 2
[box]
size = [0.02, 0.02, 0.08]
boundary = ["periodic", "periodic", "wall"]
[gravity]
[[fibers]]
count = 24
length = 0.0144
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
bond_damping = 0.0335
[contact]
damping = 0.113
friction = 1.4
wall_friction = 0.6
[[stage]]
kind = "settle"
damping = 30
end_time = 0.1
[[stage]]
kind = "compress"
wall = "z+"
speed = 0.3
end_volume_fraction = 0.35
[[stage]]
kind = "pull"
freeze_below = 0.003
freeze_above = 0.006
speed = 0.2
end_strain = 2
[[stage]]
kind = "shear"
freeze_below = 0.003
freeze_above = 0.008
speed = 0.2
end_strain = 1
[record]
scalars = 500
frames = 5
figures = false
quantities = ["stress", "energy"]
[numerics]
method = "bonded_spheres"
segment_length = 2.4e-3
"""


def test_yield_of_a_bed(tmp_path: Path) -> None:
    """Rows, yield values and a stop amid the pull that leaves no trace; the bed is free on top."""
    path = tmp_path / "bed.toml"
    path.write_text(SCENE)
    scene = wf.load_scene(path)
    whole = wf.Job.start(scene, out=tmp_path / "whole")
    assert whole.run() == 0
    table = np.genfromtxt(tmp_path / "whole" / "scalars.csv", delimiter=",", names=True)
    gripped = np.isfinite(table["grip_strain"])
    strain = table["grip_strain"][gripped]
    turn = int(np.argmin(np.diff(strain))) + 1  # where the second gripping stage begins
    pull, shear = table[gripped][:turn], table[gripped][turn:]
    assert table["pressure_high"][~gripped].max() > 0.0
    assert pull["pressure_high"][-1] < 1e-6 * table["pressure_high"].max()
    results = json.loads((tmp_path / "whole" / "summary.json").read_text())["stages"]
    assert [result["stage"] for result in results] == ["pull", "shear"]
    # the largest of all steps is met by rows every few steps up to the change between two rows
    most = results[0]["yield_stress_zz"]
    assert most > 0.0
    assert 0.8 * most < pull["stress_zz"].max() <= most * (1.0 + 1e-12)
    at = pull["grip_strain"][np.argmax(pull["stress_zz"])]
    assert results[0]["yield_strain"] == pytest.approx(at, abs=0.05)
    steady = shear["stress_xz"][shear["grip_strain"] > 0.5]
    assert results[1]["from_strain"] == pytest.approx(0.5, abs=1e-3)
    scatter = results[1]["standard_deviation"]
    assert results[1]["yield_stress_xz"] == pytest.approx(steady.mean(), abs=0.3 * scatter)
    assert scatter == pytest.approx(steady.std(), rel=0.2)

    job = wf.Job.start(scene, out=tmp_path / "parts")

    class Stop:
        """Asks for a stop amid the pull."""

        exit_code = 130
        at = float(pull["time"][len(pull) // 2])

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.time > self.at else ""

    assert job.run(Stop()) == 130
    job = wf.Job.resume(tmp_path / "parts")
    assert job.run() == 0
    rows = [(tmp_path / name / "scalars.csv").read_text() for name in ("whole", "parts")]
    assert rows[0] == rows[1]
    assert json.loads((tmp_path / "parts" / "summary.json").read_text())["stages"] == results


def test_the_top_of_the_box(tmp_path: Path) -> None:
    """A grip that reaches the upper wall ends the run with what to do; the state is kept."""
    path = tmp_path / "bed.toml"
    path.write_text(SCENE)
    keys = {"box.size": [0.02, 0.02, 0.05], "stage.2.end_strain": 20, "stage.0.end_time": 0.01}
    job = wf.Job.start(wf.load_scene(path, keys), out=tmp_path / "out")
    assert job.run() == 3
    failure = json.loads((tmp_path / "out" / "summary.json").read_text())["failure"]
    assert "top of the box" in failure["message"] and "stage 'pull'" in failure["message"]
