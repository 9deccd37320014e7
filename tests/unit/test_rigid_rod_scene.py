"""Methods `rigid_rod` and `auto` from outside: what is chosen and why, what is said of it."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf
from tests.scene_text import GONE, changed, fiber, read
from tests.stress.small_cell import Shell, shell
from warpfiber.checking import check_lines
from warpfiber.scene import scene_from_dict

__all__ = ["shell"]  # a fixture

ROD = """
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
count = 1
aspect_ratio = 100
diameter = 1e-5
density = 2500
youngs_modulus = 2e13
orientation = "aligned"
[contact]
law = "none"
[[stage]]
kind = "flow"
end_strain = 30
[record]
figures = false
frames = 3
scalars = 6
quantities = ["orientation", "rotation"]
[numerics]
method = "auto"
segments = 9
"""
# eta rate = 1e4 Pa: S_eff = 0.98 at E = 2e13, where bending shifts the period by 1.65e-5.


def test_a_stiff_fiber_is_a_rod() -> None:
    scene = read(ROD)
    assert scene.numerics.method == "rigid_rod"
    assert scene.numerics.segments == scene.fibers[0].segments == 1
    assert "1.6e-5 of its length, tolerance 0.001" in (scene.method_reason or "")
    assert scene.as_dict()["method_reason"] == scene.method_reason
    assert scene_from_dict(scene.as_dict()) == scene
    alone = read(ROD, numerics__method="rigid_rod", numerics__segments=1)
    assert alone.method_reason is None
    assert alone.hash == scene.hash


CHOICES: list[tuple[dict[str, object], str, str]] = [
    ({"numerics__tolerance": 1e-5}, "overdamped", "above the tolerance 1e-5"),
    ({"numerics__tolerance": 1e-4}, "rigid_rod", "tolerance 0.0001"),
    ({"fibers__0__youngs_modulus": 5e11}, "overdamped", "may buckle fibers.0"),
    ({"fibers__0__bending_modulus": 0}, "overdamped", "may buckle fibers.0"),
    ({"fibers__0__axial_modulus": 1e8}, "overdamped", "stretch of fibers.0"),
    (
        {"fibers__0__axial_modulus": 1e8, "fibers__0__inextensible": True},
        "rigid_rod",
        "bending of fibers.0",
    ),
    ({"flow__schedule": [[0.0, 1.0], [2.0, 50.0]]}, "overdamped", "may buckle"),
    ({"numerics__closure": "paper"}, "bead_chain", 'cannot run numerics.closure = "paper"'),
    ({"fibers__0__initial_velocity": "rest"}, "bead_chain", "asks for inertia"),
    ({"fibers__0__frozen": True}, "overdamped", "rigid_rod cannot run fibers.0.frozen"),
    ({"contact__law": "exponential"}, "overdamped", "bending of fibers.0 by contact"),
    (
        {"contact__law": "exponential", "numerics__integrator": "bdf2"},
        "bead_chain",
        'overdamped cannot run numerics.integrator = "bdf2"',
    ),
]


@pytest.mark.parametrize(("keys", "method", "reason"), CHOICES)
def test_choice(keys: dict[str, object], method: str, reason: str) -> None:
    scene = read(ROD, **keys)
    assert scene.numerics.method == method
    assert reason in (scene.method_reason or "")
    assert scene.fibers[0].segments == (1 if method == "rigid_rod" else 9)


def test_contact_asks_for_more_stiffness() -> None:
    """Where fibers meet, what bends them is contact: S_eff of 1 is not enough, 1000 is."""
    soft = read(ROD, contact__law="exponential")
    stiff = read(ROD, contact__law="exponential", fibers__0__youngs_modulus=2e16)
    assert soft.numerics.method == "overdamped"
    assert "bending of fibers.0 by contact" in (soft.method_reason or "")
    assert stiff.numerics.method == "rigid_rod"


def test_the_least_stiff_group_decides() -> None:
    tables = changed({"contact": {"law": "none"}, "numerics": {"method": "auto", "segments": 2}})
    tables["box"]["boundary"] = ["periodic"] * 3
    stiff = scene_from_dict(tables)
    assert stiff.numerics.method == "rigid_rod"
    tables["fibers"].append(tables["fibers"][0] | {"youngs_modulus": 1e7})
    both = scene_from_dict(tables)
    assert both.numerics.method == "overdamped"
    assert "fibers.1" in (both.method_reason or "")


def test_faults_are_those_of_the_method_that_comes_nearest() -> None:
    """A scene that nothing runs is reported once, by the method with the fewest faults."""
    with pytest.raises(wf.SceneError) as found:
        read(ROD, flow__viscosity=-1)
    assert [fault.key for fault in found.value.faults] == ["flow.viscosity"]
    tables = changed({"numerics.method": "auto", "flow": GONE, "stage.0.end_time": 1})
    with pytest.raises(wf.SceneError) as found:
        scene_from_dict(tables)
    assert [fault.key for fault in found.value.faults] == ["flow"]
    assert "bead_chain moves fibers by drag" in found.value.faults[0].remedy


def test_fibers_in_a_fluid_at_rest_are_rods() -> None:
    keys = {"flow__kind": "rest", "stage__0__end_time": 1.0, "gravity__fluid_density": 1000}
    scene = read(ROD, numerics__dt=0.01, **keys)
    assert scene.numerics.method == "rigid_rod"
    with pytest.raises(wf.SceneError, match=r"give numerics.dt in s"):
        wf.Simulation(read(ROD, **keys))


@pytest.mark.parametrize(
    ("modulus", "method"), [(1e5, "overdamped"), (1e7, "overdamped"), (1e11, "rigid_rod")]
)
def test_weight_bends_what_lies_on_a_wall(modulus: float, method: str) -> None:
    """W L^2/(75 E I) with W = 1500 pi a^2 L 9.81: 9e-2, 9e-4 and 9e-8 of L, tolerance 1e-3 / 10."""
    keys: dict[str, object] = {
        "flow__kind": "rest",
        "box__size": [2e-3, 2e-3, 2e-3],
        "box__boundary": ["periodic", "periodic", "wall"],
        "contact__law": "exponential",
        "gravity__fluid_density": 1000,
        "stage__0__end_time": 1.0,
        "fibers__0__youngs_modulus": modulus,
        "fibers__0__aspect_ratio": 120,
    }
    scene = read(ROD, numerics__dt=0.01, **keys)
    assert scene.numerics.method == method
    assert scene.rod_trial is None
    bent = 1500.0 * 9.81 * math.pi * 5e-6**2 * 1.2e-3**3
    bent /= 75.0 * modulus * 0.25 * math.pi * 5e-6**4
    assert f"under its weight up to {bent:.2g}".replace("e-0", "e-") in str(scene.method_reason)


def test_check_and_run_name_method_and_reason(shell: Shell) -> None:
    path = shell.folder / "rod.toml"
    path.write_text(ROD)
    assert shell("check", path) == 0
    assert re.search(r"^method +rigid_rod$", shell.out, re.M)
    assert re.search(
        r"^chosen by auto +bending of fibers.0 by the flow up to 1.6e-5", shell.out, re.M
    )
    assert re.search(r"^dt limit +none: maps of the flow are exact$", shell.out, re.M)
    assert re.search(r"^dt +0\.0005 s = strain 0\.05$", shell.out, re.M)
    assert re.search(r"^steps +600$", shell.out, re.M)
    assert shell("run", path, "--out", shell.folder / "out", "--quiet") == 0
    summary = json.loads((shell.folder / "out" / "summary.json").read_text())
    assert summary["method"] == "rigid_rod"
    assert summary["method_reason"].startswith("bending of fibers.0 by the flow")
    assert summary["dt_limit"] is None
    assert {"begin", "maps", "fibers", "end"} == set(summary["ns_per_segment_step_by_pass"])
    log = (shell.folder / "out" / "log.txt").read_text()
    assert "method rigid_rod by auto (bending of fibers.0" in log.splitlines()[0]
    scene = json.loads((shell.folder / "out" / "scene.json").read_text())
    assert scene["numerics"]["method"] == "rigid_rod"
    assert shell("info", shell.folder / "out") == 0


def test_any_step_is_taken() -> None:
    """No limit: half a period in three steps, with the angle of the exact orbit at its end."""
    keys = {"numerics__method": "rigid_rod", "numerics__segments": 1}
    simulation = wf.Simulation(read(ROD, numerics__strain_step=70.0, **keys))
    simulation.step(3)
    r_e = math.sqrt(5000.5)
    p = np.diff(simulation.node_pos, axis=0)[0]
    expected = -math.tan(210.0 / (r_e + 1.0 / r_e)) / r_e
    assert p[2] / p[0] == pytest.approx(expected, rel=1e-9)


def test_a_step_beyond_contact_is_refused() -> None:
    """Fibers would pass through each other in larger ones, or be tried in ever smaller steps."""
    keys = {"numerics__method": "rigid_rod", "numerics__segments": 1}
    keys |= {"contact__law": "exponential", "numerics__strain_step": 0.3}
    with pytest.raises(wf.SceneError, match=r"numerics\.dt .*contact: a strain of 0\.2"):
        wf.Simulation(read(ROD, **keys))
    wf.Simulation(read(ROD, numerics__allow_unstable_dt=True, **keys)).close()


def test_nodes_from_a_file(tmp_path: Path) -> None:
    """Two nodes are a rod; more are refused before anything is written."""
    ends = np.array([[[0.0, 0, 0], [9e-5, 0, 0]], [[0.0, 5e-5, 0], [0, 1.4e-4, 0]]])
    np.savez(tmp_path / "two.npz", node_pos=ends)
    middle = np.concatenate([ends[:, :1], ends.mean(axis=1, keepdims=True), ends[:, 1:]], axis=1)
    np.savez(tmp_path / "three.npz", node_pos=middle)
    tables = {
        "flow": {"kind": "simple_shear", "shear_rate": 100, "viscosity": 100},
        "fibers": [{"node_file": "two.npz", "diameter": 1e-5, "youngs_modulus": 1e10}],
        "contact": {"law": "none"},
        "stage": [{"kind": "flow", "end_strain": 1}],
        "numerics": {"method": "rigid_rod"},
    }
    scene = scene_from_dict(tables, str(tmp_path / "scene.toml"))
    simulation = wf.Simulation(scene)
    simulation.step(5)
    length = np.linalg.norm(np.diff(simulation.node_pos.reshape(2, 2, 3), axis=1), axis=2)
    assert length == pytest.approx(9e-5, rel=1e-14)
    tables["fibers"][0]["node_file"] = "three.npz"  # type: ignore[index]
    scene = scene_from_dict(tables, str(tmp_path / "scene.toml"))
    with pytest.raises(wf.SceneError, match=r"fibers\.0\.node_file.*a rod has 2"):
        wf.Job.start(scene, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    tables["numerics"] = {"method": "auto", "dt": 1e-4}
    bent = scene_from_dict(tables, str(tmp_path / "scene.toml"))
    assert bent.numerics.method == "overdamped"
    assert "the node file of fibers.0 may hold bent fibers" in (bent.method_reason or "")


def test_velocity_given_for_the_start_is_noted() -> None:
    keys = {"numerics__method": "rigid_rod", "numerics__segments": 1}
    scene = fiber(fibers__0__initial_velocity="rest", **keys)
    assert any("initial_velocity has no effect in method rigid_rod" in n for n in scene.notes)
    assert any(line.startswith("dt ") for line in check_lines(scene))
