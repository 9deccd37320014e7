"""The search behind the neighbor list: unequal lengths, every skin, workers, what it looks at.

Sets of pairs are compared exactly with brute force and with the plain kernels (`check_list`).
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tests.bonded_crowd import crowd
from tests.cell import Kind, bent_fiber, isotropic, straight_fiber
from tests.meeting_cell import METHODS, meeting_scene
from tests.pair_list import SHEAR, Start, cell, check_list, random_fibers
from warpfiber.methods.bonded_spheres import LISTED_COST
from warpfiber.methods.pair_search import STEP_PAIR_COST
from warpfiber.methods.skin import LEAST_SKIN, MOST_SKIN, PAIR_COST, RATIO
from warpfiber.passes.near_pairs import PAIR_COST as NEAR_PAIR_COST
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pieces import piece_counts
from warpfiber.scene import SceneError
from warpfiber.simulation import Simulation

LONG, SHORT, TWICE = Kind(1, 50.0), Kind(1, 1.0), Kind(2, 50.0)
BOXES = {
    "open": None,
    "walls": {"size": [112.0, 115.0, 120.0], "boundary": ["periodic", "periodic", "wall"]},
    "periodic": {"size": [112.0, 116.0, 114.0]},
    "sheared": {"size": [126.0, 124.0, 125.0]},
    "smaller than a fiber": {"size": [111.0, 112.0, 113.0]},
}


@pytest.mark.parametrize("box", BOXES)
def test_unequal_lengths(start: Start, box: str) -> None:
    """Segments 50 times longer than others, cut into pieces: each pair once, none missing."""
    rng = np.random.default_rng(40)
    long = TWICE if box == "smaller than a fiber" else LONG
    which = np.repeat([0, 1], [24, 300])
    centers = 110.0 * rng.random((len(which), 3))
    axes = isotropic(rng, len(which))
    if box == "walls":
        centers[:24, 2] = 50.0 + 20.0 * rng.random(24)
        axes[:24, 2] *= 0.1
    fibers = [
        straight_fiber((long, SHORT)[k], axis / np.linalg.norm(axis), center)
        for k, axis, center in zip(which, axes, centers, strict=True)
    ]
    tables = {} if BOXES[box] is None else {"box": BOXES[box]}
    if box == "sheared":
        tables["flow"] = SHEAR
    sim = cell(start, (long, SHORT), fibers, which, **tables)
    pairs = sim.method.list
    assert pairs.piece_count > 1.1 * sim.model.segment_count
    check_list(sim, least=10)
    if box == "sheared":
        lattice = np.diag(np.asarray(BOXES[box]["size"]))
        for shear in (0.21, 0.47, -0.38):
            lattice[0, 2] = shear * lattice[0, 0]
            sim.state.lattice.assign(lattice[None])
            sim.method.refresh_list()
            check_list(sim, least=10)


def test_a_long_segment_meets_its_own_image(start: Start) -> None:
    """A cut segment nearly as long as the box, its image, and a parallel one half a box on."""
    fibers = [straight_fiber(LONG, (1.0, 0.002, 0.0), (x, 30.0, 30.0)) for x in (0.0, 50.0)]
    short = [straight_fiber(SHORT, (0, 0, 1), (8.0 * k, 12.0, 12.0)) for k in range(200)]
    which = [0, 0] + [1] * 200
    box = {"size": [101.5, 120.0, 120.0]}
    with pytest.raises(SceneError):  # a segment may stretch: the box must have room for that
        cell(start, (LONG, SHORT), fibers + short, which, box=box)
    box["size"][0] = 111.0
    sim = cell(start, (LONG, SHORT), fibers + short, which, box=box)
    pairs = sim.method.list
    sim.method.search.set_skin(10.0)  # wider than the rule of the box allows: the search itself can
    sim.method.refresh_list()
    assert pairs.piece_count > sim.model.segment_count
    assert any(i == j for i, j, _ in check_list(sim))


def test_every_skin(start: Start) -> None:
    """All skins that the automatic choice can reach, in one cell."""
    kind = Kind(3, 4.0)
    fibers, _ = random_fibers((kind,), 60, [40.0] * 3, seed=41)
    sim = cell(start, (kind,), fibers, flow=SHEAR, box={"size": [40.0] * 3})
    counts = []
    skin = LEAST_SKIN
    while skin <= MOST_SKIN:
        sim.method.search.set_skin(2.0 * skin)
        sim.method.refresh_list()
        counts.append(len(check_list(sim)))
        skin *= RATIO**4
    assert counts == sorted(counts) and counts[-1] > 2 * counts[0]


@pytest.mark.parametrize("workers", [1, 2, 3])
def test_workers(start: Start, workers: int) -> None:
    """Any number of workers, pieces or not, makes the list of one."""
    rng = np.random.default_rng(42)
    kinds = (LONG, SHORT, Kind(4, 3.0))
    which = np.repeat([0, 1, 2], [8, 100, 40])
    fibers = [bent_fiber(kinds[k], rng, 110.0 * rng.random(3)) for k in which]
    sim = cell(start, kinds, fibers, which, box={"size": [112.0] * 3})
    one = sim.method.list
    many = NeighborList(
        sim.model,
        sim.state,
        reach=one.reach,
        skin=one.skin,
        longest_rest=one.longest_rest,
        stretch=one.stretch_allowed,
        workers=workers,
    )
    expected = one.host_pairs()
    many.set_stretch(one.stretch_allowed)
    many.build(wrap=False)
    for got, want in zip(many.host_pairs(), expected, strict=True):
        assert got.tobytes() == want.tobytes()
    n = many.pair_count
    assert (many.in_pair.numpy()[:n] == one.in_pair.numpy()[:n]).all()
    many.close()


def test_few_candidates(start: Start) -> None:
    """In a random cell of V_f = 0.1 the law is asked about little more than what is kept.

    The volume around a segment in which midpoints are compared is 12 times the listed pairs, half
    of it is looked at; the run of cells holds some ten times that.
    """
    rng = np.random.default_rng(43)
    kind, count = Kind(1, 5.0), 2500
    edge = 2.0 * (count * 5.0 * np.pi / 4.0 / 0.1) ** (1.0 / 3.0)
    axes = isotropic(rng, count)
    fibers = [straight_fiber(kind, p, edge * rng.random(3)) for p in axes]
    sim = cell(start, (kind,), fibers, box={"size": [edge] * 3})
    kept, looked = sim.method.list.kept_count, sim.method.list.search_counts()
    assert kept > count
    assert kept <= looked["confirmed"] <= 1.02 * kept
    assert looked["compared"] <= 6 * kept
    assert looked["in_cells"] <= 80 * kept


def test_pieces_follow_the_lengths() -> None:
    """Equal lengths stay whole; one long segment among many short ones is cut."""
    assert piece_counts([10.0, 10.0], [100, 300], 2.6, 1e5) == [1, 1]
    assert piece_counts([10.0, 14.0], [100, 300], 2.6, 1e5) == [1, 1]
    long, short = piece_counts([50.0, 1.0], [10, 1000], 2.6, 1e5)
    assert short == 1 and long > 5


def test_skin_follows_the_motion(start: Start) -> None:
    """A fast flow takes a thicker skin than a slow one, never one that the box has no room for."""
    kind = Kind(2, 4.0, modulus=3000.0)
    fibers, _ = random_fibers((kind,), 60, [34.0] * 3, seed=44, spread=5.0)
    skins = {}
    for dt in (2e-4, 4e-3):
        sim = cell(
            start, (kind,), fibers, flow=SHEAR, box={"size": [34.0] * 3}, numerics={"dt": dt}
        )
        sim.step(int(0.6 / dt))
        pairs, choice = sim.method.list, sim.method.skin
        assert pairs.skin == choice.skin
        assert choice.least <= pairs.skin <= choice.largest
        assert choice.mean(sim.step_count) > 0.0
        skins[dt] = pairs.skin
        report = sim.method.list_report()
        assert report["builds"] == pairs.build_count
    assert skins[4e-3] > skins[2e-4]
    tight = cell(
        start,
        (kind,),
        fibers[:10],
        flow=SHEAR,
        box={"size": [13.0] * 3},
        numerics={"dt": 4e-3},
    )
    tight.step(150)
    height = 13.0 / np.sqrt(1.25)
    assert tight.method.list.cell_width <= height
    assert tight.method.skin.largest < 4.0


def test_pairs_cost_by_method(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """An implicit step passes over most pairs of its list, so a thicker skin costs it less.

    Bonded spheres in vectors look at near pairs in every step, at all others hardly ever.
    """
    kind = Kind(2, 4.0)
    fibers, _ = random_fibers((kind,), 60, [34.0] * 3, seed=45, spread=5.0)
    explicit = cell(start, (kind,), fibers, flow=SHEAR, box={"size": [34.0] * 3}).method.skin
    assert explicit.pair_cost == PAIR_COST > STEP_PAIR_COST
    skins = [
        dataclasses.replace(explicit, pair_cost=k, use=0.06) for k in (STEP_PAIR_COST, PAIR_COST)
    ]
    thicker = [skin.cost(1.2, 4.0) - skin.cost(0.6, 4.0) for skin in skins]
    assert thicker[0] < thicker[1]
    for method in METHODS:
        sim = Simulation(meeting_scene(method, 75), workers=1)
        assert sim.method.skin.pair_cost == STEP_PAIR_COST
        sim.close()
    for vectors, cost in ((True, NEAR_PAIR_COST), (False, LISTED_COST)):
        monkeypatch.setattr("warpfiber.methods.bonded_spheres.NATIVE", vectors)
        bed = crowd()
        assert bed.method.contacts.search.skin.pair_cost == cost  # type: ignore[attr-defined]
        bed.close()


def test_report_of_builds_and_skins(start: Start) -> None:
    """Mean skin over the steps taken, steps per build; a continued run counts its own steps."""
    kind = Kind(2, 4.0, modulus=3000.0)
    fibers, _ = random_fibers((kind,), 60, [50.0] * 3, seed=44, spread=5.0)

    def begin() -> Simulation:
        box = {"size": [50.0] * 3}
        return cell(start, (kind,), fibers, flow=SHEAR, box=box, numerics={"dt": 4e-3})

    run, skins = begin(), []
    for _ in range(120):
        skins.append(run.method.list.skin)  # of the list that this step uses
        run.step()
    assert len(set(skins)) > 1
    report, diameter = run.method.list_report(), 2.0
    assert report["skin_mean_diameters"] == pytest.approx(np.mean(skins) / diameter, abs=1e-4)
    assert report["steps_per_build"] == round(120 / run.method.list.build_count, 2)
    again = begin()
    built = again.method.list.build_count
    again.restore(run.snapshot())
    again.step(60)
    builds = again.method.list.build_count
    assert builds > built + 1
    assert again.method.list_report()["steps_per_build"] == round(60 / builds, 2)
