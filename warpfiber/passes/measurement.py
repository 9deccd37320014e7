"""Host side of the measurements: launches the reductions a scene asks for, adds their sums.

Definitions: orientation tensors a_ij, A_ijkl of segments weighted by length, and (names that end in
`_fiber`) of end-to-end vectors, one vote per fiber; an interaction is a pair of segments under
repulsion or under lubrication (both: two), counted for both fibers; a contact is a pair with
D <= 2a; coordination number = distinct touching fibers; overlap = max(0, 2a - D) in radii, mean
over touching pairs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import Model, State
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.measure import (
    FIBER_MAXIMA,
    FIBER_SUMS,
    FIBER_SUMS4,
    PAIR_SUMS,
    TERMS,
    MeasureFeatures,
    make_measure_fibers,
    make_measure_pairs,
    make_measure_terms,
)
from warpfiber.passes.neighbors import NeighborList
from warpfiber.passes.pairs import PairFeatures
from warpfiber.passes.tensor_sums import TENSOR

CHUNKS = 256
FIBER_QUANTITIES = {"orientation", "orientation4", "axial_strain", "energy", "curvature"}
PAIR_QUANTITIES = {"contacts", "interactions", "overlap"}


class Measurement:
    """Measures what `quantities` names; everything else is neither launched nor allocated."""

    def __init__(
        self,
        model: Model,
        state: State,
        quantities: tuple[str, ...],
        pair_features: PairFeatures,
        strength: float,
        decay: float,
        inertia: bool = True,
    ) -> None:
        self.model, self.state = model, state
        self.counted = model.fiber_count  # of its fibers, the first ones; the others are absent
        self.inertia = inertia
        self.quantities = frozenset(quantities)
        self.pair_features = pair_features
        self.strength, self.decay = strength, decay
        self.angle: np.ndarray | None = None
        if "rotation" in self.quantities:
            self.angle = self._axis_angle()

    def kernels(self, pairs: NeighborList | None) -> list[Any]:
        """The kernels that `row` will launch."""
        found = []
        if self.quantities & FIBER_QUANTITIES:
            found.append(self._fiber_kernel())
        if pairs is not None and self.quantities & (PAIR_QUANTITIES | {"energy"}):
            found.append(self._pair_kernel())
        return found

    def _fiber_kernel(self) -> Any:
        name = self.model.precision.name
        return make_measure_fibers(name, self._fiber_features(), self._module())

    def _pair_kernel(self) -> Any:
        return make_measure_pairs(self.model.precision.name, self.pair_features, self._module())

    def _module(self) -> str:
        name = self.model.precision.name
        return kernel_module("measure", name, self._fiber_features(), self.pair_features)

    def row(self, pairs: NeighborList | None) -> dict[str, float]:
        """All asked quantities now, in SI (overlaps in radii)."""
        row: dict[str, float] = {}
        wanted = self.quantities
        if wanted & FIBER_QUANTITIES:
            row |= self._fiber_row()
        if wanted & PAIR_QUANTITIES or ("energy" in wanted and pairs is not None):
            row |= self._pair_row(pairs)
        if self.angle is not None:
            step = self._axis_angle() - self.angle
            self.angle = self.angle + (step + np.pi) % (2.0 * np.pi) - np.pi
            row["angle"] = float(self.angle.mean())
        return row

    def _axis_angle(self) -> np.ndarray:
        """Angle of every end-to-end vector in the x-z plane, (F,) rad."""
        start = self.model.host["fiber_node_start"]
        nodes = self.state.node_pos.numpy()
        axis = nodes[start[1:] - 1].astype(float) - nodes[start[:-1]]
        return np.arctan2(axis[:, 2], axis[:, 0])

    def _sums(self, kernel: Any, sums: int, maxima: int, count: int, inputs: list[Any]) -> Any:
        """Launch a reduction over `count` items and add the partial sums of its chunks in order."""
        device = self.model.device
        chunks = min(CHUNKS, count)
        total = wp.zeros((chunks, sums), dtype=wp.float64, device=device)
        largest = wp.zeros((chunks, maxima), dtype=wp.float64, device=device)
        wp.launch(
            kernel, dim=chunks, inputs=[chunks, count, *inputs, total, largest], device=device
        )
        return total.numpy().sum(axis=0), largest.numpy().max(axis=0)

    def _fiber_features(self) -> MeasureFeatures:
        wanted, no_walls = self.quantities, (False, False, False)
        return MeasureFeatures(
            orientation4="orientation4" in wanted,
            energy="energy" in wanted,
            curvature="curvature" in wanted,
            walls=self.model.domain.wall if self.strength > 0.0 else no_walls,
            inertia=self.inertia,
        )

    def _fiber_row(self) -> dict[str, float]:
        model, state, wanted = self.model, self.state, self.quantities
        features = self._fiber_features()
        p, low = model.precision, np.asarray(model.domain.low)
        columns = len(FIBER_SUMS) + (len(FIBER_SUMS4) if features.orientation4 else 0)
        values, largest = self._sums(
            self._fiber_kernel(),
            columns,
            len(FIBER_MAXIMA),
            self.counted,
            [
                p.vec3(*low),
                p.vec3(*(low + np.asarray(model.domain.size))),
                p.real(self.strength),
                p.real(self.decay),
                model.groups,
                model.fiber_node_start,
                model.fiber_group,
                state.node_pos,
                state.node_velocity,
            ],
        )
        sums = dict(zip(FIBER_SUMS, values, strict=False))
        row: dict[str, float] = {}
        if "orientation" in wanted:
            row |= {name: sums[name] / sums["length"] for name in TENSOR}
            row |= {f"{n}_fiber": sums[f"{n}_fiber"] / self.counted for n in TENSOR}
        if features.orientation4:
            for name, value in zip(FIBER_SUMS4, values[len(FIBER_SUMS) :], strict=True):
                by_number = name.endswith("_fiber")
                row[name] = value / (model.fiber_count if by_number else sums["length"])
        if "axial_strain" in wanted:
            row["axial_strain_max"] = largest[0]
        if features.curvature:
            row["curvature_mean"] = sums["curvature"] / sums["length"] / model.units.length
            row["curvature_max"] = largest[1] / model.units.length
            row["bending_strain_mean"] = sums["bending_strain"] / sums["length"]
            row["bending_strain_max"] = largest[2]
        if features.energy:
            names = ["energy_kinetic"] if features.inertia else []
            names += ["energy_stretching", "energy_bending"]
            names += ["energy_wall"] if any(features.walls) else []
            row |= {name: sums[name] * model.units.energy for name in names}
        return {name: float(value) for name, value in row.items()}

    def _pair_row(self, pairs: NeighborList | None) -> dict[str, float]:
        model, wanted = self.model, self.quantities
        sums = dict.fromkeys(PAIR_SUMS, 0.0)
        largest = 0.0
        coordination = 0.0
        if pairs is not None:
            touches = wp.zeros(pairs.pair_capacity, dtype=wp.int32, device=model.device)
            values, maxima = self._pair_sums(pairs, touches)
            sums = dict(zip(PAIR_SUMS, map(float, values), strict=True))
            largest = float(maxima[0])
            if "contacts" in wanted:
                coordination = self._coordination(pairs, touches.numpy())
        fibers = self.counted
        row: dict[str, float] = {}
        if "interactions" in wanted:
            row["interactions_per_fiber"] = 2.0 * (sums["repelling"] + sums["lubricating"]) / fibers
        if "contacts" in wanted:
            row["contacts_per_fiber"] = 2.0 * sums["touching"] / fibers
            row["coordination_number"] = coordination
        if "overlap" in wanted:
            row["overlap_max"] = largest
            row["overlap_mean"] = sums["overlap"] / max(sums["touching"], 1.0)
        if "energy" in wanted:
            row["energy_repulsion"] = sums["energy_repulsion"] * model.units.energy
        return row

    def _pair_sums(self, pairs: NeighborList, touches: Any) -> Any:
        model, state, p = self.model, self.state, self.model.precision
        return self._sums(
            self._pair_kernel(),
            len(PAIR_SUMS),
            1,
            model.segment_count,
            [
                p.real(self.strength),
                p.real(self.decay),
                model.groups,
                model.fiber_node_start,
                model.fiber_group,
                model.segment_node,
                model.segment_end,
                model.segment_fiber,
                pairs.fiber_ring,
                state.lattice,
                pairs.out_start,
                pairs.pair_j,
                pairs.pair_image,
                state.node_pos,
                touches,
            ],
        )

    def _coordination(self, pairs: NeighborList, touches: np.ndarray) -> float:
        """Mean number of distinct other fibers (images apart) that a fiber touches."""
        i, j, image = pairs.host_pairs()
        fiber = self.model.host["segment_fiber"]
        touching = (touches[: len(i)] != 0) & (fiber[i] != fiber[j])
        keys = fiber_pair_keys(fiber[i[touching]], fiber[j[touching]], image[touching])
        return 2.0 * len(np.unique(keys)) / self.counted


def fiber_pair_keys(first: np.ndarray, second: np.ndarray, image: np.ndarray) -> np.ndarray:
    """(n,) a number for every pair of fibers and its image, the same for the same pair.

    Numbers are sorted several times faster than rows.
    """
    fibers = 1 + int(second.max(initial=0))
    images = 1 + int(np.ptp(image)) if len(image) else 1
    shift = image.astype(np.int64) - (int(image.min()) if len(image) else 0)
    keys: np.ndarray = (first.astype(np.int64) * fibers + second) * images + shift
    return keys


def measure_fiber_terms(
    model: Model,
    state: State,
    fiber: int,
    flow_origin: np.ndarray,
    pairs: NeighborList | None,
    pair_acts: Any,
    pair_force: Any,
) -> np.ndarray:
    """Largest force of every term (TERMS) on one fiber, N; not finite where the state is not."""
    p, device = model.precision, model.device
    terms = wp.zeros(len(TERMS), dtype=wp.float64, device=device)
    nothing = wp.zeros(0, dtype=wp.int32, device=device)
    wp.launch(
        make_measure_terms(p.name, "none" if pairs is None else "pairs"),
        dim=1,
        inputs=[
            fiber,
            p.vec3(*flow_origin),
            model.groups,
            model.fiber_node_start,
            model.fiber_segment_start,
            model.fiber_group,
            state.gradient,
            state.node_pos,
            state.node_velocity,
            pairs.out_start if pairs else nothing,
            pairs.in_start if pairs else nothing,
            pairs.in_pair if pairs else nothing,
            pair_acts,
            pair_force,
            terms,
        ],
        device=device,
    )
    sizes: np.ndarray = terms.numpy() * model.units.force
    return sizes
