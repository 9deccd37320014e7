"""Host side of the layers: what each holds now, in SI, as arrays over the layers.

Columns: `length` of centerline (m), `volume_fraction`, a_ij by length (a11 ...); `fibers` with
their middle in the layer, their L_N and L_W (m) and a_ij by number (a11_fiber ...); A_ijkl of both
kinds if asked for. nan where a layer holds nothing.

Symbols: L_N, L_W number and weight average of the length tip to tip.
Limits: layers of one thickness; in a box that deforms they deform with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from warpfiber.model import Model, State
from warpfiber.passes.measure_layers import LAYER_SUMS, LAYER_SUMS4, make_measure_layers

CHUNKS = 256


class LayerProfile:
    """Measures `count` layers; `fiber_volume`: m^3 of one fiber of each group."""

    def __init__(
        self,
        model: Model,
        state: State,
        count: int,
        fiber_volume: Sequence[float],
        orientation4: bool = False,
    ) -> None:
        self.model, self.state, self.count = model, state, count
        self.columns = LAYER_SUMS + (LAYER_SUMS4 if orientation4 else ())
        self.kernel = make_measure_layers(model.precision.name, orientation4)
        volume = np.asarray(fiber_volume, dtype=np.float64) / model.units.length**3
        self.group_volume = wp.array(volume, dtype=wp.float64, device=model.device)

    def edges(self) -> np.ndarray:
        """(count + 1,) heights of the planes above the floor of the box now, m."""
        normal = np.linalg.inv(self.state.lattice.numpy()[0])[2]
        height = self.model.units.length / np.linalg.norm(normal)
        planes: np.ndarray = height * np.arange(self.count + 1) / self.count
        return planes

    def measure(self) -> dict[str, np.ndarray]:
        """Columns (count,) now."""
        sums = dict(zip(self.columns, self._sums().T, strict=True))
        units, lattice = self.model.units, self.state.lattice.numpy()[0]
        space = abs(float(np.linalg.det(lattice))) / self.count
        found: dict[str, np.ndarray] = {
            "length": sums["length"] * units.length,
            "volume_fraction": sums["volume"] / space,
            "fibers": sums["fibers"],
            "number_average_length": _ratio(sums["fiber_length"], sums["fibers"]) * units.length,
            "weight_average_length": _ratio(sums["fiber_length2"], sums["fiber_length"])
            * units.length,
        }
        for name in self.columns:
            if name.startswith("a"):
                by = "fibers" if name.endswith("_fiber") else "length"
                found[name] = _ratio(sums[name], sums[by])
        return found

    def _sums(self) -> np.ndarray:
        """(count, columns) in run units."""
        model, state = self.model, self.state
        normal = np.linalg.inv(state.lattice.numpy()[0])[2] * self.count
        chunks = min(CHUNKS, model.fiber_count)
        shape = chunks * self.count, len(self.columns)
        sums = wp.zeros(shape, dtype=wp.float64, device=model.device)
        inputs: list[Any] = [
            chunks,
            model.fiber_count,
            self.count,
            bool(model.domain.periodic[2]),
            wp.vec3d(*map(float, model.domain.low)),
            wp.vec3d(*map(float, normal)),
            self.group_volume,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            state.node_pos,
            sums,
        ]
        wp.launch(self.kernel, dim=chunks, inputs=inputs, device=model.device)
        parts = sums.numpy().reshape(chunks, self.count, len(self.columns))
        total: np.ndarray = parts.sum(axis=0)
        return total


def _ratio(sums: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """sums / weights, nan where nothing was weighed."""
    mean: np.ndarray = np.divide(sums, weights, out=np.full(len(sums), np.nan), where=weights > 0.0)
    return mean
