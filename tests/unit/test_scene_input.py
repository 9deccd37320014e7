"""What comes in: overrides, files that are no scenes, tables and numbers out of all range."""

from __future__ import annotations

import copy
import tomllib
from pathlib import Path
from typing import Any

import pytest

from tests.scene_text import SHEAR_CELL
from warpfiber.scene import SceneError, load_scene, parse_override, scene_from_dict


def cell() -> dict[str, Any]:
    """Return the tables of a shear cell that loads."""
    return tomllib.loads(SHEAR_CELL)


@pytest.mark.parametrize(
    ("text", "key", "value"),
    [
        ("seed=7", "seed", 7),
        ("box.size = [1e-3, 1e-3, 1e-3]", "box.size", [1e-3, 1e-3, 1e-3]),
        ("fibers.0.count=500", "fibers.0.count", 500),
        ("numerics.closure=paper", "numerics.closure", "paper"),
        ('title="a = b"', "title", "a = b"),
        ("record.usd=true", "record.usd", True),
        ("title=1\nseed=2", "title", "1\nseed=2"),
    ],
)
def test_overrides_are_toml_or_bare_words(text: str, key: str, value: object) -> None:
    """Values are TOML; what is not TOML is a text."""
    assert parse_override(text) == (key, value)


def test_overrides_apply_and_replace_alternatives() -> None:
    """A key of a one-of rule replaces the one in the file; -1 is the last table."""
    changes = {"fibers.-1.count": 5, "numerics.reduced_beads": 0, "title": "five"}
    scene = scene_from_dict(cell(), overrides=changes | {"gravity.fluid_density": 900})
    assert scene.fibers[0].count == 5 and scene.fibers[0].volume_fraction is None
    assert scene.fibers[0].segments == 19
    assert scene.title == "five"
    assert any("volume_fraction is replaced" in note for note in scene.notes)
    assert scene.gravity is not None and scene.gravity.fluid_density == 900


def test_overrides_leave_the_given_tables_alone() -> None:
    """Reading does not change the caller's tables."""
    tables = cell()
    before = copy.deepcopy(tables)
    scene_from_dict(tables, overrides={"fibers.0.count": 3, "box.size": [1e-3, 1e-3, 1e-3]})
    assert tables == before


@pytest.mark.parametrize("value", [3, "text", [], [1], {}, [[]], True])
@pytest.mark.parametrize("table", list(cell()) + ["gravity", "record", "wall", "load", "start"])
def test_tables_of_any_type_never_crash(table: str, value: object) -> None:
    """Whatever stands in place of a table: faults or a scene, no other exception."""
    try:
        scene_from_dict(cell() | {table: value}, "cell.toml")
    except SceneError as error:
        assert error.faults


EXTREME = [
    1e-300,
    1e300,
    1e-30,
    1e30,
    -1e300,
    [1e200] * 3,
    [1e-200] * 3,
    "",
    "x",
    [[1e300] * 3] * 3,
]


@pytest.mark.parametrize("value", EXTREME)
def test_extreme_values_never_crash(value: object) -> None:
    """Any key with an extreme value: faults or a scene, no other exception."""
    tables = cell()
    places = [f"{name}.{key}" for name in ("box", "flow", "numerics") for key in tables[name]]
    places += [f"fibers.0.{key}" for key in tables["fibers"][0]]
    places += ["fibers.0.orientation", "fibers.0.position", "fibers.0.volume_fraction"]
    places += ["fibers.0.length", "fibers.0.centerline_length", "numerics.reduced_beads"]
    places += ["numerics.segment_length", "numerics.strain_step", "flow.gradient", "flow.kind"]
    for place in places:
        try:
            scene_from_dict(cell(), "cell.toml", {place: value}).as_dict()
        except SceneError as error:
            assert error.faults


def test_broken_toml_names_line_and_column(tmp_path: Path) -> None:
    """Syntax errors: the line, its text, what is wrong."""
    file = tmp_path / "broken.toml"
    for text, place, piece in (
        ("seed = 1\nsize = 10um\n", "line 2, column 10", "`size = 10um`"),
        ("a = [1,\n", "end of file", "not closed"),
        ("a = 1\na = 2\n", "line 2, column 6", "double keys"),
        ("[box]\n[box]\n", "line 2", "twice"),
    ):
        file.write_text(text)
        with pytest.raises(SceneError) as caught:
            load_scene(file)
        line = str(caught.value)
        assert line.startswith(f"{file}: {place}") and piece in line


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    """Missing file (with the nearest name), folder, binary file."""
    (tmp_path / "shear_cell.toml").write_text("")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    for name, piece in (
        ("shear_sell.toml", "no such file, did you mean"),
        ("zzz", "no such file; check the path"),
        ("", "is a folder"),
        ("binary.toml", "UTF-8"),
    ):
        with pytest.raises(SceneError, match=piece) as caught:
            load_scene(tmp_path / name)
        assert str(tmp_path) in caught.value.faults[0].file


@pytest.mark.parametrize("text", ["", "seed", "=1", "seed=", "a..b=1", ".=1"])
def test_overrides_that_are_none(text: str) -> None:
    """What is not KEY=VALUE is a fault of --set."""
    with pytest.raises(SceneError, match="--set: .*KEY=VALUE"):
        parse_override(text)


@pytest.mark.parametrize(
    ("key", "value", "remedy"),
    [
        ("fibers.3.count", 1, "use fibers.0"),
        ("fibers.count", 1, "write fibers.0.count"),
        ("fibres.0.count", 1, "did you mean 'fibers'?"),
        ("load.0.node", 1, "no [[load]]"),
        ("box", 1, "one of its keys"),
        ("fibers.0", 1, "set fibers as a whole"),
        ("fibers.0.diameter.x", 1, "single value"),
        ("numerics.closur", "paper", "did you mean 'closure'?"),
        ("fibers.0.count", "many", "not a number"),
        ("viscosity", 1, "below [flow]"),
        ("numerics.segments", 99, "at most 19"),
    ],
)
def test_overrides_are_checked_like_the_file(key: str, value: object, remedy: str) -> None:
    """Faults of overrides name --set instead of the file, and nothing else is blamed."""
    with pytest.raises(SceneError) as caught:
        scene_from_dict(cell(), "cell.toml", {key: value})
    faults = caught.value.faults
    assert len(faults) == 1, str(caught.value)
    assert str(faults[0]).startswith(f"--set: {key} = ") and remedy in str(faults[0])
