"""Steps of methods that are stable at any size: chosen by the strain of a step.

Source: errors of an S-turn against dt (second order: 2e-5 L at a strain of 0.05 per step, 4e-4 L at
    0.2 with SDIRK2); the length of segments errs by 13 % at 0.5.
"""

from __future__ import annotations

import math

from warpfiber.scene import Scene

AUTO_STRAIN = 0.05  # strain per step of `auto`, and of the first step with a tolerance
SLIP = 2.0  # radii that both tips of a fiber across the gradient move per unit strain and r_f
LARGEST_STRAIN = 0.2  # strain per step above which a turn is no longer followed


def _fastest(scene: Scene) -> float:
    """Largest rate of the flow over its schedule, 1/s."""
    if scene.flow is None:
        return 0.0
    return scene.flow.rate * max(abs(row[1]) for row in scene.flow.schedule or ((0.0, 1.0),))


def largest_step(scene: Scene) -> float:
    """dt in s of the largest sensible strain; inf in a fluid at rest."""
    rate = _fastest(scene)
    return LARGEST_STRAIN / rate if rate > 0.0 else math.inf


def step_start(scene: Scene) -> float:
    """dt in s of `auto`; inf in a fluid at rest."""
    return largest_step(scene) * (auto_strain(scene) / LARGEST_STRAIN)


def auto_strain(scene: Scene) -> float:
    """Strain per step of `auto`: tips of fibers that meet slip by no more than a radius."""
    longest = max((group.aspect_ratio for group in scene.fibers), default=0.0)
    if scene.contact.law == "none" or longest == 0.0:
        return AUTO_STRAIN
    return min(AUTO_STRAIN, SLIP / longest)


def strain_step(scene: Scene) -> float:
    """dt in s: as given, the largest one where a tolerance chooses, or `auto`.

    The error that a tolerance bounds does not see contact, which is of first order in dt: fibers
    that meet take no larger steps than those of `auto`.
    """
    numerics = scene.numerics
    if numerics.dt is not None:
        return numerics.dt
    chooses = numerics.tolerance is not None and scene.contact.law == "none"
    return largest_step(scene) if chooses else step_start(scene)
