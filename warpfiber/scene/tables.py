"""The tables of a scene after reading: frozen, in SI, with all defaults resolved.

One class per table, one field per key, the unit under it; None means absent. `from` is `from_`.
Symbols: L length tip to tip, L_c = L - d centerline node to node, d diameter, r_f = L/d,
M = (r_f - 1)/segments bead spacing in diameters, D = symmetric part of the velocity gradient.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]
Matrix = tuple[Vector, Vector, Vector]


@dataclass(frozen=True, kw_only=True)
class Box:
    """`[box]`: the cell that is simulated, from 0 to `size`."""

    size: Vector
    """m"""
    boundary: tuple[str, str, str]
    """per axis: periodic, wall, open"""
    volume_rule: str
    """volume of a fiber: cylinder, capsule, centerline"""

    @property
    def volume(self) -> float:
        """Volume of the box, m^3."""
        return math.prod(self.size)


@dataclass(frozen=True, kw_only=True)
class Flow:
    """`[flow]`: the imposed flow of the fluid."""

    kind: str
    """simple_shear, planar_extension, uniaxial_extension, gradient, field, rest"""
    viscosity: float
    """Pa s"""
    shear_rate: float | None = None
    """1/s"""
    extension_rate: float | None = None
    """1/s"""
    gradient: Matrix | None = None
    """1/s, row i = du_i/dx_j"""
    file: str | None = None
    """path of a flow field"""
    origin: Vector = (0.0, 0.0, 0.0)
    """m, where the linear flow is at rest"""
    schedule: tuple[tuple[float, float], ...] | None = None
    """pairs (strain, factor on the rate), linear between"""

    @property
    def velocity_gradient(self) -> Matrix | None:
        """Velocity gradient (3, 3), L_ij = du_i/dx_j at factor 1, 1/s; None for a field."""
        zero = (0.0, 0.0, 0.0)
        if self.kind == "simple_shear":
            return ((0.0, 0.0, self.shear_rate or 0.0), zero, zero)
        rate = self.extension_rate or 0.0
        if self.kind == "planar_extension":
            return ((rate, 0.0, 0.0), zero, (0.0, 0.0, -rate))
        if self.kind == "uniaxial_extension":
            return ((rate, 0.0, 0.0), (0.0, -0.5 * rate, 0.0), (0.0, 0.0, -0.5 * rate))
        if self.kind == "gradient":
            return self.gradient
        return (zero, zero, zero) if self.kind == "rest" else None

    @property
    def rate(self) -> float:
        """Growth of the strain at factor 1, 1/s: shear rate, |extension rate|, sqrt(2 D:D) or 0."""
        if self.kind == "simple_shear":
            return self.shear_rate or 0.0
        if self.kind in ("planar_extension", "uniaxial_extension"):
            return abs(self.extension_rate or 0.0)
        return strain_rate(self.gradient) if self.gradient is not None else 0.0

    def factor(self, strain: float) -> float:
        """Factor of the schedule on the rate at a strain; constant before and after the pairs."""
        if not self.schedule:
            return 1.0
        before = self.schedule[0]
        for pair in self.schedule:
            if strain < pair[0]:
                if pair is before:
                    return pair[1]
                part = (strain - before[0]) / (pair[0] - before[0])
                return before[1] + part * (pair[1] - before[1])
            before = pair
        return before[1]


@dataclass(frozen=True, kw_only=True)
class Shape:
    """`shape` of a fiber group: the stress-free form."""

    kind: str
    """straight, ring, s, u, z, bent, points"""
    curvature: float | None = None
    """1/m, of an s"""
    angle: float | None = None
    """degrees, dihedral angle of the tips of a u"""
    middle: float | None = None
    """m, of a bent one"""
    tip: float | None = None
    """m, each of the two tips"""
    corner1: float | None = None
    """degrees, interior angle between first tip and middle"""
    corner2: float | None = None
    """degrees, between middle and last tip"""
    dihedral: float | None = None
    """degrees, between the planes of the tips: 0 on one side, 180 on opposite ones"""
    file: str | None = None
    """absolute path of the node file of one fiber"""


@dataclass(frozen=True, kw_only=True)
class LengthDistribution:
    """`length_distribution` of a fiber group: averages and limits of L, or a histogram."""

    kind: str
    """lognormal, weibull, histogram"""
    number_average: float | None = None
    """m; None with a histogram"""
    weight_average: float | None = None
    """m; None with a histogram"""
    maximum: float
    """m"""
    minimum: float
    """m"""
    histogram: tuple[tuple[float, ...], ...] | None = None
    """rows lower (m), upper (m), count"""
    kunc_diameter: float | None = None
    """m, of the column that the fibers were taken from"""


@dataclass(frozen=True, kw_only=True)
class Layer:
    """One of the `layers` of a fiber group, counted from z = 0 up."""

    thickness: float
    """m"""
    volume_fraction: float
    orientation: str | tuple[float, ...]
    """isotropic, planar (in xy), aligned, or a11, a22, a33, a12, a13, a23"""
    direction: Vector | None = None
    """unit vector, if aligned"""


@dataclass(frozen=True, kw_only=True)
class FiberGroup:
    """One `[[fibers]]`: fibers that are alike. With `node_file` count and sizes are 0.

    With `length_distribution` they are 0, too, until the table is split into groups of one length.
    """

    diameter: float
    """m"""
    density: float | None = None
    """kg/m^3; None where nothing has inertia or weight"""
    youngs_modulus: float
    """Pa"""
    axial_modulus: float
    """Pa, for stretching"""
    bending_modulus: float
    """Pa, 0 = free joints"""
    count: int
    """number of fibers"""
    volume_fraction: float | None = None
    """as asked for, None if a count was"""
    volume_fraction_achieved: float | None = None
    """of `count` fibers, by the box's volume rule; None without a box"""
    aspect_ratio: float
    """r_f = L/d"""
    length: float
    """m, tip to tip"""
    centerline_length: float
    """m, node to node"""
    segments: int
    """per fiber"""
    length_distribution: LengthDistribution | None = None
    layers: tuple[Layer, ...] | None = None
    layer_mode: str | None = None
    """span: fibers reach through layers; inside: each stays in its own"""
    wedged: str = "keep"
    """mirror: drawn fibers too long to turn between the walls lie on the other side of the shear"""
    table: int | None = None
    """number of the [[fibers]] that this group was split off from"""
    inextensible: bool = False
    frozen: bool = False
    poisson_ratio: float = 0.5
    bond_damping: float = 0.0
    shape: Shape
    orientation: str | tuple[float, ...]
    """isotropic, planar (in xy), aligned, or a11, a22, a33, a12, a13, a23"""
    direction: Vector | None = None
    """unit vector, if aligned"""
    orientation_law: str = "acg"
    """distribution with that tensor: acg (angular central Gaussian), bingham"""
    position: str | tuple[Vector, ...]
    """random, or centers in m: one per fiber, or one that all share"""
    node_file: str | None = None
    """absolute path of .npz (`node_pos` (F, n, 3)) or .csv (fiber, x, y, z)"""
    initial_velocity: str | Vector
    """flow, rest, or m/s"""

    @property
    def radius(self) -> float:
        """Radius a = d/2, m."""
        return 0.5 * self.diameter

    @property
    def bead_spacing(self) -> float:
        """M = (r_f - 1)/segments, segment length in diameters, >= 1; 0 if a file has the nodes."""
        return max(1.0, (self.aspect_ratio - 1.0) / self.segments) if self.aspect_ratio else 0.0

    @property
    def reduced_beads(self) -> float:
        """N_R = M - 1, beads left out per segment; 0 is the unreduced chain (SBCM)."""
        return max(0.0, self.bead_spacing - 1.0)


@dataclass(frozen=True, kw_only=True)
class Contact:
    """`[contact]`: forces between fibers that are near each other."""

    law: str
    """none, exponential"""
    strength: float = 0.0
    """D_0, N; of `exponential`, else 0"""
    decay: float = 50.0
    """G_0; of `exponential`"""
    stiffness: float | None = None
    """N/m; of `linear`"""
    lubrication: str
    """none, paper, shifted"""
    modulus: float | None = None
    """Pa"""
    damping: float = 0.0
    friction: float = 0.0
    wall_friction: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Wall:
    """One `[[wall]]`: a rigid wall that is added, or a plane of the box that is altered."""

    name: str
    kind: str
    normal: Vector | None = None
    """unit vector, inward"""
    position: Vector | None = None
    """m, a point of the plane"""
    axis: Vector | None = None
    """unit vector"""
    center: Vector | None = None
    """m"""
    radius: float | None = None
    """m"""
    height: float | None = None
    """m"""
    diameter: float | None = None
    """m, of the fibers of a fiber_array"""
    velocity: str | Vector | None = None
    """flow, or m/s"""
    friction: float | None = None


@dataclass(frozen=True, kw_only=True)
class Gravity:
    """`[gravity]`: weight less buoyancy."""

    acceleration: Vector
    """m/s^2"""
    fluid_density: float
    """kg/m^3"""


@dataclass(frozen=True, kw_only=True)
class Load:
    """One `[[load]]`: a force on, or a hold of, one node."""

    group: int
    fiber: int
    node: int
    """indices from 0, -1 the last"""
    force: Vector | None = None
    """N"""
    hold: str
    """free, position, clamp"""
    velocity: Vector | None = None
    """m/s, of a held node"""


@dataclass(frozen=True, kw_only=True)
class Start:
    """`[start]`: fibers, box and history taken from a saved stage of another run."""

    from_: str
    """run folder"""
    stage: str | None = None
    """name of the saved stage"""


def strain_rate(gradient: tuple[tuple[float, ...], ...]) -> float:
    """sqrt(2 D:D) of a velocity gradient (3, 3), 1/s; D its symmetric part."""
    axes = range(3)
    doubled = [gradient[i][j] + gradient[j][i] for i in axes for j in axes]
    return math.sqrt(0.5) * math.hypot(*doubled)
