"""What `warpfiber check` prints: numbers that follow from a scene without running it."""

from __future__ import annotations

import dataclasses
import math

from warpfiber.methods.bead_chain import contact_reach
from warpfiber.methods.box_limits import bearable_strain
from warpfiber.methods.overdamped import overdamped_bytes
from warpfiber.methods.skin import START_SKIN
from warpfiber.methods.stability import StepLimit, chosen_step, step_limits
from warpfiber.methods.strain_steps import LARGEST_STRAIN
from warpfiber.passes.neighbors import FIRST_STRETCH
from warpfiber.placement import shape_feret
from warpfiber.scene import FiberGroup, Scene
from warpfiber.scene.derived import (
    bead_count,
    crowding,
    effective_stiffness,
    equivalent_aspect_ratio,
    jeffery_period,
    longest_segment,
    node_count,
    reynolds_number,
    segment_count,
    total_strain,
)

# Counted in the arrays of shipped scenes on the CPU: integers, and reals of the larger precision.
_BYTES_PER_NODE = 96
_BYTES_PER_SEGMENT, _REAL_BYTES_PER_SEGMENT = 90, 48
_PAIRS_PER_SEGMENT = 1.5  # first capacity; lists of denser cells grow
_BYTES_PER_PAIR = 33
_REAL_BYTES_PER_PAIR = {True: 72, False: 40}  # with and without lubrication


def _number(value: float | None, unit: str = "") -> str:
    return "-" if value is None else f"{value:.4g} {unit}".rstrip()


def memory_bytes(scene: Scene) -> float:
    """Bytes of the arrays of a run, before its lists grow."""
    real = 0.5 if scene.numerics.precision == "float32" else 1.0
    nodes = sum(node_count(group) for group in scene.fibers)
    segments = sum(segment_count(group) for group in scene.fibers)
    size = nodes * _BYTES_PER_NODE * real
    if scene.numerics.method == "overdamped":
        adaptive = scene.numerics.tolerance is not None
        size += overdamped_bytes(nodes, segments, round(8.0 * real), adaptive)
    if contact_reach(scene) > 0.0:
        pair = _BYTES_PER_PAIR + real * _REAL_BYTES_PER_PAIR[scene.contact.lubrication != "none"]
        size += segments * (_BYTES_PER_SEGMENT + real * _REAL_BYTES_PER_SEGMENT)
        size += segments * _PAIRS_PER_SEGMENT * pair
    return size


def record_bytes(scene: Scene) -> float:
    """Bytes of `run.vtkhdf`."""
    frames = scene.record.frames or 100
    nodes = sum(node_count(group) for group in scene.fibers)
    fibers = sum(group.count for group in scene.fibers)
    return frames * 12.0 * (nodes * (1 + len(scene.record.node_fields)) + fibers)


def box_strain_limit(scene: Scene) -> float:
    """Strain that the scene's periodic box can bear; raises SceneError if it is too small."""
    if contact_reach(scene) == 0.0:
        return math.inf
    diameter = max(group.diameter for group in scene.fibers)
    skin = START_SKIN * diameter if scene.numerics.skin is None else scene.numerics.skin
    longest = FIRST_STRETCH * longest_segment(scene)
    return bearable_strain(scene, longest + contact_reach(scene) * diameter + skin)


def _group_lines(scene: Scene, index: int, group: FiberGroup) -> list[tuple[str, str]]:
    head = f"fibers.{index}"
    rows = [
        (f"{head} count", f"{group.count}"),
        ("aspect ratio r_f", _number(group.aspect_ratio)),
        ("volume fraction V_f (asked)", _number(group.volume_fraction_achieved)),
        ("V_f r_f (> 1: reduced = unreduced)", _number(crowding(scene, group))),
        ("effective stiffness S_eff (<< 0.04 bends)", _number(effective_stiffness(scene, group))),
        ("Reynolds number of a bead", _number(reynolds_number(scene, group))),
        ("equivalent aspect ratio r_e", _number(equivalent_aspect_ratio(scene, group))),
        ("Jeffery period", _number(jeffery_period(scene, group), "s")),
        ("segments per fiber N_seg", f"{group.segments}"),
        ("reduced beads per segment N_R", _number(group.bead_spacing - 1.0)),
        (
            "nodes / segments / beads",
            f"{node_count(group)} / {segment_count(group)} / {bead_count(group):.6g}",
        ),
    ]
    if group.volume_fraction is not None:
        name, value = rows[2]
        rows[2] = (name, f"{value} ({group.volume_fraction:.4g})")
    if group.shape.kind != "straight" and group.node_file is None:
        span = shape_feret(scene, index) / group.centerline_length
        rows.append(("maximum Feret diameter / centerline", _number(span)))
    if scene.box is not None:
        edges = " x ".join(f"{group.length / edge:.3g}" for edge in scene.box.size)
        rows.append(("fiber length / box edges", edges))
    return rows


def _table_lines(scene: Scene, table: int) -> list[tuple[str, str]]:
    """One table of fibers of many lengths, or in layers."""
    groups = [group for group in scene.fibers if group.table == table]
    asked = groups[0]
    count = sum(group.count for group in groups)
    total = sum(group.count * group.length for group in groups)
    square = sum(group.count * group.length**2 for group in groups)
    fraction = sum(group.volume_fraction_achieved or 0.0 for group in groups)
    stiff = [effective_stiffness(scene, group) for group in (groups[-1], groups[0])]
    least, most = (pick(group.segments for group in groups) for pick in (min, max))
    share = "" if asked.volume_fraction is None else f" ({asked.volume_fraction:.4g})"
    rows = [
        (f"fibers.{table} count", f"{count} in {len(groups)} lengths"),
        ("number average length L_N", f"{total / count:.5g} m"),
        ("weight average length L_W", f"{square / total:.5g} m"),
        ("shortest and longest fiber", f"{groups[0].length:.4g} and {groups[-1].length:.4g} m"),
        ("volume fraction V_f (asked)", f"{_number(fraction)}{share}"),
        ("V_f L_N / d", _number(fraction * total / count / asked.diameter)),
        ("S_eff of the longest and the shortest", " and ".join(map(_number, stiff))),
        ("segments per fiber N_seg", f"{least} to {most}"),
        (
            "nodes / segments",
            f"{sum(map(node_count, groups))} / {sum(map(segment_count, groups))}",
        ),
    ]
    if asked.layers is not None:
        rows.append((f"layers ({asked.layer_mode})", f"{len(asked.layers)}"))
    return rows


def _limits_told(scene: Scene, limits: tuple[StepLimit, ...]) -> list[StepLimit]:
    """The limits, of the groups of one table only the smallest of each term."""
    told: dict[tuple[str, bool, int], StepLimit] = {}
    for limit in limits:
        table = scene.fibers[limit.group].table
        home = limit.group if table is None else table
        named = dataclasses.replace(limit, group=home)
        told.setdefault((limit.term, table is None, home), named)
    return list(told.values())


def _step_lines(scene: Scene) -> list[tuple[str, str]]:
    """Method, limits of the step, step and number of steps."""
    numerics = scene.numerics
    limits, dt = step_limits(scene), chosen_step(scene)
    rows = [("method", " ".join(filter(None, [numerics.method, numerics.integrator])))]
    if scene.method_reason is not None:
        rows.append(("chosen by auto", scene.method_reason))
    if scene.rod_trial is not None:
        rows.append(("rods instead", "if a trial of the run shows that contact does not bend them"))
    if numerics.method == "rigid_rod":
        rows.append(("dt limit", limits[0].term))
        share = f" = strain {dt * scene.flow.rate:.3g}" if scene.flow and scene.flow.rate else ""
        rows.append(("dt", f"{dt:.4g} s{share}"))
    elif numerics.method == "overdamped":
        rows.append(("dt limit", f"none; a turn is followed up to a strain of {LARGEST_STRAIN}"))
        share = ""
        if math.isfinite(limits[0].dt):
            share = f" = strain {dt / limits[0].dt * LARGEST_STRAIN:.3g}"
        if numerics.tolerance is not None:
            rows.append(("tolerance, lengths of a fiber", _number(numerics.tolerance)))
            rows.append(("largest dt", f"{dt:.4g} s{share}"))
            return rows
        rows.append(("dt", f"{dt:.4g} s{share}"))
    else:
        for limit in _limits_told(scene, limits):
            rows.append((f"dt limit, {limit.term} (fibers.{limit.group})", _number(limit.dt, "s")))
        share = f" = {dt / limits[0].dt:.3g} of the limit set by {limits[0].term}"
        rows.append(("dt", f"{dt:.4g} s{share}"))
    strain = total_strain(scene)
    if strain is not None and scene.flow is not None and scene.flow.rate > 0.0:
        rows.append(("steps", f"{strain / scene.flow.rate / dt:.4g}"))
    return rows


def check_lines(scene: Scene) -> list[str]:
    """The report, one line per number."""
    rows: list[tuple[str, str]] = []
    for index, group in enumerate(scene.fibers):
        if group.table is None:
            rows += _group_lines(scene, index, group)
    for table in dict.fromkeys(g.table for g in scene.fibers if g.table is not None):
        rows += _table_lines(scene, table)
    rows.append(("total strain", _number(total_strain(scene))))
    rows += _step_lines(scene)
    if contact_reach(scene) > 0.0:
        skin = scene.numerics.skin
        text = f"auto, starts with {START_SKIN} diameters" if skin is None else f"{skin:.3g} m"
        rows.append(("neighbor list skin", text))
        limit_strain = box_strain_limit(scene)
        if math.isfinite(limit_strain):
            rows.append(("strain at which the box is too flat", _number(limit_strain)))
    rows.append(("memory of the arrays", f"{memory_bytes(scene) / 1e6:.3g} MB"))
    if scene.record.trajectory:
        rows.append(("size of the record", f"{record_bytes(scene) / 1e6:.3g} MB"))
    width = max(len(name) for name, _ in rows)
    return [f"{name:<{width}}  {value}" for name, value in rows]
