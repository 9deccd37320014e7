"""How thick the skin of a neighbor list should be: what builds cost against what it adds to sweeps.

A step costs build(s) u / s + pair_cost pairs(s) at the skin s, if motion uses up u of it per step.
Builds tell u and the number of pairs; how the number changes with s follows from the volume around
a segment, 4/3 pi H^3 + 2 pi l H^2 + pi l^2 H / 2 for randomly oriented neighbors nearer than H
(excluded volume of spherocylinders, Onsager 1949).

Where the list is pruned from a wider one (`passes.pruning`), the skin and the number of times that
it is used up before the cells are searched again are chosen together. Measured as sums of parts
(20,000 segments of 5 diameters, V_f = 0.1, SIMD, strain 0.001 per step; ns per segment-step of list
and pair sweep, skins in diameters): one list 26 with a skin of 0.6 (build 249, every 15 steps,
sweep 9.4), 25 of 0.8; a wide one of 0.9 (build 235, every 30 steps) and one of 0.2 pruned from it
(19, every 6 steps, sweep 5.9) 17. Skins and extensions by the speed of each segment last 18 steps
with the pairs that one skin needs for 14: few fibers, pushed by others, end any list (with half as
many pairs 21 of the 20,000 segments in 20 steps, 136 in 40), so that such skins pay only if these
are listed anew on their own.

Nothing here looks at a clock: two runs, and a run and its continuation, choose the same skins and
so build at the same steps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ListCosts:
    """ns, one core, float64, 20,000 segments; only ratios matter."""

    piece: float  # of a build, of every piece
    near: float  # of what a piece finds around it at the first skin
    wide_piece: float  # the same of a wide list
    wide_near: float
    wide_pair: float  # of a pair in it
    prune_segment: float  # of pruning
    prune_pair: float


# Measured with vectors, and without; those of a GPU are not known.
SIMD_COSTS = ListCosts(110.0, 95.0, 90.0, 60.0, 32.0, 10.0, 7.0)
PLAIN_COSTS = ListCosts(340.0, 200.0, 280.0, 160.0, 38.0, 26.0, 19.0)
PAIR_COST, PLAIN_PAIR_COST = 11.0, 21.0  # of one more listed pair in an explicit step
START_SKIN, LEAST_SKIN, MOST_SKIN = 0.3, 0.15, 2.0  # diameters
RATIO = 1.1  # of neighboring choices
WORTH = 0.97  # another skin must cost less than this part of the present one
LARGEST_CHANGE = 1.5  # of one build
LASTING = 1.3  # uses of a step that a skin must have room for
START_TIMES, MOST_PRUNED = 3, 12  # skins used up before cells are searched again
UNEVEN = 1.1  # what a wide list holds more, since skins are used up unevenly
MEMORY = 0.5  # weight of the use before in the mean
# Measured: listed pairs grow with the volume from this part of the distance in contact on.
CORE = 0.85


@dataclass
class SkinChoice:
    """Skin of a list from build to build; lengths in run units."""

    skin: float
    start: float
    largest: float  # that the box allows
    least: float
    radius: float  # the largest
    reach: float
    core: float  # distance of center lines in contact
    length: float  # mean length of a segment
    pieces_per_segment: float
    pair_cost: float = PAIR_COST
    costs: ListCosts = SIMD_COSTS
    fixed: bool = False
    pruned: bool = False  # from a wide list, whose margin beyond the skin is chosen too
    margin: float = 0.0
    use: float = 0.0  # skin per step; 0 as long as nothing is known
    built_step: int = 0
    renewed_step: int = 0  # built or pruned
    # for the report: the mean over steps and what made it
    begun: int = 0  # earlier steps are those of another process
    listed: float = 0.0  # skin of the present list
    steps: int = 0
    skin_steps: float = 0.0

    def volume(self, distance: float) -> float:
        """Where midpoints of segments nearer than `distance` lie, mean over orientations."""
        h, length = distance, self.length
        return math.pi * h * (4.0 / 3.0 * h * h + 2.0 * length * h + 0.5 * length * length)

    def built(self, step: int) -> None:
        """A list was built at this step."""
        taken = self._steps_since(step)
        self.steps += taken
        self.skin_steps += taken * self.listed
        self.built_step, self.listed = step, self.skin
        self.renewed_step = step

    def wear(self, step: int) -> None:
        """A pruned list was used up at `step`."""
        self._use(self.skin / max(1, step - self.renewed_step))
        self.renewed_step = step

    def _use(self, used: float) -> None:
        self.use = used if self.use == 0.0 else MEMORY * self.use + (1.0 - MEMORY) * used

    def _steps_since(self, step: int) -> int:
        return max(0, step - max(self.built_step, self.begun))

    def choose(self, step: int, pairs_per_segment: float, used: float | None = None) -> float:
        """The skin of the next build, after the present one was used up at `step`.

        `used` of it per step, if that is known: then no skin is chosen that lasts none.
        """
        least_lasting = 0.0
        if used is None:
            used = self.skin / max(1, step - self.renewed_step)
        else:
            least_lasting = LASTING * max(used, self.use)
        self._use(used)
        if self.fixed or pairs_per_segment <= 0.0:
            return self.skin
        low = max(self.least, self.skin / LARGEST_CHANGE)
        high = min(self.largest, self.skin * LARGEST_CHANGE)
        best, least = self.skin, WORTH * self.cost(self.skin, pairs_per_segment)
        if best < least_lasting:
            best, least = min(self.largest, least_lasting), math.inf
        skin = self.least
        while skin <= high:
            if (
                skin >= max(low, least_lasting)
                and (cost := self.cost(skin, pairs_per_segment)) < least
            ):
                best, least = skin, cost
            skin *= RATIO
        return best

    def cost(self, skin: float, pairs_per_segment: float) -> float:
        """ns per segment-step, with `pairs_per_segment` at the present skin."""
        per_volume = pairs_per_segment / self._listed_volume(self.skin)
        if self.pruned:
            return self._pruned_least(skin, per_volume)[0]
        pairs = per_volume * self._listed_volume(skin)
        costs = self.costs
        build = self.pieces_per_segment * (costs.piece + costs.near * self._near(skin))
        return build / max(1.0, skin / self.use) + self.pair_cost * pairs

    def first_margin(self) -> float:
        """As long as nothing is known."""
        room = self.largest - self.skin
        margins = (self._margin(self.skin, times) for times in range(START_TIMES, 0, -1))
        return next(margin for margin in margins if margin <= room)

    def choose_margin(self, skin: float, pairs_per_segment: float) -> float:
        """Margin of the wide list beyond this skin, with these pairs at the present one."""
        if not self.pruned or pairs_per_segment <= 0.0:
            return self.margin
        per_volume = pairs_per_segment / self._listed_volume(self.skin)
        return self._margin(skin, self._pruned_least(skin, per_volume)[1])

    def _pruned_least(self, skin: float, per_volume: float) -> tuple[float, int]:
        """Least cost and how often the skin is then used up; one minimum, bounded by the box."""
        least, times = math.inf, 0
        for n in range(1, MOST_PRUNED + 1):
            if n > 1 and self._margin(skin, n) > self.largest - skin:
                break
            cost = self._pruned_cost(skin, n, per_volume)
            if cost >= least:
                break
            least, times = cost, n
        return least, times

    @staticmethod
    def _margin(skin: float, times: int) -> float:
        return UNEVEN * (times - 1) * skin

    def _pruned_cost(self, skin: float, times: int, per_volume: float) -> float:
        wide = skin + self._margin(skin, times)
        lasts, wide_pairs = max(1.0, skin / self.use), per_volume * self._listed_volume(wide)
        costs = self.costs
        build = self.pieces_per_segment * (costs.wide_piece + costs.wide_near * self._near(wide))
        pruning = costs.prune_segment + costs.prune_pair * wide_pairs
        renewing = (pruning + (build + costs.wide_pair * wide_pairs) / times) / lasts
        return renewing + self.pair_cost * per_volume * self._listed_volume(skin)

    def _listed_volume(self, skin: float) -> float:
        return self.volume(self.reach + skin) - self.volume(CORE * self.core)

    def _near(self, skin: float) -> float:
        """What lies around a segment, in that at the first skin."""
        return self._around(skin) / self._around(2.0 * START_SKIN * self.radius)

    def _around(self, skin: float) -> float:
        """Volume around a segment in which midpoints are compared."""
        wide = self.reach + skin + 0.5 * self.length
        return wide * wide * (self.length + 4.0 / 3.0 * wide)

    def set_skin(self, skin: float, margin: float | None = None) -> None:
        """Another skin, and margin as far as the box has room for it."""
        self.skin = skin
        wanted = self.margin if margin is None else margin
        self.margin = min(wanted, max(0.0, self.largest - skin))

    def mean(self, step: int) -> float:
        """Mean skin over the steps so far."""
        steps = self.steps_counted(step)
        now = self._steps_since(step)
        return (self.skin_steps + now * self.listed) / steps if steps else self.skin

    def steps_counted(self, step: int) -> int:
        """Steps since this choice began, in this process."""
        return self.steps + self._steps_since(step)

    def saved(self) -> np.ndarray:
        """What a continued run needs to choose the same."""
        known = [self.skin, self.use, float(self.built_step)]
        return np.asarray([*known, float(self.renewed_step), self.margin] if self.pruned else known)

    def restore(self, saved: np.ndarray) -> None:
        """Take over what `saved` returned."""
        self.skin, self.use = float(saved[0]), float(saved[1])
        self.built_step = self.renewed_step = int(saved[2])
        if self.pruned:
            self.renewed_step, self.margin = int(saved[3]), float(saved[4])
