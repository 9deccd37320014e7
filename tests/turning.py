"""What a single turning fiber is judged by: strain of its half turn, and path of its tip."""

from __future__ import annotations

import numpy as np

import warpfiber as wf


def half_turn(simulation: wf.Simulation) -> float:
    """Strain at which the end-to-end vector passes -x (cubic through four samples)."""
    strain, angle = [0.0], [0.0]
    while len(angle) < 5 or angle[-3] > -np.pi:
        simulation.run(until=simulation.strain + 0.2)
        axis = simulation.node_pos[-1] - simulation.node_pos[0]
        step = np.arctan2(axis[2], axis[0]) - angle[-1]
        strain.append(simulation.strain)
        angle.append(angle[-1] + (step + np.pi) % (2.0 * np.pi) - np.pi)
        assert strain[-1] < 400.0, "the fiber does not turn"
    fit = np.polyfit(np.array(angle[-5:-1]) + np.pi, np.array(strain[-5:-1]), 3)
    return float(np.polyval(fit, 0.0))


def tips(scene: wf.Scene, strains: np.ndarray) -> np.ndarray:
    """x/L, z/L of the last node at the given strains, (K, 2)."""
    simulation = wf.Simulation(scene)
    found = []
    for strain in strains:
        simulation.run(until=float(strain))
        # the step ends up to one dt past the mark
        late = (simulation.strain - strain) / scene.flow.rate
        nodes = simulation.node_pos - late * simulation.node_velocity
        tip = nodes[-1] - nodes.mean(axis=0)
        found.append(tip[[0, 2]] / scene.fibers[0].centerline_length)
    simulation.close()
    return np.array(found)
