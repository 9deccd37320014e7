"""The search for pairs of a method: its neighbor list, the skin of the list, what builds cost.

The list is built from the present positions; a skin that was used up is chosen anew, and grows
where it did not last a single step. Segments are listed as long as they slid along themselves in
the time of the list before.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping

import numpy as np

from warpfiber.methods.box_limits import bearable_strain, lasting_height
from warpfiber.methods.skin import (
    LARGEST_CHANGE,
    LEAST_SKIN,
    MOST_SKIN,
    PLAIN_COSTS,
    SIMD_COSTS,
    START_SKIN,
    SkinChoice,
)
from warpfiber.model import PAIR_COUNT, Model, State
from warpfiber.passes.host_arrays import host_view
from warpfiber.passes.neighbors import NeighborList
from warpfiber.scene import Scene

# as PAIR_COST: an implicit step passes over most listed pairs, and looks at all of a new list
STEP_PAIR_COST = 8.0
PRUNED_FROM = 2000  # segments; pruning smaller lists costs its calls more than it saves
MOST_LONGER = 1.5  # times that the next list may last longer because its segments are extended
SPARE = 1.1
# Pairs per segment that there is room for from the start where segments are listed longer, in cells
# so small that growing by and by, with launches captured anew, would cost more than steps.
ROOMY, MOST_ROOMY = 7, 20_000
MEAN_SLIDE = 0.4  # of the farthest; where each segment has an extension of its own


class PairSearch:
    """Neighbor list and skin; lengths in run units.

    `reach`: distance of center lines up to which pairs are listed beside the skin; `pair_cost`:
    of one more listed pair, see `skin.PAIR_COST`; `most_skin`: the largest skin, diameters;
    `prunes`: whether the list may be pruned from a wider one; `slides`: whether segments are listed
    as much longer as each of them slides along itself.
    """

    def __init__(
        self,
        scene: Scene,
        model: Model,
        state: State,
        *,
        reach: float,
        stretch: float,
        workers: int,
        native: bool | None = None,
        pair_cost: float = STEP_PAIR_COST,
        most_skin: float = MOST_SKIN,
        prunes: bool = False,
        slides: bool = False,
    ) -> None:
        self.most_skin = most_skin
        self.scene, self.model, self.state = scene, model, state
        self.pair_cost = pair_cost
        self.seconds = self.prune_seconds = 0.0  # spent on builds and pruning, on pruning alone
        self.prune_count = 0  # beside those of builds
        self.radius = max(row["radius"] for row in model.group_rows)
        skin = START_SKIN * 2.0 * self.radius
        if scene.numerics.skin is not None:
            skin = scene.numerics.skin / model.units.length
        prunes = prunes and scene.numerics.skin is None and model.segment_count >= PRUNED_FROM
        segments = model.segment_count
        roomy = slides and segments <= MOST_ROOMY
        origin = np.zeros(3)
        if scene.flow is not None and scene.flow.origin is not None:
            origin = np.asarray(scene.flow.origin) / model.units.length
        self.list = NeighborList(
            model,
            state,
            reach=reach,
            skin=skin,
            longest_rest=max(row["rest"] for row in model.group_rows),
            stretch=stretch,
            workers=workers,
            native=native,
            pair_capacity=max(64, ROOMY * segments) if roomy else None,
            flow_origin=origin if prunes else None,
            slide_origin=origin if slides else None,
        )
        self.lasting = lasting_height(scene) / model.units.length
        self.skin = self._skin_choice(skin)
        if prunes:
            self.set_skin(skin, self.skin.first_margin())
        self.strain_end = self.bearable_strain()

    def _skin_choice(self, skin: float) -> SkinChoice:
        """The start skin, and between what it may change."""
        rows, pairs = self.model.group_rows, self.list
        counts = np.bincount(self.model.host["fiber_group"], minlength=len(rows))
        segments = counts * np.asarray([row["segments"] for row in rows])
        return SkinChoice(
            skin=skin,
            start=skin,
            radius=self.radius,
            largest=self._largest_skin(skin),
            least=min(skin, 2.0 * LEAST_SKIN * self.radius),
            reach=pairs.reach,
            core=2.0 * min(row["radius"] for row in rows),
            length=float(np.average([row["rest"] for row in rows], weights=segments)),
            pieces_per_segment=pairs.piece_count / self.model.segment_count,
            pair_cost=self.pair_cost,
            costs=SIMD_COSTS if pairs.native else PLAIN_COSTS,
            fixed=self.scene.numerics.skin is not None,
            pruned=pairs.pruning is not None,
        )

    def _largest_skin(self, start: float) -> float:
        """What a lasting box has room for; a box that is flattened keeps the start skin."""
        most: float = min(2.0 * self.most_skin * self.radius, self._room() * (1.0 - 1e-9))
        return max(start, most)

    def _room(self) -> float:
        """Height of the box beyond what a list without skin and extension takes."""
        return self.lasting - self._bare_width

    @property
    def _bare_width(self) -> float:
        """Of the cells of a list without skin and extension."""
        pairs = self.list
        return pairs.cell_width - pairs.skin - pairs.margin - 2.0 * pairs.extension

    def bearable_strain(self) -> float:
        """Strain that the box can bear; raises SceneError if it is too small from the start."""
        return bearable_strain(self.scene, self.box_width * self.model.units.length)

    @property
    def box_width(self) -> float:
        """Smallest height that a periodic box may have.

        With the start skin and no extension: a run and its continuation have chosen others when
        they ask.
        """
        return self._bare_width + self.skin.start

    def set_skin(self, skin: float, margin: float | None = None) -> None:
        """Another skin, and margin of a wide list, from the next build on."""
        self.skin.set_skin(skin, margin)
        if (skin, self.skin.margin) != (self.list.skin, self.list.margin):
            self.list.set_skin(skin, self.skin.margin)

    def set_stretch(self, stretch: float) -> None:
        """Take over a stretch of segments, from the next list on."""
        self.list.set_stretch(stretch)
        self.skin.largest = self._largest_skin(self.skin.start)
        self.set_skin(min(self.skin.skin, self.skin.largest))
        self.strain_end = self.bearable_strain()

    def set_extension(self, extension: float) -> None:
        """Another extension of listed segments, from the next list on."""
        share = 1.0 if self.list.slide_origin is None else MEAN_SLIDE
        self.skin.length += 2.0 * share * (extension - self.list.extension)
        if extension != self.list.extension:
            self.list.set_extension(extension)

    def _next_extension(self, use: np.ndarray, before: float) -> float:
        """What segments will slide while the next skin lasts; `before` the skin used up."""
        slid, across, limit = (float(value) for value in use)
        if self.skin.fixed or not math.isfinite(slid + across):
            return 0.0
        longer = min(MOST_LONGER, limit / across) if 0.0 < across < limit else 1.0
        wanted = SPARE * slid * longer * self.skin.skin / before
        return max(0.0, min(wanted, 0.5 * (self._room() - self.skin.skin)))

    def choose_skin(self, step: int, used: float | None = None) -> None:
        """Another skin, the present one being used up; `used` of it per step, if that is known."""
        listed = float(host_view(self.state.status)[PAIR_COUNT]) / self.model.segment_count
        skin = self.skin.choose(step, listed, used)
        self.set_skin(skin, self.skin.choose_margin(skin, listed))

    def use_up(self, step: int, use: np.ndarray | None = None) -> bool:
        """Choose the next skin, the present one being used up; False if none would last a step.

        `use`: what the list was used up by, see `passes.list_bound`; without it no segment is
        listed longer than it is.
        """
        short = step <= self.skin.built_step and self.list.build_count > 0
        if short and (self.skin.fixed or self.skin.skin >= self.skin.largest):
            return False
        before = self.skin.skin
        share = self._share(use)
        if short and share * before > self.skin.largest:
            return False
        if short:
            self.set_skin(min(self.skin.largest, max(SPARE * share, LARGEST_CHANGE) * before))
        else:
            steps = 1 + max(1, step - self.skin.built_step)  # and the one that it did not last
            self.choose_skin(step, None if share == 0.0 else share * before / steps)
        if use is not None:
            self.set_extension(self._next_extension(use, before))
        return True

    def _share(self, use: np.ndarray | None) -> float:
        """Part of the skin that motion across the segments used up; 0 if that is not known."""
        if use is None:
            return 0.0
        slid, across, limit = (float(value) for value in use)
        if not math.isfinite(slid + across + limit) or limit <= 0.0:
            return 0.0
        return across / limit

    def prune(self, step: int) -> bool:
        """Prune the wide list anew, the present one being used up; False if a build is due."""
        pruning = self.list.pruning
        if pruning is None or self.list.margin == 0.0:
            return False
        begin = time.perf_counter()
        holds = pruning.prune()
        if holds:
            self.skin.wear(step)
            self.prune_count += 1
        taken = time.perf_counter() - begin
        self.seconds += taken
        self.prune_seconds += taken
        return holds

    def refresh(self, step: int, *, wrap: bool = True) -> bool:
        """Build the list now (also clears its expiry); True if pair arrays were replaced."""
        begin, pairs = time.perf_counter(), self.list
        allowed, skin = pairs.stretch_allowed, pairs.skin
        replaced = pairs.build(wrap=wrap)
        if pairs.stretch_allowed > allowed:  # wider cells may leave less room for the skin
            self.set_stretch(pairs.stretch_allowed)
            if pairs.skin < skin:
                replaced |= pairs.build(wrap=False)
        self.seconds += time.perf_counter() - begin
        self.skin.built(step)
        return replaced

    def report(self, step: int) -> dict[str, float]:
        """Skins in largest diameters, builds and what they looked at."""
        pairs, choice = self.list, self.skin
        diameter = 2.0 * choice.radius
        report: dict[str, float] = {
            "skin_diameters": round(choice.skin / diameter, 4),
            "skin_mean_diameters": round(choice.mean(step) / diameter, 4),
            "extension_diameters": round(pairs.extension / diameter, 4),
            "builds": pairs.build_count,
            "growths": pairs.grow_count,
            "steps_per_build": round(choice.steps_counted(step) / max(1, pairs.build_count), 2),
            "pairs": pairs.pair_count,
            "pieces": pairs.piece_count,
        }
        if pairs.pruning is not None:
            wide = choice.skin + pairs.margin
            report |= {"wide_skin_diameters": round(wide / diameter, 4)}
            report |= {"prunes": self.prune_count}
        return report | pairs.search_counts()

    def close(self) -> None:
        """Stop worker threads."""
        self.list.close()

    # -- what is saved ----------------------------------------------------------------------------

    def saved(self) -> dict[str, np.ndarray]:
        """What the next list depends on."""
        allowed = np.asarray(self.list.stretch_allowed)
        extension = np.asarray(self.list.extension)
        known = {"stretch_allowed": allowed, "extension": extension, "skin": self.skin.saved()}
        pruning = self.list.pruning
        if self.list.slide_origin is not None:
            known["segment_extension"] = self.list.segment_extension.numpy().copy()
        return known | (pruning.saved() if pruning is not None else {})

    def restore(self, arrays: Mapping[str, np.ndarray], step: int) -> bool:
        """Build again the list that the saved run had, which was built from older positions."""
        state, pruning = self.state, self.list.pruning
        saved = arrays["skin"]
        self.set_stretch(float(arrays["stretch_allowed"]))
        self.set_skin(float(saved[0]), float(saved[4]) if pruning is not None else None)
        self.set_extension(float(arrays["extension"]))
        if self.list.slide_origin is not None:
            self.list.segment_extension.assign(arrays["segment_extension"])
        self.skin.begun = step
        head = "list" if pruning is None else "wide"
        state.node_pos.assign(arrays[f"{head}_pos"])
        state.lattice.assign(arrays[f"{head}_lattice"])
        replaced = self.refresh(step, wrap=False)
        if pruning is not None:
            state.node_pos.assign(arrays["list_pos"])
            state.lattice.assign(arrays["list_lattice"])
            pruning.restore(arrays)
        self.skin.restore(saved)
        for name in ("node_pos", "lattice", "deformation"):
            getattr(state, name).assign(arrays[name])
        return replaced
