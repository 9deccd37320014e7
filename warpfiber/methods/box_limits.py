"""How far a periodic box may deform: its heights must hold a segment and its reach.

Source: a cell list over a lattice needs every height of the box >= longest segment + reach + skin.
    Simple shear along two box axes resets the lattice at half a box of shear; any other linear flow
    deforms the box for good, so the run ends at the strain where the smallest height reaches that
    limit.
"""

from __future__ import annotations

import math

import numpy as np

from warpfiber.scene import Fault, Scene, SceneError

LARGEST_STRAIN = 1000.0  # a box that bears this much is taken to bear any


def box_heights(lattice: np.ndarray) -> np.ndarray:
    """(3,) distances of opposite faces of the box with the columns of `lattice` as edges."""
    heights: np.ndarray = 1.0 / np.linalg.norm(np.linalg.inv(lattice), axis=1)
    return heights


def bearable_strain(scene: Scene, width: float) -> float:
    """Strain up to which every height of the scene's box is at least `width` (m); inf if always.

    Raises SceneError (box.size) if the box is too small from the start.
    """
    box, flow = scene.box, scene.flow
    if box is None:
        return math.inf
    size = np.asarray(box.size)
    wraps = [kind == "periodic" for kind in box.boundary]
    smallest = min(size[wraps], default=math.inf)
    end = math.inf
    if all(wraps) and flow is not None and flow.rate > 0.0:
        gradient = np.asarray(flow.velocity_gradient)
        entries = np.argwhere(gradient != 0.0)
        if len(entries) == 1 and entries[0][0] != entries[0][1]:
            smallest = _smallest_sheared_height(size, (int(entries[0][0]), int(entries[0][1])))
        else:
            end = strain_limit(size, gradient, flow.rate, width)
    if smallest < width:
        remedy = (
            f"a periodic box must be {width:.4g} m high everywhere (longest segment + reach + "
            "skin, shear included); enlarge it or take more segments"
        )
        raise SceneError([Fault(scene.path, "box.size", list(box.size), remedy)])
    return end


def lasting_height(scene: Scene) -> float:
    """Height (m) that the scene's box keeps everywhere for good; 0 if its flow flattens it."""
    box, flow = scene.box, scene.flow
    if box is None:
        return math.inf
    size = np.asarray(box.size)
    wraps = [kind == "periodic" for kind in box.boundary]
    if all(wraps) and flow is not None and flow.rate > 0.0:
        entries = np.argwhere(np.asarray(flow.velocity_gradient) != 0.0)
        if len(entries) != 1 or entries[0][0] == entries[0][1]:
            return 0.0
        return _smallest_sheared_height(size, (int(entries[0][0]), int(entries[0][1])))
    return float(min(size[wraps], default=math.inf))


def _smallest_sheared_height(size: np.ndarray, axes: tuple[int, int]) -> float:
    """Smallest height of a box that is reset at half a box of shear."""
    lattice = np.diag(size)
    lattice[axes[0], axes[1]] = 0.5 * size[axes[0]]
    return float(box_heights(lattice).min())


def strain_limit(size: np.ndarray, gradient: np.ndarray, rate: float, width: float) -> float:
    """Strain at which the smallest height falls to `width`; inf if not by LARGEST_STRAIN.

    `gradient` (3, 3) 1/s and `rate` 1/s at factor 1; the lattice follows exp(gradient t).
    """
    step, strain = 0.05, 0.0
    lattice = np.diag(size).astype(float)
    push = _exponential(gradient * (step / rate))
    while strain < LARGEST_STRAIN:
        after = push @ lattice
        if box_heights(after).min() < width:
            if step < 1e-4:
                return strain
            step *= 0.5
            push = _exponential(gradient * (step / rate))
            continue
        lattice, strain = after, strain + step
    return math.inf


def _exponential(matrix: np.ndarray) -> np.ndarray:
    """exp of a small matrix by its series."""
    term = total = np.eye(3)
    for k in range(1, 16):
        term = term @ matrix / k
        total = total + term
    return total
