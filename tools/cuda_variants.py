"""Which variants of every kernel are compiled for CUDA.

A kernel is made by a factory from a precision and flags. The `FULLEST` variants have every term
there is, need the most registers and are compiled in both precisions. `PLAINEST` ones have the
branches that these lack, in one precision: tests/unit/test_compile_cuda.py asks that every flag
takes each of its values here, and that every factory of a kernel that CUDA runs is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from warpfiber.passes.bond_drift import make_bond_drift
from warpfiber.passes.bond_energy import make_measure_bonds
from warpfiber.passes.bond_losses import make_bond_losses
from warpfiber.passes.bonds import BondFeatures, make_bond_sweep
from warpfiber.passes.capsule_features import CapsuleFeatures
from warpfiber.passes.capsule_hits import make_capsule_hits
from warpfiber.passes.capsule_pairs import make_capsule_pairs
from warpfiber.passes.cells import ListFeatures, make_cell_kernels
from warpfiber.passes.chain_blocks import make_chain_moves, make_end_kernels
from warpfiber.passes.chain_load import make_chain_load
from warpfiber.passes.chain_pace import make_chain_pace
from warpfiber.passes.chain_response import make_chain_apply, make_chain_response
from warpfiber.passes.chain_solve import CHI, make_chain_step
from warpfiber.passes.check_sweeps import CheckFeatures, make_check_sweeps
from warpfiber.passes.clock import make_clock
from warpfiber.passes.contact_energy import make_contact_energy
from warpfiber.passes.contact_losses import make_contact_losses
from warpfiber.passes.contact_memory import make_carry_memory
from warpfiber.passes.contact_verdict import make_contact_verdict
from warpfiber.passes.dual_rows import make_dual_balance, make_dual_step, make_fold_sums
from warpfiber.passes.dual_setup import make_dual_begin, make_dual_lists
from warpfiber.passes.grip_meter import make_grip_meter, make_grip_sum
from warpfiber.passes.held_nodes import make_carry_fibers
from warpfiber.passes.joined_steps import make_gates
from warpfiber.passes.list_bound import make_list_bound
from warpfiber.passes.list_extension import make_extension_kernels
from warpfiber.passes.measure import (
    MeasureFeatures,
    make_measure_fibers,
    make_measure_pairs,
    make_measure_terms,
)
from warpfiber.passes.measure_layers import make_measure_layers
from warpfiber.passes.measure_stress import make_measure_stress
from warpfiber.passes.nodes import NodeFeatures, make_node_sweep
from warpfiber.passes.overlap_choice import make_overlap_choice
from warpfiber.passes.pair_groups import make_pair_groups
from warpfiber.passes.pair_motion import make_pair_motion
from warpfiber.passes.pairs import PairFeatures, make_pair_sweep
from warpfiber.passes.prune_kernels import make_plain_prune, make_wide_kernels
from warpfiber.passes.rigid_rods import make_rod_maps, make_rod_step
from warpfiber.passes.rod_response import make_rod_apply, make_rod_response
from warpfiber.passes.row_count import RowFeatures, make_row_count
from warpfiber.passes.row_fill import make_row_fill
from warpfiber.passes.row_search import make_row_search
from warpfiber.passes.row_slip import make_row_slip
from warpfiber.passes.rows import make_row_kernels
from warpfiber.passes.rub_response import make_chain_rub, make_rod_rub, make_rub_clear
from warpfiber.passes.step_control import (
    make_largest_error,
    make_step_begin,
    make_step_end,
    make_take_back,
)
from warpfiber.passes.wall_press import make_push_sum, make_wall_meter, make_wall_motion
from warpfiber.passes.wall_servo import make_wall_servo

PRECISIONS = ("float32", "float64")
PLAIN_PRECISION = PRECISIONS[0]

Variant = tuple[Callable[..., Any], tuple[Any, ...]]
"""A factory, and its arguments after the precision."""

NONE, FLOOR, ALL = (False, False, False), (False, False, True), (True, True, True)

_HELD_RINGS = BondFeatures(dashpots=True, walls=FLOOR, loads=True, closed=True, planes=1)
_BED = BondFeatures(dashpots=True, walls=FLOOR, pairs=True, wall_friction=True)
_RINGS = replace(_BED, container=True, closed=True)
_GRIPPED = replace(_BED, press=2, loads=True, grips=True, planes=1)
_RUBBING = CapsuleFeatures(True, dashpot=True, friction=True, closed=True, recorded=True)
_PAIRS = PairFeatures(lubrication="shifted", periodic=True, sheared=True)
_LISTED = ListFeatures(ALL, (0, 2), True, True, True, True, True)
_ROWS = RowFeatures(True, FLOOR, "shifted", True)
_CHOSEN = RowFeatures(True, FLOOR, "none", True, True)

FULLEST: tuple[Variant, ...] = (
    (make_clock, (True, True)),
    (make_step_begin, (True,)),
    (make_step_end, (True, True, True)),
    (make_largest_error, ()),
    (make_take_back, (True,)),
    (make_chain_step, (True, True)),
    (make_chain_step, (False, False)),  # the frame that this one has differs
    (make_carry_fibers, (True, CHI)),
    (make_rod_maps, ()),
    (make_rod_step, (True,)),
    (make_bond_sweep, (_RINGS, False, True)),
    (make_bond_sweep, (_GRIPPED, False, True)),
    (make_bond_sweep, (_HELD_RINGS, True, True)),  # it alone turns nodes, which needs a frame
    (make_bond_drift, ()),
    (make_bond_losses, (_RINGS,)),
    (make_bond_losses, (_GRIPPED,)),
    (make_pair_groups, ()),
    (make_capsule_hits, (_RUBBING,)),
    (make_capsule_pairs, (_RUBBING,)),
    (make_contact_energy, (_RUBBING,)),
    (make_contact_losses, (True,)),
    (make_carry_memory, (True,)),
    (make_grip_sum, ()),
    (make_measure_bonds, (FLOOR, True, True, 1)),
    *[(make_dual_begin, (law, True)) for law in ("hard", "linear", "exponential")],
    *[(make_dual_balance, (law, True)) for law in ("hard", "linear", "exponential")],
    (make_dual_lists, ()),
    (make_dual_step, ()),
    (make_dual_begin, ("hard", True, "unique", True)),
    (make_dual_step, ("unique", True)),
    (make_dual_balance, ("hard", False, "unique", True)),
    (make_row_slip, (True, True)),
    (make_rub_clear, ()),
    (make_rod_rub, (True,)),
    (make_chain_rub, (True,)),
    (make_rod_response, (True,)),
    (make_rod_apply, ()),
    (make_end_kernels, ()),
    (make_chain_moves, (True,)),
    (make_chain_response, (True,)),
    (make_chain_apply, ()),
    (make_chain_pace, ()),
    (make_chain_load, (True,)),
    (make_node_sweep, (NodeFeatures("consistent", pairs="arms", walls=ALL, gravity=True),)),
    (make_node_sweep, (NodeFeatures("paper", pairs="arms", walls=ALL, gravity=True),)),
    (make_pair_sweep, (_PAIRS,)),
    (make_cell_kernels, (_LISTED,)),
    (make_row_kernels, (_LISTED,)),
    (make_row_search, (_LISTED,)),
    (make_row_count, (_ROWS,)),
    (make_row_count, (_CHOSEN,)),
    (make_overlap_choice, ()),
    (make_row_fill, (_ROWS,)),
    (make_row_fill, (_CHOSEN,)),
    (make_check_sweeps, (CheckFeatures(True, FLOOR, True, True, True, True, True, True),)),
    (make_pair_motion, (True,)),
    (make_list_bound, ()),
    (make_extension_kernels, ()),
    (make_wide_kernels, ()),
    (make_plain_prune, (True,)),
    (make_measure_fibers, (MeasureFeatures(True, True, True, ALL),)),
    (make_measure_layers, (True,)),
    (make_measure_stress, (True,)),
    (make_measure_pairs, (_PAIRS,)),
    (make_measure_terms, ("closest",)),
)
PLAINEST: tuple[Variant, ...] = (
    (make_clock, (False, False)),
    (make_step_begin, (False,)),
    (make_step_end, (False, False, False)),
    (make_take_back, (False,)),
    (make_carry_fibers, (False, CHI)),
    (make_bond_sweep, (BondFeatures(), False, False)),
    (make_bond_losses, (BondFeatures(),)),
    (make_capsule_hits, (CapsuleFeatures(),)),
    (make_capsule_pairs, (CapsuleFeatures(),)),
    (make_contact_energy, (CapsuleFeatures(),)),
    (make_contact_losses, (False,)),
    (make_carry_memory, (False,)),
    (make_measure_bonds, (NONE, False, False)),
    (make_dual_begin, ("hard", False)),
    (make_dual_balance, ("hard", False)),
    (make_rod_step, (False,)),
    (make_rod_response, (False,)),
    (make_measure_stress, (False,)),
    (make_row_slip, (False, False)),
    (make_rod_rub, (False,)),
    (make_chain_rub, (False,)),
    (make_chain_moves, (False,)),
    (make_chain_response, (False,)),
    (make_chain_load, (False,)),
    (make_node_sweep, (NodeFeatures("none"),)),
    (make_node_sweep, (NodeFeatures("consistent", pairs="closest"),)),
    (make_pair_sweep, (PairFeatures(),)),
    (make_pair_sweep, (PairFeatures(repulsion=False, lubrication="paper", closed=True),)),
    (make_cell_kernels, (ListFeatures(NONE),)),
    (make_row_kernels, (ListFeatures(NONE),)),
    (make_row_search, (ListFeatures(NONE),)),
    (make_row_count, (RowFeatures(),)),
    (make_row_count, (RowFeatures(True, lubrication="paper"),)),
    (make_row_fill, (RowFeatures(),)),
    (make_row_fill, (RowFeatures(True, lubrication="paper"),)),
    (make_check_sweeps, (CheckFeatures(),)),
    (make_pair_motion, (False,)),
    (make_plain_prune, (False,)),
    (make_measure_fibers, (MeasureFeatures(inertia=False),)),
    (make_measure_fibers, (MeasureFeatures(energy=True, curvature=True, inertia=False),)),
    (make_measure_layers, (False,)),
    (make_measure_pairs, (PairFeatures(False, "paper", closed=True),)),
    (make_measure_pairs, (PairFeatures(),)),
    *[(make_measure_terms, (pairs,)) for pairs in ("none", "arms")],
)
IN_NO_PRECISION: tuple[Variant, ...] = (
    (make_wall_motion, (2,)),
    (make_push_sum, ()),
    (make_wall_meter, (2,)),
    (make_wall_servo, ()),
    (make_grip_meter, ()),
    (make_fold_sums, ()),
    (make_contact_verdict, ()),
    (make_gates, ()),
)


def variants() -> Iterator[tuple[str, Variant]]:
    """(precision, variant) of all that is compiled."""
    for precision in PRECISIONS:
        yield from ((precision, variant) for variant in FULLEST)
    yield from ((PLAIN_PRECISION, variant) for variant in PLAINEST)
    yield from (("", variant) for variant in IN_NO_PRECISION)


def kernels() -> Iterator[tuple[str, str, Any]]:
    """(kernel, variant, Warp kernel) of all that is compiled."""
    for precision, (factory, arguments) in variants():
        made = factory(*([precision] if precision else []), *arguments)
        several = made.values() if isinstance(made, dict) else made
        flags = ", ".join(_words(argument) for argument in arguments)
        for kernel in several if isinstance(made, dict | tuple) else (made,):
            yield kernel.func.__name__, f"{precision} {flags}".strip(), kernel


def _words(argument: Any) -> str:
    """A flag in the table: of features what differs from their defaults."""
    if not hasattr(argument, "__dataclass_fields__"):
        return str(argument)
    fields = argument.__dataclass_fields__
    given = [name for name, at in fields.items() if getattr(argument, name) != at.default]
    return " ".join(given) or "plain"
