"""Laws of fiber lengths and their groups: averages, limits, histograms, and what is refused.

Tolerances: averages of a law to its Newton bar; of a sample to 1e-4, ten times the error of middle
quantiles of 2000 parts; of groups to 1e-3, asked of the placement.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.scene_text import GONE, changed, faults_of
from warpfiber.placement import split_tables
from warpfiber.placement.lengths import averages, length_law
from warpfiber.scene import LengthDistribution, Scene, SceneError, scene_from_dict

PLATE = {"number_average": 0.83e-3, "weight_average": 1.53e-3, "maximum": 4e-3, "minimum": 5e-5}


ADDED = [
    "fibers.0.length_distribution",
    "fibers.0.volume_fraction",
    "fibers.0.orientation",
    "numerics.segment_length",
]
"""Keys that the cell has not unless they are added."""


def asked(**keys: Any) -> LengthDistribution:
    return LengthDistribution(**({"kind": "lognormal"} | PLATE | keys))


def plate_cell(**keys: Any) -> dict[str, Any]:
    """Tables of the sliding plate."""
    changes = {
        "box.size": [4.4e-3, 4.4e-3, 2e-3],
        "fibers.0.aspect_ratio": GONE,
        "fibers.0.diameter": 19e-6,
        "fibers.0.length_distribution": dict(PLATE),
        "fibers.0.count": GONE,
        "fibers.0.volume_fraction": 0.0793,
        "numerics.segments": GONE,
        "numerics.segment_length": 2e-4,
    }
    merged = changes | {key.replace("__", "."): value for key, value in keys.items()}
    absent = [key for key in ADDED if merged.get(key) is GONE]
    return changed({key: value for key, value in merged.items() if key not in absent})


@pytest.mark.parametrize(
    ("kind", "least", "shares"),
    [
        ("lognormal", 5e-5, (0.62, 0.30, 0.19, 0.11)),
        ("weibull", 5e-5, (0.65, 0.29, 0.18, 0.09)),
        ("lognormal", 1e-4, (0.62, 0.30, 0.19, 0.11)),
    ],
)
def test_averages_of_the_sliding_plate(kind: str, least: float, shares: tuple[float, ...]) -> None:
    """Both averages are met after the cut; length shares above 1, 2, 2.5, 3 mm as tabulated."""
    law = length_law(asked(kind=kind), least, 4e-3)
    np.testing.assert_allclose([law.number_average, law.weight_average], [0.83e-3, 1.53e-3], 1e-8)
    length = law.sample(13048)
    assert least <= length[0] and length[-1] <= 4e-3
    np.testing.assert_allclose(averages(length), [0.83e-3, 1.53e-3], rtol=1e-5)
    for limit, share in zip((1e-3, 2e-3, 2.5e-3, 3e-3), shares, strict=True):
        assert length[length > limit].sum() / length.sum() == pytest.approx(share, abs=0.006)
    if kind == "lognormal" and least == 5e-5:
        # <L^3> / <L> in diameters squared: stress is carried by the long fibers.
        assert np.sum(length**3) / length.sum() / (19e-6) ** 2 == pytest.approx(9216, rel=1e-4)


@pytest.mark.parametrize(("l_n", "l_w"), [(1e-3, 1.01e-3), (1e-3, 1.2e-3), (0.4e-3, 1e-3)])
def test_narrow_and_wide_laws(l_n: float, l_w: float) -> None:
    law = length_law(asked(number_average=l_n, weight_average=l_w), 5e-5, 4e-3)
    np.testing.assert_allclose([law.number_average, law.weight_average], [l_n, l_w], 1e-8)
    np.testing.assert_allclose(averages(law.sample(2000)), [l_n, l_w], rtol=1e-3)


def test_averages_that_no_law_has() -> None:
    with pytest.raises(ValueError, match="the nearest has"):
        length_law(asked(number_average=1e-3, weight_average=3.5e-3), 5e-5, 4e-3)


def test_histogram_and_kunc() -> None:
    """Two bins by hand: equal counts, divided by 1 + 4 L / (pi d) at their middles."""
    rows = ((1e-3, 2e-3, 1.0), (2e-3, 4e-3, 1.0))
    plain = length_law(asked(kind="histogram", histogram=rows), 1e-3, 4e-3)
    assert plain.number_average == pytest.approx(2.25e-3, rel=1e-12)
    second = 0.5 * ((1.5**2 + 1 / 12) + (3.0**2 + 4 / 12)) * 1e-6
    assert plain.weight_average == pytest.approx(second / 2.25e-3, rel=1e-12)
    np.testing.assert_allclose(averages(plain.sample(1000)), [2.25e-3, second / 2.25e-3], 1e-5)
    column = 5e-3
    kunc = length_law(asked(kind="histogram", histogram=rows, kunc_diameter=column), 1e-3, 4e-3)
    part = np.array([1.0 / (1.0 + 4.0 * m / (np.pi * column)) for m in (1.5e-3, 3e-3)])
    expected = float(part @ [1.5e-3, 3e-3] / part.sum())
    assert kunc.number_average == pytest.approx(expected, rel=1e-12)


def test_groups_of_the_sliding_plate() -> None:
    """13,048 fibers and about 53,600 segments in some hundred groups, averages within 0.1 %."""
    scene = split_tables(scene_from_dict(plate_cell()))
    count = np.array([group.count for group in scene.fibers])
    length = np.array([group.length for group in scene.fibers])
    segments = np.array([group.segments for group in scene.fibers])
    assert count.sum() == 13048 and len(count) < 300
    assert abs(int((count * segments).sum()) - 53_600) < 100
    np.testing.assert_allclose(averages(np.repeat(length, count)), [0.83e-3, 1.53e-3], rtol=1e-3)
    achieved = sum(group.volume_fraction_achieved or 0.0 for group in scene.fibers)
    assert achieved == pytest.approx(0.0793, rel=1e-3)
    long = segments > 1
    spacing = (length[long] - 19e-6) / segments[long]
    assert spacing.min() > 0.14e-3 and spacing.max() < 0.26e-3
    assert split_tables(scene) == scene
    assert scene_from_dict(scene.as_dict()) == scene


def test_other_ways_to_segment() -> None:
    beads = split_tables(
        scene_from_dict(plate_cell(numerics__segment_length=GONE, numerics__reduced_beads=9.526316))
    )
    length = split_tables(scene_from_dict(plate_cell()))
    assert [g.segments for g in beads.fibers] == [g.segments for g in length.fibers]
    keys = {"numerics__segment_length": GONE, "numerics__segments": 2}
    least = {"fibers__0__length_distribution__minimum": 1e-4}
    fixed = split_tables(scene_from_dict(plate_cell(**keys, **least)))
    assert {g.segments for g in fixed.fibers} == {2}
    with pytest.raises(SceneError) as caught:
        split_tables(scene_from_dict(plate_cell(**keys)))
    assert [fault.key for fault in caught.value.faults] == ["numerics.segments"]


def test_count_and_plain_scenes() -> None:
    keys = {"fibers__0__volume_fraction": GONE, "fibers__0__count": 500}
    scene = split_tables(scene_from_dict(plate_cell(**keys)))
    assert sum(group.count for group in scene.fibers) == 500
    plain: Scene = scene_from_dict(changed({}))
    assert split_tables(plain) == plain


DISTRIBUTION = "fibers__0__length_distribution__"
BAD: list[tuple[dict[str, Any], str, str]] = [
    ({"weight_average": 0.8e-3}, "weight_average", "must be above number_average"),
    ({"maximum": 1.5e-3}, "maximum", "must be above weight_average"),
    ({"maximum": 5e-3}, "maximum", "the periodic box is"),
    ({"maximum": GONE}, "maximum", "missing"),
    ({"minimum": 2e-5}, "minimum", "below 2 diameters"),
    ({"minimum": 0.9e-3}, "number_average", "must be above minimum"),
]


@pytest.mark.parametrize(("keys", "key", "text"), BAD)
def test_bad_distribution(keys: dict[str, Any], key: str, text: str) -> None:
    faults = faults_of(plate_cell(**{DISTRIBUTION + name: value for name, value in keys.items()}))
    assert [fault.key for fault in faults] == [f"fibers.0.length_distribution.{key}"]
    assert text in faults[0].remedy


def test_unreachable_averages_are_a_fault() -> None:
    scene = scene_from_dict(plate_cell(**{DISTRIBUTION + "weight_average": 3.4e-3}))
    with pytest.raises(SceneError, match="no lognormal law between") as caught:
        split_tables(scene)
    assert caught.value.faults[0].key == "fibers.0.length_distribution.weight_average"


@pytest.mark.parametrize(
    ("text", "remedy"),
    [
        ("from,to,count\n1,2,3\n", "it must be lower,upper,count"),
        ("lower,upper,count\n1e-3,2e-3,3\n2.5e-3,3e-3,1\n", "a gap before bin 1"),
        ("lower,upper,count\n1e-3,2e-3,3\n1.5e-3,3e-3,1\n", "an overlap before bin 1"),
        ("lower,upper,count\n1e-3,2e-3,-3\n", "has -3 fibers"),
        ("lower,upper,count\n1e-3,2e-3,0\n", "all its counts are 0"),
        ("lower,upper,count\n2e-3,1e-3,1\n", "has no width"),
        ("lower,upper,count\n1e-3,x,1\n", "line 2"),
        ("lower,upper,count\n1e-3,2e-3\n", "it must hold 3 numbers"),
        ("lower,upper,count\n", "it holds no rows"),
        ("lower,upper,count\n1e-3,5e-3,1\n", "the periodic box is"),
        (None, "no such file"),
    ],
)
def test_bad_histogram(tmp_path: Path, text: str | None, remedy: str) -> None:
    if text is not None:
        (tmp_path / "h.csv").write_text(text)
    tables = plate_cell(fibers__0__length_distribution={"histogram": str(tmp_path / "h.csv")})
    faults = faults_of(tables)
    assert [fault.key for fault in faults] == ["fibers.0.length_distribution.histogram"]
    assert remedy in faults[0].remedy


@pytest.mark.parametrize(
    ("rows", "remedy"),
    [
        ([[1e-3, 2e-3, 3], [2.5e-3, 3e-3, 1]], "a gap before bin 1"),
        ([[1e-3, 2e-3, 3], [1.5e-3, 3e-3, 1]], "an overlap before bin 1"),
        ([[1e-3, 2e-3, -3]], "has -3 fibers"),
        ([[1e-3, 2e-3, 0]], "all its counts are 0"),
        ([[1e-3, 5e-3, 1]], "the periodic box is"),
        ([[1e-3, 2e-3]], "2 entries instead of 3"),
        ([], "0 entries"),
        ("h.txt", "unknown file type"),
    ],
)
def test_bad_bins_in_the_scene(rows: Any, remedy: str) -> None:
    faults = faults_of(plate_cell(fibers__0__length_distribution={"histogram": rows}))
    assert [fault.key for fault in faults] == ["fibers.0.length_distribution.histogram"]
    assert remedy in faults[0].remedy


def test_bins_in_the_scene_are_those_of_a_file(tmp_path: Path) -> None:
    """Kunc's correction in both: a third of the column's diameter and more for long fibers."""
    rows = [[0.0, 1e-3, 8.0], [1e-3, 2e-3, 3.0], [2e-3, 4e-3, 1.0]]
    lines = [",".join(map(str, row)) for row in rows]
    (tmp_path / "h.csv").write_text("\n".join(["lower,upper,count", *lines]))

    def lengths(histogram: Any, **keys: float) -> list[float]:
        table = {"histogram": histogram} | keys
        scene = scene_from_dict(plate_cell(fibers__0__length_distribution=table))
        assert scene_from_dict(scene.as_dict()) == scene
        return [length for g in split_tables(scene).fibers for length in [g.length] * g.count]

    inline = lengths(rows, kunc_diameter=5e-3)
    assert inline == lengths(str(tmp_path / "h.csv"), kunc_diameter=5e-3)
    assert averages(np.array(inline))[0] < averages(np.array(lengths(rows)))[0]


def test_histogram_file(tmp_path: Path) -> None:
    (tmp_path / "h.csv").write_text("lower,upper,count\n0,1e-3,8\n1e-3,2e-3,3\n2e-3,4e-3,1\n")
    tables = plate_cell(fibers__0__length_distribution={"histogram": str(tmp_path / "h.csv")})
    scene = scene_from_dict(tables)
    assert any("is left out" in note for note in scene.notes)
    groups = split_tables(scene).fibers
    assert groups[0].length > 2 * 19e-6 and groups[-1].length > 3.9e-3
    first = groups[0].length_distribution
    assert first is not None and first.histogram is not None and len(first.histogram) == 3


def test_loads_follow_their_table() -> None:
    """A load on the table behind the split one is on the same fibers; on the split one refused."""
    plain = {"diameter": 19e-6, "youngs_modulus": 3e10, "aspect_ratio": 10, "count": 2}
    tables = plate_cell(numerics__method="overdamped", numerics__segment_length=[2e-4, 1e-4])
    tables["fibers"].append(plain)
    tables["contact"] = {}
    tables["load"] = [{"group": 1, "fiber": 0, "node": 0, "force": [1e-6, 0, 0]}]
    scene = split_tables(scene_from_dict(tables))
    assert scene.loads[0].group == len(scene.fibers) - 1
    assert scene.fibers[scene.loads[0].group].count == 2
    tables["load"][0]["group"] = 0
    with pytest.raises(SceneError) as caught:
        split_tables(scene_from_dict(tables))
    assert [fault.key for fault in caught.value.faults] == ["load.0.group"]


def test_auto_takes_chains() -> None:
    tables = plate_cell(numerics__method="auto")
    tables["contact"] = {}
    scene = scene_from_dict(tables)
    assert scene.numerics.method == "overdamped"
    assert scene.method_reason is not None and "packed as chains" in scene.method_reason
