"""What `[record]` asks for beyond the default reaches the files, and nothing else does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import warpfiber as wf

SCENES = Path(__file__).resolve().parents[2] / "scenes" / "sasayama_2018"


@pytest.fixture
def job(tmp_path: Path) -> wf.Job:
    """A short run of the flexible fiber with velocities, fourth-order tensor and curvature."""
    scene = wf.load_scene(
        SCENES / "flexible.toml",
        {
            "numerics.segments": 15,
            "stage.0.end_strain": 0.5,
            "record.frames": 5,
            "record.scalars": 4,
            "record.node_fields": ["velocity"],
            "record.quantities": ["orientation", "orientation4", "curvature"],
        },
    )
    job = wf.Job.start(scene, out=tmp_path / "run")
    assert job.run() == 0
    return job


def test_node_velocity_is_recorded_per_frame(job: wf.Job) -> None:
    """float32 rounding of the velocity at the end of the run."""
    with wf.TrajectoryReader(job.folder.trajectory_path) as reader:
        assert reader.frame_count == 6
        recorded = reader.node_field("node_velocity", -1)
    velocity = job.simulation.node_velocity
    np.testing.assert_allclose(recorded, velocity, rtol=1e-6, atol=1e-6 * np.abs(velocity).max())


def test_fourth_order_tensor_contracts_to_the_second(job: wf.Job) -> None:
    """A_ijkk = A_ij exactly for unit vectors: rounding only."""
    row = wf.read_scalars(job.folder.scalars_path)
    assert len(row["step"]) == 5
    last = {name: values[-1] for name, values in row.items()}
    assert last["a1111"] + last["a1122"] + last["a1133"] == pytest.approx(last["a11"], abs=1e-14)
    assert last["a1113"] + last["a1223"] + last["a1333"] == pytest.approx(last["a13"], abs=1e-14)


def test_only_what_was_asked_for_is_measured(job: wf.Job) -> None:
    """No contacts, overlaps or energies; curvature in 1/m below that of a joint at 1 rad."""
    row = wf.read_scalars(job.folder.scalars_path)
    assert not {"contacts_per_fiber", "overlap_max", "energy_bending"} & set(row)
    assert 0.0 <= row["curvature_max"][-1] < 1.0 / 3.2e-5


def test_bending_strain_is_radius_over_radius_of_curvature(job: wf.Job) -> None:
    """Fibers of one radius, 5 um: to rounding."""
    row = wf.read_scalars(job.folder.scalars_path)
    assert row["curvature_max"][-1] > 0.0
    for name in ("mean", "max"):
        np.testing.assert_allclose(
            row[f"bending_strain_{name}"], 5e-6 * row[f"curvature_{name}"], rtol=1e-12
        )
