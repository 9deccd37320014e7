"""Scenes at the edges of what can be asked for: a finite result or a clear error, nothing lost."""

from __future__ import annotations

import re

import numpy as np
import pytest

from tests.stress.small_cell import CELL, Shell, shell
from warpfiber.output import TrajectoryReader, checkpoint_paths, read_checkpoint
from warpfiber.scene import load_scene
from warpfiber.simulation import Diverged, Simulation

__all__ = ["shell"]  # a fixture

EVERYTHING = (
    'record.quantities=["orientation", "orientation4", "interactions", "contacts", "overlap", '
    '"axial_strain", "energy", "rotation"]'
)
PERIODIC = 'box.boundary=["periodic", "periodic", "periodic"]'


def _finite(shell: Shell, out: str) -> dict[str, np.ndarray]:
    """Rows of a run; all of them, all frames and the last state are finite."""
    rows = shell.rows(out)
    assert all(np.isfinite(column).all() for column in rows.values())
    with TrajectoryReader(shell.folder / out / "run.vtkhdf") as reader:
        for frame in range(reader.frame_count):
            assert np.isfinite(reader.node_pos(frame)).all()
    arrays, _ = read_checkpoint(checkpoint_paths(shell.folder / out)[0])
    assert all(np.isfinite(values).all() for values in arrays.values())
    return rows


def _edited(text: str, *edits: tuple[str, str]) -> str:
    for old, new in edits:
        assert old in text, old
        text = text.replace(old, new)
    return text


# -- diverging ------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_a_diverged_run_says_why_and_keeps_its_last_good_state(
    shell: Shell, precision: str
) -> None:
    # the stiffness that sets the limit is the axial one: 3 times its dt must tear a segment
    stiff = ("fibers.0.youngs_modulus=1e12", f"numerics.precision={precision}")
    assert shell.run("good", "stage.0.end_strain=1e-4", *stiff) == 0
    assert shell.summary("good")["dt_limit_term"] == "stretching"
    limit = shell.summary("good")["dt_limit"]
    settings = (
        *stiff,
        f"numerics.dt={3.0 * limit!r}",
        "numerics.allow_unstable_dt=true",
        "record.scalars=5000",
    )
    assert shell.run("out", *settings) == 3
    words = r"diverged at step \d+, time \S+ s, .*fiber \d+ is torn at node \d+ .*largest term: "
    assert re.search(words + r"(stretching|bending|hydrodynamic torque|contact|drag)", shell.err)
    assert f"limit {limit:.4g} s set by stretching" in shell.err
    folder = shell.folder / "out"
    summary = shell.summary("out")
    assert summary["outcome"] == "diverged"
    assert summary["failure"]["largest_term"] in shell.err
    assert checkpoint_paths(folder)[0].name in shell.err
    arrays, attrs = read_checkpoint(checkpoint_paths(folder)[0])
    assert all(np.isfinite(values).all() for values in arrays.values())
    assert arrays["step"][0] < summary["steps"]
    assert np.isfinite(list(attrs["last_row"].values())).all()
    bad = np.load(folder / "diverged.npz")
    assert set(bad.files) >= {"node_pos", "node_velocity", "fiber_node_start"}
    assert shell("info", folder) == 0 and "diverged" in shell.out


def test_dt_just_below_its_limit_is_stable(shell: Shell) -> None:
    stiff = "fibers.0.youngs_modulus=1e12"
    assert shell.run("first", "stage.0.end_strain=1e-4", stiff) == 0
    dt = 0.98 * shell.summary("first")["dt_limit"]
    assert shell.run("out", stiff, f"numerics.dt={dt!r}", "stage.0.end_strain=0.05") == 0
    rows = _finite(shell, "out")
    assert np.ptp(rows["a11"]) < 0.1


@pytest.mark.parametrize("array", ["node_pos", "node_velocity"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_state_that_is_not_finite_is_noticed(shell: Shell, array: str, value: float) -> None:
    simulation = Simulation(load_scene(shell.scene()))
    simulation.step(2)
    values = getattr(simulation.state, array).numpy()
    values[13] = value  # fiber 4 of three nodes each
    getattr(simulation.state, array).assign(values)
    with pytest.raises(Diverged, match="fiber 4 is torn") as caught:
        simulation.step(5)
    assert "dt = " in str(caught.value) and "limit" in str(caught.value)
    simulation.close()


# -- starts ---------------------------------------------------------------------------------------


def _pair(shell: Shell, apart: float) -> str:
    """Scene of two crossed fibers whose axes are `apart` diameters from each other."""
    nodes = np.zeros((2, 3, 3))
    along = np.linspace(-4.5e-5, 4.5e-5, 3)
    nodes[0, :, 0] = along
    nodes[1, :, 1] = along
    nodes[1, :, 2] = apart * 1e-5
    np.savez(shell.folder / "fibers.npz", node_pos=nodes + 1e-4)
    return _edited(
        CELL,
        ("aspect_ratio = 10", 'node_file = "fibers.npz"'),
        ("count = 10", ""),
        ("segments = 2", ""),
    )


def test_an_overlapping_start_settles(shell: Shell) -> None:
    text = _edited(_pair(shell, 0.95), ("end_strain = 0.1", "end_time = 2e-3"))
    settings = ('flow.kind="rest"', "contact.strength=1e-3", EVERYTHING)
    text = _edited(text, ("shear_rate = 100\n", ""))
    assert shell.run("out", *settings, text=text) == 0, shell.err
    rows = _finite(shell, "out")
    assert rows["overlap_max"][0] == pytest.approx(0.1, rel=1e-6)  # radii
    assert rows["overlap_max"][-1] < 0.01
    assert rows["axial_strain_max"].max() < 0.1


def test_a_start_that_overlaps_deeply_is_a_fault(shell: Shell) -> None:
    assert shell.run("out", text=_pair(shell, 0.1)) == 2
    assert "overlap" in shell.err and "node_file" in shell.err
    assert "out" not in shell.listing()


# -- sizes ----------------------------------------------------------------------------------------

SIZES = {
    "one fiber": ("fibers.0.count=1",),
    "one fiber of one segment": ("fibers.0.count=1", "numerics.segments=1"),
    "one segment": ("numerics.segments=1",),
    "beads": ("numerics.segments=9",),  # N_R = 0
    "lubrication": ('contact.lubrication="paper"',),
    "no contact": ('contact.law="none"',),
    "soft": ("fibers.0.youngs_modulus=1e3",),
    "free joints": ("fibers.0.bending_modulus=0", "numerics.segments=4"),
    "stiff": ("fibers.0.youngs_modulus=1e14", "stage.0.end_strain=1e-3"),
    "light": ("fibers.0.density=1e6", "stage.0.end_strain=1e-3"),
    "heavy": ("fibers.0.density=1e13",),
    "short": ("fibers.0.aspect_ratio=2", "numerics.segments=1"),
    "float32": ("numerics.precision=float32",),
    "more fibers than fit easily": ("fibers.0.count=200", PERIODIC, "stage.0.end_strain=0.01"),
    "closure none": ("numerics.closure=none",),
    "closure paper": ("numerics.closure=paper", "numerics.segments=3"),
}


@pytest.mark.parametrize("name", SIZES)
def test_extremes_stay_finite(shell: Shell, name: str) -> None:
    assert shell.run("out", *SIZES[name], EVERYTHING) == 0, shell.err
    rows = _finite(shell, "out")
    assert rows["a11"] + rows["a22"] + rows["a33"] == pytest.approx(1.0, rel=1e-5)


def test_a_thousand_tiny_fibers(shell: Shell) -> None:
    settings = ("fibers.0.count=1000", "fibers.0.aspect_ratio=3", "numerics.segments=1")
    edges = "box.size=[4e-4, 4e-4, 4e-4]"
    assert shell.run("out", *settings, edges, PERIODIC, "stage.0.end_strain=0.02") == 0
    assert shell.summary("out")["counts"]["segments"] == 1000
    _finite(shell, "out")


def test_a_fiber_longer_than_its_box(shell: Shell) -> None:
    # r_f = 500 in a box of 200 diameters: 5 mm of fiber through its own images
    settings = (
        "box.size=[2e-3, 2e-3, 2e-3]",
        PERIODIC,
        "fibers.0.aspect_ratio=500",
        "fibers.0.count=2",
        "numerics.segments=20",
        "fibers.0.youngs_modulus=2e11",
        "stage.0.end_strain=0.005",
        EVERYTHING,
    )
    assert shell.run("out", *settings) == 0, shell.err
    rows = _finite(shell, "out")
    assert rows["overlap_max"].max() < 0.1


# -- flows ----------------------------------------------------------------------------------------


def test_no_flow_moves_nothing(shell: Shell) -> None:
    text = _edited(CELL, ("shear_rate = 100\n", ""), ("end_strain = 0.1", "end_time = 1e-3"))
    settings = ('flow.kind="rest"', "contact.strength=1e-4", EVERYTHING)
    assert shell.run("out", *settings, text=text) == 0, shell.err
    rows = _finite(shell, "out")
    assert np.all(rows["strain"] == 0.0)
    assert rows["time"][-1] == pytest.approx(1e-3, rel=1e-2)
    with TrajectoryReader(shell.folder / "out" / "run.vtkhdf") as reader:
        moved = np.abs(reader.node_pos(reader.frame_count - 1) - reader.node_pos(0)).max()
    assert moved < 1e-3 * 1e-5  # a thousandth of a diameter: placed fibers hardly touch


def test_a_rest_with_both_ends_ends_by_time(shell: Shell) -> None:
    text = _edited(
        CELL, ("shear_rate = 100\n", ""), ("end_strain = 0.1", "end_strain = 1\nend_time = 1e-3")
    )
    assert shell.run("out", 'flow.kind="rest"', "contact.strength=1e-4", text=text) == 0
    assert shell.rows("out")["time"][-1] == pytest.approx(1e-3, rel=1e-2)


def test_a_scheduled_rate(shell: Shell) -> None:
    # the factor falls from 1 to 0.1 over the strain s = 0.05, then stays: t(s) = integral ds / rate
    schedule = "flow.schedule=[[0.0, 1.0], [0.05, 0.1]]"
    assert shell.run("out", schedule) == 0
    rows = _finite(shell, "out")
    slope = 0.9 / 0.05
    expected = (np.log(10.0) / slope + 0.05 / 0.1) / 100.0
    dt = shell.summary("out")["dt"]
    assert rows["strain"][-1] == pytest.approx(0.1, abs=100 * dt)
    # explicit steps take the factor at their start: first order in dt
    assert rows["time"][-1] == pytest.approx(expected, abs=20 * dt)
    # a row every 0.005 of strain, reached to within one step
    assert np.all(np.abs(rows["strain"] - 0.005 * np.arange(21)) <= 100 * dt)


@pytest.mark.parametrize("kind", ["planar_extension", "uniaxial_extension"])
def test_extension(shell: Shell, kind: str) -> None:
    text = _edited(CELL, ("shear_rate = 100", "extension_rate = 100"))
    settings = (f"flow.kind={kind}", PERIODIC, "box.size=[4e-4, 4e-4, 4e-4]", EVERYTHING)
    assert shell.run("out", *settings, text=text) == 0, shell.err
    rows = _finite(shell, "out")
    assert rows["a11"][-1] > rows["a11"][0]


# -- boxes ----------------------------------------------------------------------------------------


def test_open_axes(shell: Shell) -> None:
    for index, kinds in enumerate(('"open", "open", "open"', '"open", "periodic", "wall"')):
        assert shell.run(f"out{index}", f"box.boundary=[{kinds}]", EVERYTHING) == 0, shell.err
        _finite(shell, f"out{index}")


def test_no_box_with_contact(shell: Shell) -> None:
    box = CELL[CELL.index("[box]") : CELL.index("[flow]")]
    centers = [[0.0, 0.0, 2e-5 * k] for k in range(10)]
    text = _edited(CELL, (box, ""))
    settings = (f"fibers.0.position={centers}", "stage.0.end_strain=1", EVERYTHING)
    assert shell.run("out", *settings, "seed=3", text=text) == 0, shell.err
    _finite(shell, "out")


def test_a_box_that_becomes_too_flat_ends_the_run_with_its_state(shell: Shell) -> None:
    text = _edited(CELL, ("shear_rate = 100", "extension_rate = 100"))
    settings = ("flow.kind=planar_extension", PERIODIC, "fibers.0.aspect_ratio=5")
    assert shell.run("out", *settings, "stage.0.end_strain=5", text=text) == 3
    assert "take a larger box" in shell.err
    assert shell.summary("out")["outcome"] == "limit reached"
    rows = _finite(shell, "out")
    assert 1.0 < rows["strain"][-1] < 2.0  # of the box's 20 diameters, z keeps 20 exp(-strain)
    assert shell("resume", shell.folder / "out") == 3


def test_segments_that_outgrow_their_box_end_the_run_with_its_state(shell: Shell) -> None:
    # so soft that the flow stretches segments until they and their reach fill the box
    settings = (
        PERIODIC,
        "box.size=[9e-5, 9e-5, 9e-5]",
        "fibers.0.aspect_ratio=8",
        "fibers.0.youngs_modulus=50",
        "stage.0.end_strain=5",
    )
    assert shell.run("out", *settings) == 3
    assert "enlarge it or take more segments" in shell.err
    assert shell.summary("out")["steps"] > 0
    _finite(shell, "out")


# -- stages and records ---------------------------------------------------------------------------


def test_a_stage_ended_by_time(shell: Shell) -> None:
    text = _edited(CELL, ("end_strain = 0.1", "end_time = 5e-4"))
    assert shell.run("out", text=text) == 0
    rows = _finite(shell, "out")
    assert rows["time"][-1] == pytest.approx(5e-4, abs=shell.summary("out")["dt"])
    assert len(rows["time"]) == 21


def test_two_stages_follow_each_other(shell: Shell) -> None:
    text = _edited(CELL, ("end_strain = 0.1", 'name = "a"\nend_strain = 0.06'))
    text += '[[stage]]\nkind = "flow"\nname = "b"\nend_strain = 0.04\n'
    assert shell.run("two", text=text) == 0
    assert shell.run("one") == 0
    rows, single = _finite(shell, "two"), shell.rows("one")
    log = (shell.folder / "two" / "log.txt").read_text()
    assert "stage 'a' ended at strain 0.06" in log and "stage 'b' ended at strain 0.10" in log
    assert np.all(np.diff(rows["step"]) > 0)
    assert len(rows["step"]) == 21
    assert rows["a11"][-1] == pytest.approx(single["a11"][-1], abs=1e-4)
    # a checkpoint at the end of every stage
    assert len(checkpoint_paths(shell.folder / "two")) == 2


@pytest.mark.parametrize("key", ["every_strain=0.02", "every_time=2e-4"])
def test_frames_at_even_distances(shell: Shell, key: str) -> None:
    text = _edited(CELL, ("frames = 5", key.replace("=", " = ")))
    assert shell.run("out", text=text) == 0
    dt = shell.summary("out")["dt"]
    with TrajectoryReader(shell.folder / "out" / "run.vtkhdf") as reader:
        marks = reader.strain / 0.02 if "strain" in key else reader.time / 2e-4
        assert reader.frame_count == 6
    assert np.abs(marks - np.arange(6)).max() <= 1.01 * dt / 2e-4


def test_a_stage_that_misses_its_condition_is_exit_code_3(shell: Shell) -> None:
    text = _edited(CELL, ("end_strain = 0.1", "end_strain = 0.1\ntime_limit = 2e-4"))
    assert shell.run("out", text=text) == 3
    assert "end condition not met within 0.0002 s" in shell.err
    assert shell.summary("out")["outcome"] == "end condition not met"
    _finite(shell, "out")
