"""A stage that is saved and started from again: the same bits as one scene with both stages."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import warpfiber as wf
from warpfiber.output.saved_stage import merged_arrays
from warpfiber.scene import Fault, SceneError
from warpfiber.simulation import Simulation

BED = """
seed = 5
[box]
size = [0.02, 0.02, 0.06]
boundary = ["periodic", "periodic", "wall"]
[[fibers]]
count = 9
length = 0.0144
diameter = 2.4e-3
density = 1340
youngs_modulus = 7.5e5
bond_damping = 0.0335
shape = { kind = "s", curvature = 100 }
[[fibers]]
count = 8
length = 0.012
diameter = 2.4e-3
density = 1000
youngs_modulus = 7.5e5
"""
COMMON = """
[gravity]
[contact]
damping = 0.113
friction = 0.3
wall_friction = 0.6
[record]
scalars = 200
frames = 3
figures = false
quantities = ["stress", "energy"]
"""
NUMERICS = """
[numerics]
method = "bonded_spheres"
"""
SEGMENTS = "segments = [5, 4]\n"
SETTLE = """
[[stage]]
kind = "settle"
damping = 30
end_time = 0.15
save = true
"""
LATER = """
[[stage]]
kind = "compress"
wall = "z+"
speed = 0.2
end_pressure = 300
[[stage]]
kind = "pull"
freeze_below = 0.003
freeze_above = 0.005
speed = 0.2
end_strain = 0.5
save = true
"""
START = '[start]\nfrom = "settled"\n'


def load(path: Path, text: str, **overrides: Any) -> wf.Scene:
    """The scene of a text that is written to a file."""
    path.write_text(text)
    return wf.load_scene(path, overrides)


def run(folder: Path, name: str, text: str, **overrides: Any) -> wf.Job:
    """A finished run into `folder/name`."""
    scene = load(folder / f"{name}.toml", text, **overrides)
    job = wf.Job.start(scene, out=folder / name)
    assert job.run() == 0
    return job


@pytest.fixture(scope="module")
def settled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the run `settled`, which kept its only stage."""
    folder = tmp_path_factory.mktemp("runs")
    run(folder, "settled", BED + COMMON + SETTLE + NUMERICS + SEGMENTS)
    return folder


def assert_same(a: Simulation, b: Simulation) -> None:
    """Every array of the state equal to the last bit."""
    first, second = a.snapshot(), b.snapshot()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert value.tobytes() == second[name].tobytes(), name


def rows(path: Path) -> list[str]:
    """Lines of the table of scalars."""
    return (path / "scalars.csv").read_text().splitlines()


def test_same_as_one_scene(settled: Path) -> None:
    """Settled and pressed in one run, or in two: every array, and the rows that both have."""
    whole = run(settled, "whole", BED + COMMON + SETTLE + LATER + NUMERICS + SEGMENTS)
    parts = run(settled, "parts", START + COMMON + LATER + NUMERICS)
    assert_same(whole.simulation, parts.simulation)
    assert parts.simulation.time > 0.15
    summaries = [
        json.loads((settled / name / "summary.json").read_text()) for name in ("whole", "parts")
    ]
    assert summaries[0]["stages"] == summaries[1]["stages"]
    last = []
    for name in ("whole", "parts"):
        head, *_, row = (line.split(",") for line in rows(settled / name))
        last.append(dict(zip(head, row, strict=True)))
    assert last[0] == last[1]
    # the run that was started from a stage is resumed without it, and its end started from again
    job = wf.Job.start(wf.load_scene(settled / "parts.toml"), out=settled / "halves")

    class Stop:
        """Asks for a stop amid the stages."""

        exit_code = 130

        def __enter__(self) -> Stop:
            return self

        def __exit__(self, *_: object) -> None: ...

        @property
        def reason(self) -> str:
            return "Ctrl-C" if job.simulation.time > 0.2 else ""

    assert job.run(Stop()) == 130
    kept = settled / "settled" / "stage_settle.h5"
    hidden = kept.rename(kept.with_suffix(".away"))
    try:
        job = wf.Job.resume(settled / "halves")
        assert job.run() == 0
    finally:
        hidden.rename(kept)
    assert rows(settled / "halves") == rows(settled / "parts")
    assert_same(job.simulation, parts.simulation)
    pulled = START.replace("settled", "parts")
    after = load(settled / "after.toml", pulled + COMMON + SETTLE + NUMERICS)
    sim = Simulation(after)
    assert sim.time == parts.simulation.time
    sim.step(10)
    assert sim.measure()["pressure_low"] > 0.0


def test_python_starts_as_the_command_does(settled: Path) -> None:
    """`Simulation.run` takes the stages from where the saved one ended."""
    scene = load(settled / "short.toml", START + COMMON + SETTLE + NUMERICS)
    sim = Simulation(scene)
    begin, before = sim.time, sim.node_pos
    assert begin == pytest.approx(0.15, abs=sim.dt)
    sim.run()
    assert sim.time - begin == pytest.approx(0.15, abs=1.01 * sim.dt)
    assert np.abs(sim.node_pos - before).max() > 0.0


def test_what_may_change(settled: Path) -> None:
    """Friction to and from nothing, less weight, another step and other records."""
    slippery = COMMON.replace("friction = 0.3", "").replace("wall_friction = 0.6", "")
    slippery = slippery.replace("wall_", "").replace("[gravity]", "[gravity]\nfluid_density = 900")
    scene = load(settled / "slippery.toml", START + slippery + SETTLE + NUMERICS + "dt = 1e-5\n")
    assert scene.contact.friction == scene.contact.wall_friction == 0.0
    bed = wf.Job.start(scene, out=settled / "slippery")
    assert bed.simulation.dt == 1e-5
    assert bed.run() == 0
    again = START.replace("settled", "slippery")
    text = again + COMMON.replace('["stress", "energy"]', '["contacts"]') + LATER + NUMERICS
    sim = Simulation(load(settled / "rough.toml", text))
    sim.step(20)
    memory = sim.snapshot()["contact_memory"]
    assert np.isfinite(sim.node_pos).all() and memory.any()


def test_a_list_is_that_of_the_memories() -> None:
    """Where the saved scene had no contact its list is of another state: the new one's is taken."""
    saved = {name: np.full((2, 3), 1.0) for name in ("node_pos", "list_pos")}
    fresh = {name: np.full((2, 3), 2.0) for name in ("node_pos", "list_pos")}
    assert merged_arrays(saved, fresh)["node_pos"][0, 0] == 1.0
    assert merged_arrays(saved, fresh)["list_pos"][0, 0] == 2.0
    listed = saved | {"contact_acts": np.zeros(3)}
    assert merged_arrays(listed, fresh)["list_pos"][0, 0] == 1.0


def faults(folder: Path, text: str) -> list[Fault]:
    """Faults of a scene beside the settled run."""
    with pytest.raises(SceneError) as caught:
        load(folder / "faulty.toml", text)
    return list(caught.value.faults)


REFUSED: list[tuple[str, str, str]] = [
    ('[start]\nfrom = "elsewhere"\n', "start.from", "no such run folder; sought: "),
    ('[start]\nfrom = "empty"\n', "start.from", "has no scene.json"),
    ('[start]\nfrom = "broken"\n', "start.from", "its scene.json cannot be read"),
    ('[start]\nfrom = "unsaved"\n', "start.from", "keeps no stage; run it with save = true"),
    (START + 'stage = "pull"\n', "start.stage", 'it keeps "settle"'),
    (START + BED.partition("[[")[0].partition("\n")[2].partition("\n")[2], "box", "brings it"),
    ("[start]\n", "start.from", "missing"),
]


@pytest.mark.parametrize(("start", "key", "advice"), REFUSED)
def test_bad_starts(settled: Path, start: str, key: str, advice: str) -> None:
    """One fault, of the key that is wrong, with a remedy."""
    for name, content in (("empty", None), ("broken", "{"), ("unsaved", "")):
        (settled / name).mkdir(exist_ok=True)
        if content is not None:
            text = content or (settled / "settled" / "scene.json").read_text()
            (settled / name / "scene.json").write_text(text)
    found = faults(settled, start + COMMON + LATER + NUMERICS)
    assert [fault.key for fault in found] == [key], [str(fault) for fault in found]
    assert advice in str(found[0])


@pytest.mark.parametrize(
    ("numerics", "advice"),
    [
        ("segments = 5", "the saved stage has (5, 4)"),
        ("segment_length = 2.4e-3", "given by [start]; remove it"),
        ('precision = "float32"', "the saved stage has float64"),
        ('bond_shear = "ga"', "the saved stage has rbf"),
    ],
)
def test_what_may_not_change(settled: Path, numerics: str, advice: str) -> None:
    """How fibers are cut and kept is that of the saved run; the same again is no fault."""
    found = faults(settled, START + COMMON + LATER + NUMERICS + numerics)
    assert [fault.key for fault in found] == ["numerics." + numerics.split()[0]]
    assert advice in str(found[0])
    load(settled / "again.toml", START + COMMON + LATER + NUMERICS + SEGMENTS)


def test_damage_is_told(settled: Path, tmp_path: Path) -> None:
    """A torn file, and one of other fibers, before anything is written."""
    (tmp_path / "settled").mkdir()
    source = settled / "settled"
    scene = (source / "scene.json").read_text()
    (tmp_path / "settled" / "scene.json").write_text(scene)
    kept = tmp_path / "settled" / "stage_settle.h5"
    kept.write_bytes(b"torn")
    start = load(tmp_path / "cell.toml", START + COMMON + LATER + NUMERICS)
    with pytest.raises(SceneError, match=r"start\.stage = .settle.: .*cannot read"):
        wf.Job.start(start, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
    kept.write_bytes((source / "stage_settle.h5").read_bytes())
    (tmp_path / "settled" / "scene.json").write_text(scene.replace('"count": 9', '"count": 7'))
    start = load(tmp_path / "cell.toml", START + COMMON + LATER + NUMERICS)
    with pytest.raises(SceneError, match="not of the same run"):
        wf.Job.start(start, out=tmp_path / "out")


def test_several_saved_stages(settled: Path, tmp_path: Path) -> None:
    """Which of two must be said; names are those of files and differ; a new run removes them."""
    two = SETTLE.replace("0.15", "1e-3") + SETTLE.replace("0.15", "1e-3")
    text = BED + COMMON + two + NUMERICS + SEGMENTS
    found = faults(settled, text)
    assert [fault.key for fault in found] == ["stage.1.name"]
    assert "another saved stage has this name" in str(found[0])
    named = text.replace("damping = 30\nend_time = 1e-3", 'name = "a/b"\nend_time = 1e-3', 1)
    found = faults(settled, named)
    assert [fault.key for fault in found] == ["stage.0.name"]
    run(tmp_path, "two", named.replace("a/b", "first"))
    begin = '[start]\nfrom = "two"\n'
    found = faults(tmp_path, begin + COMMON + LATER + NUMERICS)
    assert [fault.key for fault in found] == ["start.stage"]
    assert 'the run keeps "first", "settle": name one' in str(found[0])
    chosen = begin + 'stage = "first"\n' + COMMON + LATER + NUMERICS
    assert Simulation(load(tmp_path / "one.toml", chosen)).time == pytest.approx(1e-3, abs=1e-4)
    short = load(tmp_path / "short.toml", text.replace(two, SETTLE.replace("0.15", "1e-3")))
    wf.Job.start(short, out=tmp_path / "two", overwrite=True)
    assert list((tmp_path / "two").glob("stage_*")) == []
