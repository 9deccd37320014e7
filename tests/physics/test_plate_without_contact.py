"""Fibers of the sliding plate without contact against exact orientation curves from the same start.

Source: closed forms of `placement.without_contact`, mixed over the directions and lengths that the
cell has; both weightings.
Tolerance: rods are exact in the strain: rounding of positions in a cell of 460 radii. Chains of
glass bend where they are longer than 2.5 mm, a fifth of the length: 0.003, the bar of the scene.
"""

from __future__ import annotations

import numpy as np
import pytest

from warpfiber.placement.without_contact import direction_tensors, shape_factor
from warpfiber.scene import scene_from_dict
from warpfiber.simulation import Simulation

LENGTHS = {"number_average": 8.3e-4, "weight_average": 1.53e-3, "maximum": 4e-3, "minimum": 5e-5}
SHEAR = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
STRAINS = (5.0, 12.5, 20.0)


@pytest.mark.parametrize(
    ("method", "numerics", "tolerance"),
    [
        ("rigid_rod", {"dt": 0.5}, 1e-9),
        ("overdamped", {"dt": 0.05, "segment_length": 2e-4}, 0.003),
    ],
)
def test_exact_curves(method: str, numerics: dict[str, float], tolerance: float) -> None:
    """2,000 fibers as long and as flat as the paper's, to a strain of 20."""
    sim = Simulation(
        scene_from_dict(
            {
                "seed": 5,
                "box": {"size": [4.4e-3] * 3},
                "flow": {"kind": "simple_shear", "shear_rate": 1.0, "viscosity": 300.0},
                "fibers": [
                    {
                        "count": 2000,
                        "diameter": 19e-6,
                        "density": 2500.0,
                        "youngs_modulus": 7e10,
                        "length_distribution": LENGTHS,
                        "orientation": [0.36, 0.62, 0.02, 0, 0, 0],
                    }
                ],
                "contact": {"law": "none"},
                "stage": [{"kind": "flow", "end_strain": 20.0}],
                "numerics": {"method": method, **numerics},
            }
        )
    )
    model, start = sim.model, sim.fiber_node_start
    span = sim.node_pos[start[1:] - 1] - sim.node_pos[start[:-1]]
    direction = span / np.linalg.norm(span, axis=1)[:, None]
    rows = [model.group_rows[int(k)] for k in model.host["fiber_group"]]
    beads = np.asarray([row["segments"] * row["spacing"] + 1.0 for row in rows])
    factor = shape_factor(np.sqrt(0.5 * (beads**2 + 1.0)))
    by_length = direction_tensors(direction, SHEAR, factor, beads - 1.0, STRAINS)
    by_number = direction_tensors(direction, SHEAR, factor, np.ones(len(beads)), STRAINS)
    for k, strain in enumerate(STRAINS):
        sim.run(until=strain)
        found = sim.measure()
        for expected, name in ((by_length, "a{}{}"), (by_number, "a{}{}_fiber")):
            for i, j in ((0, 0), (2, 2), (0, 2)):
                mine = found[name.format(i + 1, j + 1)]
                assert mine == pytest.approx(expected[k, i, j], abs=tolerance)
    sim.close()
