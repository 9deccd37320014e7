"""What the sweeps over pairs of bonded spheres contain."""

from dataclasses import dataclass


@dataclass(frozen=True)
class CapsuleFeatures:
    """Features of a scene; what it lacks is not compiled."""

    periodic: bool = False
    dashpot: bool = False
    friction: bool = False
    closed: bool = False  # some fibers are rings
    recorded: bool = False  # what dissipates is told of every pair that acts
