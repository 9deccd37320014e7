"""The scene schema: every table and key of a scene file, with kind, unit, default and validity.

SI numbers, degrees, vectors as lists of 3; x is the flow, z the gradient, the thickness and up.
Defaults that depend on other tables are resolved in `resolving.py`, rules between keys in
`crosschecks.py`, what this version cannot run in `availability.py`.
"""

from __future__ import annotations

from warpfiber.scene.derived import INERTIALESS
from warpfiber.scene.keys import Inline, Key, OneOf, Table
from warpfiber.scene.kinds import (
    Choice,
    Device,
    Direction,
    Either,
    ListOf,
    Number,
    OrientationTensor,
    Switch,
    Text,
)

ANY = Number()
FRACTION = Number(above=0, below=1)
LENGTH = Number("m", above=0)
MODULUS = Number("Pa", above=0)
COUNT = Number(least=1, below=2**31, whole=True)
INDEX = Number(whole=True)
VECTOR = ListOf(ANY, count=3)
POINT = ListOf(Number("m"), count=3)
SPEED = ListOf(Number("m/s"), count=3)
CSV_FILE = Text("the name of a .csv file", (".csv",))
BIN = ListOf(ANY, count=3, what="[lower (m), upper (m), count]")

INERTIAL = ("bead_chain", "bonded_spheres")
ORIENTATION = Either((Choice(("isotropic", "planar", "aligned")), OrientationTensor()))

BOX = Table(
    "box",
    (
        Key("size", ListOf(LENGTH, count=3), required=True),
        Key(
            "boundary",
            ListOf(Choice(("periodic", "wall", "open")), count=3),
            default=("periodic", "periodic", "periodic"),
        ),
        Key(
            "volume_rule",
            Choice(("cylinder", "capsule", "centerline")),
            default="cylinder",
            method_default=(("bonded_spheres", "capsule"),),
        ),
    ),
)

FLOW_KINDS = (
    "simple_shear",
    "planar_extension",
    "uniaxial_extension",
    "gradient",
    "field",
    "rest",
)
FLOW = Table(
    "flow",
    (
        Key("kind", Choice(FLOW_KINDS), required=True),
        Key("viscosity", Number("Pa s", above=0), required=True),
        Key("shear_rate", Number("1/s", above=0), required=True, when=("kind", ("simple_shear",))),
        Key(
            "extension_rate",
            Number("1/s", nonzero=True),
            required=True,
            when=("kind", ("planar_extension", "uniaxial_extension")),
        ),
        Key(
            "gradient",
            ListOf(ListOf(Number("1/s"), count=3, what="a row"), count=3, what="rows"),
            required=True,
            when=("kind", ("gradient",)),
        ),
        Key(
            "file",
            Text("the name of a .npz file", (".npz",)),
            required=True,
            when=("kind", ("field",)),
        ),
        Key("origin", POINT),
        Key(
            "schedule",
            ListOf(ListOf(ANY, count=2, what="a pair [strain, factor]"), least=1, what="pairs"),
        ),
    ),
)

LAYER = Table(
    "layers",
    (
        Key("thickness", LENGTH, required=True),
        Key("volume_fraction", FRACTION, required=True),
        Key("orientation", ORIENTATION, default="isotropic"),
        Key("direction", Direction()),
    ),
)
LENGTH_DISTRIBUTION = Table(
    "length_distribution",
    (
        Key("kind", Choice(("weibull", "lognormal"))),
        Key("number_average", LENGTH),
        Key("weight_average", LENGTH),
        Key("maximum", LENGTH),
        Key("minimum", LENGTH),
        Key("histogram", Either((CSV_FILE, ListOf(BIN, least=1, what="bins")))),
        Key("kunc_diameter", LENGTH),
    ),
    one_of=(OneOf(("number_average", "histogram")), OneOf(("weight_average", "histogram"))),
)
ANGLE = Number("degrees")
CURVATURE = Number("1/m", nonzero=True)
BENT = ("kind", ("bent",))
SHAPE_KINDS = ("straight", "ring", "s", "u", "z", "bent", "points")
SHAPE = Table(
    "shape",
    (
        Key("kind", Choice(SHAPE_KINDS), required=True),
        Key("curvature", CURVATURE, required=True, when=("kind", ("s",))),
        Key("angle", ANGLE, required=True, when=("kind", ("u",))),
        Key("middle", LENGTH, required=True, when=BENT),
        Key("tip", LENGTH, required=True, when=BENT),
        Key("corner1", ANGLE, required=True, when=BENT),
        Key("corner2", ANGLE, required=True, when=BENT),
        Key("dihedral", ANGLE, required=True, when=BENT),
        Key("file", Text("a file name"), required=True, when=("kind", ("points",))),
    ),
)
FIBERS = Table(
    "fibers",
    (
        Key("count", COUNT),
        Key("volume_fraction", FRACTION),
        Key("layers", Either((Inline(LAYER, many=True), CSV_FILE))),
        Key("layer_mode", Choice(("span", "inside"))),
        Key("wedged", Choice(("keep", "mirror")), default="keep"),
        Key("aspect_ratio", Number(above=1, below=1e6)),
        Key("length", LENGTH),
        Key("centerline_length", LENGTH),
        Key("length_distribution", Inline(LENGTH_DISTRIBUTION)),
        Key("diameter", LENGTH, required=True),
        Key("density", Number("kg/m3", above=0), required=INERTIAL),
        Key("youngs_modulus", MODULUS, required=True),
        Key("axial_modulus", MODULUS),
        Key("bending_modulus", Number("Pa", least=0)),
        Key("inextensible", Switch(), default=False),
        Key("frozen", Switch(), default=False),
        Key("poisson_ratio", Number(above=-1), default=0.5, methods=("bonded_spheres",)),
        Key("bond_damping", Number(least=0), default=0.0, methods=("bonded_spheres",)),
        Key("shape", Inline(SHAPE), default={"kind": "straight"}),
        Key("orientation", ORIENTATION, default="isotropic"),
        Key("direction", Direction()),
        Key("orientation_law", Choice(("acg", "bingham")), default="acg"),
        Key("position", Either((Choice(("random",)), ListOf(POINT, least=1), POINT))),
        Key("node_file", Text("the name of a .npz or .csv file", (".npz", ".csv"))),
        Key("initial_velocity", Either((Choice(("flow", "rest")), SPEED))),
    ),
    one_of=(
        OneOf(("count", "volume_fraction", "layers", "node_file")),
        OneOf(("aspect_ratio", "length", "centerline_length", "length_distribution", "node_file")),
    ),
    many=True,
)

CONTACT = Table(
    "contact",
    (
        Key(
            "law",
            Choice(("none", "exponential", "linear", "hertz")),
            default="exponential",
            method_default=(("bonded_spheres", "hertz"),),
        ),
        Key("strength", Number("N", above=0), when=("law", ("exponential",))),
        Key("decay", Number(above=0), default=50.0, when=("law", ("exponential",))),
        Key("stiffness", Number("N/m", above=0), required=True, when=("law", ("linear",))),
        Key("lubrication", Choice(("none", "paper", "shifted")), default="none"),
        Key("modulus", MODULUS, methods=("bonded_spheres",)),
        Key("damping", Number(least=0), default=0.0, methods=("bonded_spheres",)),
        Key("friction", Number(least=0), default=0.0),
        Key("wall_friction", Number(least=0), default=0.0),
    ),
)

CYLINDER = ("kind", ("cylinder",))
WALL = Table(
    "wall",
    (
        Key("name", Text(), required=True),
        Key("kind", Choice(("plane", "cylinder", "fiber_array")), default="plane"),
        Key("normal", Direction(), when=("kind", ("plane",))),
        Key("position", POINT, when=("kind", ("plane",))),
        Key("axis", Direction(), required=True, when=CYLINDER),
        Key("center", POINT, required=True, when=CYLINDER),
        Key("radius", LENGTH, required=True, when=CYLINDER),
        Key("height", LENGTH, required=True, when=CYLINDER),
        Key("diameter", LENGTH, required=True, when=("kind", ("fiber_array",))),
        Key("velocity", Either((Choice(("flow",)), SPEED))),
        Key("friction", Number(least=0)),
    ),
    many=True,
)

GRAVITY = Table(
    "gravity",
    (
        Key("acceleration", ListOf(Number("m/s2"), count=3), default=(0.0, 0.0, -9.81)),
        Key("fluid_density", Number("kg/m3", least=0), default=0.0),
    ),
)

LOAD = Table(
    "load",
    (
        Key("group", INDEX, default=0),
        Key("fiber", INDEX, default=0),
        Key("node", INDEX, default=-1),
        Key("force", ListOf(Number("N"), count=3)),
        Key("hold", Choice(("free", "position", "clamp")), default="free"),
        Key("velocity", SPEED),
    ),
    many=True,
)

START = Table(
    "start", (Key("from", Text("the name of a run folder"), required=True), Key("stage", Text()))
)

PRESS = ("compress", "unload")
DRAG = ("pull", "shear")
END_KEYS = ("end_strain", "end_time", "end_speed", "end_volume_fraction", "end_pressure")
STAGE = Table(
    "stage",
    (
        Key("kind", Choice(("flow", "settle", "pour", *PRESS, *DRAG)), required=True),
        Key("name", Text()),
        Key("save", Switch(), default=False),
        Key("end_strain", Number(above=0)),
        Key("end_time", Number("s", above=0)),
        Key("end_speed", Number("m/s", above=0)),
        Key("end_volume_fraction", FRACTION),
        Key("end_pressure", Number("Pa", least=0)),
        Key("time_limit", Number("s", above=0)),
        Key("wall", Text("the name of a wall"), required=True, when=("kind", PRESS)),
        Key("speed", Number("m/s", above=0), required=True, when=("kind", PRESS + DRAG)),
        Key("control", Choice(("displacement", "load")), when=("kind", PRESS)),
        Key("pressure_rate", Number("Pa/s", above=0), required=True, when=("control", ("load",))),
        Key("damping", Number("1/s", least=0), default=0.0, when=("kind", ("settle", "pour"))),
        Key("interval", Number("s", least=0), default=0.0, when=("kind", ("pour",))),
        Key("batch", COUNT, when=("kind", ("pour",))),
        Key("freeze_below", Number("m"), required=True, when=("kind", DRAG)),
        Key("freeze_above", Number("m"), required=True, when=("kind", DRAG)),
        Key("freeze", Choice(("fibers", "nodes")), when=("kind", DRAG)),
        Key("repeat_from", Text("the name of an earlier stage")),
        Key("repeat", COUNT),
    ),
    one_of=(OneOf(END_KEYS, several=True),),
    many=True,
)

QUANTITIES = (
    "orientation",
    "orientation4",
    "contacts",
    "overlap",
    "interactions",
    "axial_strain",
    "energy",
    "rotation",
    "curvature",
    "stress",
    "inclination",
)
NODE_FIELDS = ("velocity", "curvature", "bond_stress", "contact_count")
RECORD = Table(
    "record",
    (
        Key("frames", COUNT),
        Key("every_strain", Number(above=0)),
        Key("every_time", Number("s", above=0)),
        Key("scalars", COUNT, default=1000),
        Key(
            "quantities",
            ListOf(Choice(QUANTITIES), unique=True),
            default=("orientation", "contacts", "overlap"),
        ),
        Key("node_fields", ListOf(Choice(NODE_FIELDS), unique=True), default=()),
        Key("layers", Number(least=0, below=1001, whole=True), default=0),
        Key("trajectory", Switch(), default=True),
        Key("usd", Switch(), default=False),
        Key("figures", Switch(), default=True),
        Key("checkpoint_every", Number("s", above=0), default=600.0),
    ),
    one_of=(OneOf(("frames", "every_strain", "every_time"), required=False),),
)

SEGMENT_COUNT = Number(least=1, below=2**31, whole=True)
BEADS = Number(least=0)
AUTO = Choice(("auto",))
NUMERICS = Table(
    "numerics",
    (
        Key(
            "method",
            Choice(("bead_chain", "overdamped", "rigid_rod", "bonded_spheres", "auto")),
            required=True,
        ),
        Key("segments", Either((SEGMENT_COUNT, ListOf(SEGMENT_COUNT, least=1)))),
        Key("segment_length", Either((LENGTH, ListOf(LENGTH, least=1)))),
        Key("reduced_beads", Either((BEADS, ListOf(BEADS, least=1)))),
        Key(
            "closure",
            Choice(("none", "paper", "consistent")),
            default="consistent",
            methods=("bead_chain", *INERTIALESS),
        ),
        Key(
            "torque_weights",
            Choice(("end_weighted", "plain")),
            default="end_weighted",
            methods=("bead_chain", *INERTIALESS),
        ),
        Key(
            "integrator",
            Choice(("sdirk2", "bdf2")),
            methods=("overdamped",),
            method_default=(("overdamped", "sdirk2"),),
        ),
        Key(
            "contact",
            Choice(("penalty", "unilateral")),
            default="penalty",
            method_default=(("overdamped", "unilateral"), ("rigid_rod", "unilateral")),
        ),
        Key("contact_tolerance", Number(above=0), default=1e-3, methods=INERTIALESS),
        Key("linearizations", Number(least=1, below=3, whole=True), default=1, methods=INERTIALESS),
        Key("dt", Either((Number("s", above=0), AUTO))),
        Key("strain_step", Number(above=0)),
        Key("tolerance", Number(above=0), methods=("overdamped",)),
        Key(
            "dt_fraction",
            Number(above=0),
            default=0.5,
            method_default=(("bonded_spheres", 0.3),),
            methods=INERTIAL,
        ),
        Key("allow_unstable_dt", Switch(), default=False),
        Key("precision", Choice(("float32", "float64")), default="float64"),
        Key(
            "bond_shear",
            Choice(("rbf", "ga")),
            methods=("bonded_spheres",),
            method_default=(("bonded_spheres", "rbf"),),
        ),
        Key("device", Device(), default="auto"),
        Key("workers", Either((COUNT, AUTO))),
        Key("skin", Either((LENGTH, AUTO))),
        Key(
            "lubrication_step",
            Choice(("limited", "explicit")),
            default="limited",
            methods=("bead_chain",),
        ),
    ),
    one_of=(
        OneOf(("segments", "segment_length", "reduced_beads"), required=False),
        OneOf(("dt", "strain_step", "tolerance"), required=False),
    ),
)

TOP = Table(
    "", (Key("title", Text(), default=""), Key("seed", Number(least=0, whole=True), default=1))
)

TABLES = (BOX, FLOW, FIBERS, CONTACT, WALL, GRAVITY, LOAD, START, STAGE, RECORD, NUMERICS)
"""All tables in the order of the schema; the top level is `TOP`."""
