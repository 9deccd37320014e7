"""warpfiber: cells of very many flexible fibers, on CPU and CUDA from the same kernels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from warpfiber.job import Job
    from warpfiber.output import (
        TrajectoryReader,
        exact_orientation,
        export_usd,
        fit_run,
        plot_run,
        read_scalars,
    )
    from warpfiber.scene import Scene, SceneError, load_scene
    from warpfiber.simulation import Diverged, Simulation

# In the order a user meets them; imported on first use, so that `import warpfiber` and the commands
# that need no device start at once.
_ROOMS = {
    "load_scene": "warpfiber.scene",
    "Scene": "warpfiber.scene",
    "SceneError": "warpfiber.scene",
    "Simulation": "warpfiber.simulation",
    "Diverged": "warpfiber.simulation",
    "Job": "warpfiber.job",
    "TrajectoryReader": "warpfiber.output",
    "read_scalars": "warpfiber.output",
    "plot_run": "warpfiber.output",
    "export_usd": "warpfiber.output",
    "fit_run": "warpfiber.output",
    "exact_orientation": "warpfiber.output",
}

__all__ = [
    "Diverged",
    "Job",
    "Scene",
    "SceneError",
    "Simulation",
    "TrajectoryReader",
    "exact_orientation",
    "export_usd",
    "fit_run",
    "load_scene",
    "plot_run",
    "read_scalars",
]


def __getattr__(name: str) -> Any:
    if name not in _ROOMS:
        raise AttributeError(f"module 'warpfiber' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_ROOMS[name]), name)
