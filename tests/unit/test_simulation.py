"""`Simulation` and `Job` from Python: stages, velocities, walls without pairs, records at ends."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from warpfiber.model import EXPIRED
from warpfiber.simulation import BoxExhausted

CELL = """
[box]
size = [1.5e-4, 1.5e-4, 1.5e-4]
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
count = 20
aspect_ratio = 8
diameter = 1e-5
density = 4e9
youngs_modulus = 1e8
[[stage]]
kind = "flow"
end_strain = 0.2
[record]
figures = false
[numerics]
method = "bead_chain"
segments = 2
"""


def scene(tmp_path: Path, text: str = CELL, **overrides: Any) -> wf.Scene:
    """The cell above with overrides, `__` for the dots of a key."""
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return wf.load_scene(path, {key.replace("__", "."): v for key, v in overrides.items()})


def test_run_goes_through_all_stages(tmp_path: Path) -> None:
    """A stage by strain, then one by time: the end is their sum to within one step."""
    text = CELL.replace("[record]", '[[stage]]\nkind = "flow"\nend_time = 1e-3\n[record]')
    simulation = wf.Simulation(scene(tmp_path, text))
    simulation.run()
    assert simulation.strain == pytest.approx(0.3, abs=2.5 * 100.0 * simulation.dt)


def test_velocity_is_that_of_the_unwrapped_nodes(tmp_path: Path) -> None:
    """One step moves the unwrapped nodes by dt times the new velocity, whatever their images."""
    # gravity carries the fibers through the sheared faces
    simulation = wf.Simulation(scene(tmp_path, gravity__acceleration=[0.0, 0.0, -20.0]))
    simulation.run(until=6.0)
    assert np.abs(simulation.state.fiber_image.numpy()[:, 2]).max() > 0
    before = simulation.node_pos
    simulation.step()
    moved = (simulation.node_pos - before) / simulation.dt
    scale = np.abs(moved).max()
    np.testing.assert_allclose(simulation.node_velocity, moved, atol=1e-7 * scale)


def test_walls_hold_without_pairs(tmp_path: Path) -> None:
    """Gravity presses fibers of a cell without pair forces on the wall: none gets through it."""
    simulation = wf.Simulation(
        scene(
            tmp_path,
            contact__law="none",
            box__boundary=["periodic", "periodic", "wall"],
            gravity__acceleration=[0.0, 0.0, -5.0],
            record__quantities=["energy"],
        )
    )
    simulation.run(until=4.0)
    height = simulation.node_pos[:, 2]
    assert height.min() > 0.0
    assert height.min() < 6e-6  # some lie on it
    # potential of the walls: D0 = 1000 eta rate a^2, G0 = 50, zero at 1.0005 a
    y = np.minimum(height, 1.5e-4 - height) / 5e-6
    potential = 2.5e-4 * 5e-6 / 50.0 * (np.exp(50.0 * (1.0 - y)) - np.exp(-50.0 * 0.0005))
    expected = potential[y < 1.0005].sum()
    assert expected > 0.0
    assert simulation.measure()["energy_wall"] == pytest.approx(expected, rel=1e-9)


def test_a_rotation_is_no_flow_that_deforms(tmp_path: Path) -> None:
    """Its strain never grows: refused, with the key."""
    gradient = [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]
    text = CELL.replace("simple_shear", "gradient").replace(
        "shear_rate = 100", f"gradient = {gradient}"
    )
    with pytest.raises(wf.SceneError, match="flow.gradient"):
        scene(tmp_path, text)


def test_frames_and_ends_hold_their_own_values(tmp_path: Path) -> None:
    """Frames between rows carry their own tensor; the last row and frame are the end state."""
    job = wf.Job.start(
        scene(tmp_path, record__frames=7, record__scalars=3, record__quantities=["orientation"]),
        out=tmp_path / "run",
    )
    assert job.run() == 0
    with wf.TrajectoryReader(job.folder.trajectory_path) as reader:
        tensor = reader.values("a33_fiber")
        for frame in range(reader.frame_count):
            axis = np.asarray(reader.fiber_axis(frame), dtype=float)
            assert tensor[frame] == pytest.approx(np.mean(axis[:, 2] ** 2), abs=1e-6)
        assert reader.step[-1] == job.simulation.step_count
    rows = wf.read_scalars(job.folder.scalars_path)
    assert rows["step"][-1] == job.simulation.step_count


def test_early_faults_come_together(tmp_path: Path) -> None:
    """Device, dt and folder are checked before any fiber is placed, and reported at once."""
    (tmp_path / "run").mkdir()
    with pytest.raises(wf.SceneError) as found:
        wf.Job.start(scene(tmp_path, numerics__dt=1.0), out=tmp_path / "run", device="cuda:77")
    keys = {fault.key for fault in found.value.faults}
    assert keys == {"numerics.device", "numerics.dt", "--out"}


def test_timing_passes_leaves_nothing_pending(tmp_path: Path) -> None:
    """What a timed step asks for is done before a checkpoint could be taken without it."""
    simulation = wf.Simulation(scene(tmp_path))
    simulation.step()
    pairs = simulation.method.list
    assert pairs is not None
    builds = pairs.build_count
    status = simulation.state.status.numpy()
    status[EXPIRED] = 1
    simulation.state.status.assign(status)
    simulation.pass_times(1)
    assert pairs.build_count == builds + 1
    assert simulation.state.status.numpy()[EXPIRED] == 0


def test_short_steps_use_the_box_up(tmp_path: Path) -> None:
    """Steps that a tolerance makes short end where the box is flat, not where long ones would."""
    changes = {
        "[1.5e-4, 1.5e-4, 1.5e-4]": "[2e-4, 2e-4, 2e-4]",
        "simple_shear": "planar_extension",
        "shear_rate": "extension_rate",
        "count = 20": "count = 4",
        '"bead_chain"': '"overdamped"\ntolerance = 1e-5',
    }
    text = CELL
    for old, new in changes.items():
        text = text.replace(old, new)
    simulation = wf.Simulation(scene(tmp_path, text))
    with pytest.raises(BoxExhausted):
        simulation.step(100_000)
    assert simulation.strain == pytest.approx(simulation.method.strain_end, abs=0.01)
    simulation.close()
