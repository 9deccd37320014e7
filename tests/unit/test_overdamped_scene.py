"""Method `overdamped` from outside: what `check`, `run`, `info` say, its step, its summary."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf
from tests.scene_text import fiber
from tests.stress.small_cell import Shell, shell
from warpfiber.checking import check_lines

__all__ = ["shell"]  # a fixture

FLEXIBLE = Path(__file__).parents[2] / "scenes" / "sasayama_2018" / "flexible.toml"
METHOD = ("--set", "numerics.method=overdamped")


def test_check_names_method_and_step(shell: Shell) -> None:
    assert shell("check", FLEXIBLE, *METHOD) == 0
    assert re.search(r"^method +overdamped sdirk2$", shell.out, re.M)
    assert re.search(r"^dt +0\.0005 s = strain 0\.05$", shell.out, re.M)
    assert re.search(r"^steps +3200$", shell.out, re.M)
    assert "dt limit, stretching" not in shell.out
    assert shell("check", FLEXIBLE, *METHOD, "--set", "numerics.tolerance=1e-3") == 0
    assert re.search(r"^tolerance, lengths of a fiber +0\.001$", shell.out, re.M)
    assert re.search(r"^largest dt +0\.002 s = strain 0\.2$", shell.out, re.M)


def test_only_the_method_is_changed(shell: Shell) -> None:
    """The shipped scene of the flexible fiber runs without inertia by one override."""
    keys = ("stage.0.end_strain=20", "record.figures=false", "record.frames=5", "record.scalars=10")
    ends = [word for key in keys for word in ("--set", key)]
    assert shell("run", FLEXIBLE, *METHOD, *ends, "--out", shell.folder / "out", "--quiet") == 0
    summary = json.loads((shell.folder / "out" / "summary.json").read_text())
    assert summary["method"] == "overdamped"
    assert summary["steps"] == 400
    assert {"begin", "fibers", "end"} == set(summary["ns_per_segment_step_by_pass"])
    assert "energy_kinetic" not in summary["final"]
    assert summary["final"]["energy_bending"] > 0.0
    assert shell("info", shell.folder / "out") == 0
    assert shell("resume", shell.folder / "out") == 0


def test_summary_of_a_tolerance(tmp_path: Path) -> None:
    scene = fiber(numerics__method="overdamped", numerics__tolerance=1e-3, stage__0__end_strain=5)
    assert wf.Job.start(scene, out=tmp_path / "out").run() == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["rejected_steps"] >= 0
    assert 0.0 < summary["next_dt"] <= summary["dt"] == pytest.approx(0.002)


def test_a_step_beyond_a_turn_is_refused() -> None:
    with pytest.raises(wf.SceneError, match="accuracy: a strain of 0.2"):
        wf.Simulation(fiber(numerics__method="overdamped", numerics__strain_step=0.3))
    allowed = {"numerics__strain_step": 0.3, "numerics__allow_unstable_dt": True}
    simulation = wf.Simulation(fiber(numerics__method="overdamped", **allowed))
    simulation.step(3)
    assert np.isfinite(simulation.node_pos).all()


def test_a_tolerance_that_no_step_meets() -> None:
    keys = {"numerics__tolerance": 1e-300, "fibers__0__direction": [1, 0.2, 0.3]}
    simulation = wf.Simulation(fiber(numerics__method="overdamped", **keys))
    before = simulation.node_pos
    with pytest.raises(wf.Diverged, match="fiber 0 meets the tolerance with no step"):
        simulation.step()
    assert simulation.step_count == 0
    assert simulation.node_pos.tobytes() == before.tobytes()


def test_a_fluid_at_rest_needs_a_step() -> None:
    flow = {"flow__kind": "rest", "stage__0__end_time": 1.0}
    with pytest.raises(wf.SceneError, match=r"give numerics.dt in s"):
        wf.Simulation(fiber(numerics__method="overdamped", **flow))
    simulation = wf.Simulation(fiber(numerics__method="overdamped", numerics__dt=1e-3, **flow))
    before = simulation.node_pos
    simulation.step(5)
    assert np.abs(simulation.node_pos - before).max() < 1e-15
    assert not any("limit" in line and "inf" in line for line in check_lines(simulation.scene))


def test_velocity_given_for_the_start_is_noted() -> None:
    scene = fiber(numerics__method="overdamped", fibers__0__initial_velocity="rest")
    assert any("initial_velocity has no effect" in note for note in scene.notes)
