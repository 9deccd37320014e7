"""Model (constant arrays) and State (changing arrays) of one simulation: pure data on one device.

Symbols: F fibers, N nodes, S segments, real = the precision of the run. Everything inside is in the
run's own units (`Units`): the radius of the first fiber group, one over the rate of the flow, and
eta * rate * radius^2 for force, so that float32 neither under- nor overflows.
"""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp


def _start_warp() -> None:
    """Initialize Warp without its announcements.

    Its native part writes a warning to the error stream on every machine without a CUDA driver;
    that one line is held back, everything else is passed on.
    """
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    with tempfile.TemporaryFile() as caught:
        try:
            kept = os.dup(2)
        except OSError:  # no error stream to keep clean
            wp.init()
            return
        os.dup2(caught.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        caught.seek(0)
        for line in caught.read().decode(errors="replace").splitlines():
            if "NVIDIA CUDA driver" not in line:
                print(line, file=sys.stderr)


_start_warp()


@dataclass(frozen=True)
class Precision:
    """The Warp and NumPy types of one precision; `eps` guards divisions by products of lengths."""

    name: str
    real: Any
    vec2: Any
    vec3: Any
    vec4: Any
    mat33: Any
    numpy: Any
    eps: float


_PRECISIONS = {
    "float32": Precision(
        "float32", wp.float32, wp.vec2f, wp.vec3f, wp.vec4f, wp.mat33f, np.float32, 1e-6
    ),
    "float64": Precision(
        "float64", wp.float64, wp.vec2d, wp.vec3d, wp.vec4d, wp.mat33d, np.float64, 1e-12
    ),
}


def precision(name: str) -> Precision:
    """The types of `float32` or `float64`."""
    return _PRECISIONS[name]


# Slots of State.status. A sweep sets EXPIRED (the neighbor list) or TORN (a diverged fiber); the
# next step then only sets HALT and changes nothing until the host has looked, so any number of
# steps may be queued. A build of the list sets STRETCHED (a segment outgrew its cells); OVERFLOW
# bits say which of its capacities is too small.
EXPIRED, TORN, STRETCHED, HALT, BAD_FIBER, OVERFLOW, PAIR_COUNT, ROW_NEED = range(8)
STATUS_SIZE = 8
OVERFLOW_ROW, OVERFLOW_PAIRS = 1, 2


@dataclass(frozen=True)
class Units:
    """One unit of the run in SI: length (m), time (s), force (N)."""

    length: float
    time: float
    force: float

    @property
    def velocity(self) -> float:
        """m/s."""
        return self.length / self.time

    @property
    def energy(self) -> float:
        """J."""
        return self.force * self.length

    @property
    def mass(self) -> float:
        """kg."""
        return self.force * self.time**2 / self.length


@dataclass(frozen=True)
class Domain:
    """The box in run units; axes without a box are open."""

    low: tuple[float, float, float]  # 0 with a box, else the lowest node of the start
    size: tuple[float, float, float]
    periodic: tuple[bool, bool, bool]
    wall: tuple[bool, bool, bool]
    sheared: bool = False  # the lattice moves with the flow (all axes periodic and a flow)
    # (i, j) if the flow is du_i/dx_j alone: the lattice can be reset to less than half a box of
    # shear
    shear_axes: tuple[int, int] | None = None
    # of the walls x-, x+, y- ... (spacing, radius) of an array of fibers, (0, 0) for a plane;
    # empty where all are planes
    arrays: tuple[tuple[float, float], ...] = ()


@dataclass
class Model:
    """What never changes during a run."""

    precision: Precision
    device: str
    units: Units
    domain: Domain
    group_rows: list[dict[str, Any]]  # host copy of `groups`, plus name and counts
    groups: Any  # (G,) passes.precision.group_struct
    pivots: Any  # real: inverse pivots of A by node, one run per group
    fiber_node_start: Any  # (F+1,) int32
    fiber_group: Any  # (F,) int32
    segment_node: Any  # (S,) int32: first node of a segment
    segment_end: Any  # (S,) int32: its second node; nothing where every one is the next
    segment_fiber: Any  # (S,) int32
    fiber_segment_start: Any  # (F+1,) int32
    fiber_count: int
    node_count: int
    segment_count: int
    starts_bent: bool = False  # whether some fiber was bent when the run began, as packed ones are
    host: dict[str, np.ndarray] = field(default_factory=dict)  # NumPy copies of the index arrays


@dataclass
class State:
    """What changes during a run; `time`, `strain` and lattices are float64 in every precision."""

    node_pos: Any  # (N,) vec3, wrapped by whole fibers at every list build
    node_velocity: Any  # (N,) vec3
    node_force: Any  # (N,) vec3: work array of the plain node sweep, F^ND (or A^-1 F^ND)
    fiber_image: Any  # (F,) vec3i: unwrapped = node_pos + lattice * fiber_image
    status: Any  # (STATUS_SIZE,) int32
    step: Any  # (1,) int64
    time: Any  # (1,) float64
    strain: Any  # (1,) float64
    lattice: Any  # (1,) mat33d: columns are the box vectors at the current time
    deformation: Any  # (1,) mat33d: F of the flow since the list was built
    gradient: Any  # (1,) mat33 real: velocity gradient of the step under way
    lattice_now: Any  # (1,) mat33 real: lattice of the step under way, for images
    list_pos: Any  # (N,) vec3: node_pos when the list was built
    list_lattice: Any  # (1,) mat33d
