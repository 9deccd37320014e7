"""Layers through the thickness against the restatement: pieces, volumes, both weightings, files.

Tolerances: sums of 40 fibers, k eps with k = 1e3; in float32 positions are rounded to 1e-7 of the
box, which moves each cut by that part of a segment of a twentieth of the box: 1e-5.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

import warpfiber as wf
from tests.cell import Kind, bent_fiber, place
from tests.reference.layers import layer_columns
from tests.scene_text import changed, faults_of
from warpfiber.output.columns import column_meaning
from warpfiber.output.scalars import read_scalars
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

KINDS = (Kind(3, 4.0), Kind(5, 2.5, radius=0.5))
HEIGHT = 32.0
COUNT = 8
ROUNDING = {"float64": 1e3 * 2.3e-16, "float32": 1e-5}


def simulation(fibers: list[Any], kind: list[int], boundary: str, **keys: Any) -> Simulation:
    """Fibers as given in a box of 50 x 60 x 32 m without flow."""
    counts = np.bincount(kind, minlength=len(KINDS))
    scene = scene_from_dict(
        {
            "box": {"size": [50.0, 60.0, HEIGHT], "boundary": ["periodic", "periodic", boundary]},
            "flow": {"kind": "rest", "viscosity": 1.0},
            "fibers": [k.table(int(n)) for k, n in zip(KINDS, counts, strict=True)],
            "contact": {"law": "none", "strength": 1.0} if boundary == "wall" else {"law": "none"},
            "stage": [{"kind": "flow", "end_time": 1.0}],
            "record": {"layers": COUNT, "quantities": ["orientation", "orientation4"]},
            "numerics": {
                "method": "bead_chain",
                "segments": [k.segments for k in KINDS],
                "device": "cpu",
                **keys,
            },
        }
    )
    return Simulation(scene, placement=place(fibers, kind))


def some_fibers(low: float, high: float) -> tuple[list[Any], list[int]]:
    """40 bent fibers with centers between two heights, those of a kind together."""
    rng = np.random.default_rng(5)
    kind = [0] * 25 + [1] * 15
    center = [50.0, 60.0, 0.0] * rng.random((40, 3)) + [0, 0, 1] * rng.uniform(low, high, (40, 1))
    return [bent_fiber(KINDS[k], rng, c) for k, c in zip(kind, center, strict=True)], kind


def assert_profile(sim: Simulation, fibers: list[Any], kind: list[int], tolerance: float) -> None:
    """The measured layers are those of the restatement."""
    found = sim.measure_layers()
    long = [KINDS[k].aspect_ratio * 2.0 * KINDS[k].radius for k in kind]
    volume = [np.pi * KINDS[k].radius ** 2 * size for k, size in zip(kind, long, strict=True)]
    periodic = sim.model.domain.periodic[2]
    wanted = layer_columns(fibers, HEIGHT, COUNT, periodic, long, volume, 50.0 * 60.0)
    for name, values in wanted.items():
        if name.startswith("tensor"):
            continue
        scale = np.nanmax(np.abs(values))
        np.testing.assert_allclose(found[name], values, atol=tolerance * scale, err_msg=name)
    for ending, tensor in (("", "tensor"), ("_fiber", "tensor_fiber")):
        for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)):
            name = f"a{i + 1}{j + 1}{ending}"
            np.testing.assert_allclose(
                found[name], wanted[tensor][:, i, j], atol=tolerance, err_msg=name
            )
        for index in ((0, 0, 0, 0), (0, 0, 1, 2), (0, 1, 1, 2), (2, 2, 2, 2), (1, 2, 2, 2)):
            name = "a" + "".join(str(i + 1) for i in index) + ending
            values = wanted[tensor.replace("tensor", "tensor4")][(slice(None), *index)]
            np.testing.assert_allclose(found[name], values, atol=tolerance, err_msg=name)


@pytest.mark.parametrize("precision", ["float64", "float32"])
@pytest.mark.parametrize("boundary", ["periodic", "wall"])
def test_layers_hold_what_is_cut_at_their_planes(boundary: str, precision: str) -> None:
    """Across a periodic face some fibers reach far out of the box; walls hold them all."""
    low, high = (-HEIGHT, 2.0 * HEIGHT) if boundary == "periodic" else (13.0, 19.0)
    fibers, kind = some_fibers(low, high)
    sim = simulation(fibers, kind, boundary, precision=precision)
    assert_profile(sim, fibers, kind, ROUNDING[precision])


def test_cuts_at_named_places() -> None:
    """Level, upright, from plane to plane, on the floor, over more than a whole period."""
    thick = HEIGHT / COUNT
    starts = [
        ([5.0, 5.0, 2.0 * thick], [1.0, 0.0, 0.0], 8.0),
        ([5.0, 9.0, 0.0], [0.0, 1.0, 0.0], 8.0),
        ([5.0, 20.0, thick], [0.0, 0.0, 1.0], thick),
        ([5.0, 30.0, 3.5 * thick], [0.0, 0.0, -1.0], thick),
        ([5.0, 40.0, 1.0], [0.6, 0.0, 0.8], 1.5 * HEIGHT),
    ]
    fibers = [np.array(x) + np.arange(4)[:, None] * np.array(p) * long for x, p, long in starts] + [
        bent_fiber(KINDS[1], np.random.default_rng(1), (20.0, 20.0, 20.0))
    ]
    kind = [0] * len(starts) + [1]
    sim = simulation(fibers, kind, "periodic")
    assert_profile(sim, fibers, kind, ROUNDING["float64"])


def test_all_layers_together_are_the_whole_cell() -> None:
    """Length-weighted sums over layers, and votes, give the tensors of `scalars.csv`."""
    fibers, kind = some_fibers(0.0, HEIGHT)
    sim = simulation(fibers, kind, "periodic")
    layers, whole = sim.measure_layers(), sim.measure()
    for name in ("a11", "a13", "a23", "a1111", "a1233", "a2222"):
        by_length = np.average(layers[name], weights=layers["length"])
        assert by_length == pytest.approx(whole[name], abs=ROUNDING["float64"])
        votes = layers["fibers"]
        by_number = np.nansum(layers[f"{name}_fiber"] * votes) / votes.sum()
        assert by_number == pytest.approx(whole[f"{name}_fiber"], abs=ROUNDING["float64"])
    assert layers["fibers"].sum() == 40


def test_layers_of_a_leaning_box_follow_its_third_vector() -> None:
    """A box sheared by half its length has the same layers along z as the upright one."""
    fibers, kind = some_fibers(-HEIGHT, 2.0 * HEIGHT)
    sim = simulation(fibers, kind, "periodic")
    upright = sim.measure_layers()
    lattice = sim.state.lattice.numpy()
    lattice[0, 0, 2] = 0.5 * lattice[0, 0, 0]
    sim.state.lattice.assign(lattice)
    for name, values in sim.measure_layers().items():
        np.testing.assert_allclose(values, upright[name], rtol=1e-12, atol=1e-12, err_msg=name)


def test_files_hold_the_layers_of_every_frame(tmp_path: Path) -> None:
    """`layers.csv` has a row per layer and frame, the trajectory the same numbers as an array."""
    tables = changed({"record.layers": 4, "record.frames": 3, "stage.0.end_strain": 0.02})
    job = wf.Job.start(scene_from_dict(tables), out=tmp_path / "run")
    assert job.run() == 0
    table = read_scalars(tmp_path / "run" / "layers.csv")
    assert len(table["step"]) == 4 * 4
    assert list(table["layer"][:5]) == [0, 1, 2, 3, 0]
    final = job.simulation.measure_layers()
    with h5py.File(tmp_path / "run" / "run.vtkhdf") as file:
        columns = json.loads(file["warpfiber"].attrs["layer_columns"])
        recorded = file["warpfiber/layers"][-1]
        assert file["warpfiber/a11"].attrs["meaning"] == column_meaning("a11")[1]
    assert list(columns) == list(final)
    for k, (name, column) in enumerate(final.items()):
        np.testing.assert_array_equal(table[name][-4:], column)
        np.testing.assert_array_equal(recorded[:, k], column)
        assert columns[name][1] == column_meaning(name)[1]
    assert column_meaning("a11")[1] != column_meaning("a11_fiber")[1]
    lines = (tmp_path / "run" / "columns.csv").read_text().splitlines()
    named = {tuple(line.split(",")[:2]) for line in lines[1:]}
    assert named == {("layers.csv", name) for name in table} | {
        ("scalars.csv", name) for name in read_scalars(tmp_path / "run" / "scalars.csv")
    }
    assert all(line.split(",", 3)[3] for line in lines)


def test_layers_need_a_box() -> None:
    """A cell without a box has no height to divide."""
    tables = changed({"record.layers": 4, "contact.lubrication": "none", "contact.law": "none"})
    del tables["box"]
    assert [fault.key for fault in faults_of(tables)] == ["record.layers"]
