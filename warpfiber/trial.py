"""A short run of rods that tells whether contact would bend the fibers of a scene.

`auto` takes rods where no force can bend a fiber by more than the tolerance. Where the flow cannot
but a bound on the contact forces leaves it open, the forces themselves decide.
"""

from __future__ import annotations

import dataclasses

from warpfiber.scene import Scene, SceneError
from warpfiber.simulation import BoxExhausted, Diverged, Simulation

TRIAL_STRAIN = 1.0  # the forces of a random start are the largest of a run
LOOKS = 10


def after_trial(scene: Scene, workers: int | None = None) -> Scene:
    """The scene with the method that a trial chooses; as it is where nothing is to be tried.

    Rods that need a larger box than bending fibers, or that nothing keeps apart, are not chosen.
    """
    trial = scene.rod_trial
    if trial is None:
        return scene
    try:
        bending = _contact_bending(trial.scene, workers)
    except (SceneError, BoxExhausted, Diverged) as failed:
        reason = f"a trial of rods fails: {failed}"
        return dataclasses.replace(scene, method_reason=reason, rod_trial=None)
    within = bending <= trial.tolerance
    reason = (
        f"contacts bend fibers by up to {bending:.2g} of their length over a strain of "
        f"{TRIAL_STRAIN:g}, tolerance {trial.tolerance:g}"
    )
    chosen = trial.scene if within else scene
    return dataclasses.replace(chosen, method_reason=reason, rod_trial=None)


def _contact_bending(rods: Scene, workers: int | None) -> float:
    """Most that contact would bend these rods over the trial, in their length."""
    bending, simulation = 0.0, Simulation(rods, workers=workers)
    try:
        for look in range(1, LOOKS + 1):
            simulation.run(until=TRIAL_STRAIN * look / LOOKS)
            bending = max(bending, simulation.method.step_report()["contact_bending"])
    finally:
        simulation.close()
    return bending
