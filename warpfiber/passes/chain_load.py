"""Contact forces of the last step on flexible fibers, as a load of the next motion without contact.

A fiber that others hold bent would spring far beyond them in a step without contact, and rows made
for such a motion are of no use. So the forces of the last step stay on it, and what they did to the
motion is taken off again by the same linear response by which the new forces act: the result does
not depend on them, but the place where everything is linearized is near the end of the step.
Source: `chain_reply`.
Limits: a step that is taken back leaves the forces of the last one that was kept.
"""

from functools import cache
from typing import Any

import warp as wp

from warpfiber.model import HALT, Model, State, precision
from warpfiber.passes.chain_reply import make_chain_reply
from warpfiber.passes.chain_response import ChainResponse
from warpfiber.passes.chain_solve import CHI
from warpfiber.passes.elimination import elimination_row
from warpfiber.passes.executor import Launch
from warpfiber.passes.held_nodes import FREE, FROZEN
from warpfiber.passes.kernel_module import kernel_module
from warpfiber.passes.precision import group_struct
from warpfiber.passes.unilateral import ContactDual


@cache
def make_chain_load(name: str, loaded: bool, module: str = "unique"):
    """`lay_on`, `take_off`, `note_load`, `add_load`, `keep_load`, by name: a thread per fiber.

    `loaded`: nodes have loads of the scene, or are held.
    """
    p = precision(name)
    real, vec3 = p.real, p.vec3
    Group = group_struct(name)
    Row = elimination_row(name)
    chain_reply = make_chain_reply(name)
    chi, zero, one = real(CHI), real(0.0), real(1.0)
    options = {"module": module, "enable_backward": False, "grid_stride": False}

    @wp.kernel(**options)
    def lay_on(
        offset: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        node_hold: wp.array(dtype=wp.uint8),
        node_load: wp.array(dtype=vec3),
        contact_load: wp.array(dtype=vec3),
        fiber_pace_out: wp.array(dtype=real),
        step_load_out: wp.array(dtype=vec3),
    ):
        """Loads of scene and contact together; of a held node the velocity that it is given."""
        fiber = wp.tid() + offset
        fiber_pace_out[fiber] = one
        for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1]):
            if wp.static(loaded):
                given = node_load[i]
                if wp.int32(node_hold[i]) == wp.static(FREE):
                    given += contact_load[i]
                step_load_out[i] = given
            else:
                step_load_out[i] = contact_load[i]

    @wp.kernel(**options)
    def take_off(
        offset: wp.int32,
        row_stride: wp.int32,
        step_size: wp.array(dtype=wp.float64),
        fiber_pace: wp.array(dtype=real),
        groups: wp.array(dtype=Group),
        fiber_node_start: wp.array(dtype=wp.int32),
        fiber_group: wp.array(dtype=wp.int32),
        rows: wp.array(dtype=Row),
        node_hold: wp.array(dtype=wp.uint8),
        fiber_loaded: wp.array(dtype=wp.uint8),
        contact_load: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        node_reply: wp.array(dtype=vec3),
        reply_impulse: wp.array(dtype=real),
        segment_impulse: wp.array(dtype=real),
        node_shift: wp.array(dtype=vec3),
        node_pos: wp.array(dtype=vec3),
        node_velocity: wp.array(dtype=vec3),
        tension: wp.array(dtype=real),
        node_foreseen_out: wp.array(dtype=vec3),
    ):
        """The motion without what the contact forces did to it; where they led is foreseen."""
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        first = fiber_node_start[fiber]
        segments = fiber_node_start[fiber + 1] - first - 1
        for i in range(first, first + segments + 1):
            node_foreseen_out[i] = node_pos[i]
        if fiber_loaded[fiber] == wp.uint8(0):
            return
        if wp.static(loaded):
            if wp.int32(node_hold[first]) == wp.static(FROZEN):
                return
        dt = real(step_size[0])
        h_force = chi * dt * fiber_pace[fiber]
        chain_reply(
            fiber,
            first,
            segments,
            row_stride * fiber,
            fiber_pace[fiber] * dt,
            groups[fiber_group[fiber]],
            rows,
            contact_load,
            node_reply,
            reply_impulse,
            segment_impulse,
            node_shift,
        )
        for i in range(first, first + segments + 1):
            node_pos[i] = node_pos[i] - node_shift[i]
            node_velocity[i] = node_velocity[i] - node_shift[i] / dt
            if i < first + segments:
                segment = i - fiber
                tension[segment] = tension[segment] - segment_impulse[segment] / h_force

    @wp.kernel(**options)
    def note_load(
        offset: wp.int32,
        again: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        row_count: wp.array(dtype=wp.int32),
        row_out_start: wp.array(dtype=wp.int32),
        in_start: wp.array(dtype=wp.int32),
        in_pair: wp.array(dtype=wp.int32),
        pair_row: wp.array(dtype=wp.int32),
        pair_row_count: wp.array(dtype=wp.int32),
        row_s: wp.array(dtype=real),
        row_t: wp.array(dtype=real),
        row_normal: wp.array(dtype=vec3),
        row_force: wp.array(dtype=real),
        status: wp.array(dtype=wp.int32),
        new_load: wp.array(dtype=vec3),
    ):
        """Node forces of a solve; `again`: they come on top of those of the solve before."""
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        first = fiber_node_start[fiber]
        segments = fiber_node_start[fiber + 1] - first - 1
        if again == 0:
            for i in range(first, first + segments + 1):
                new_load[i] = vec3()
        if row_count[0] == 0 or row_count[0] > row_force.shape[0]:
            return
        behind = vec3()
        for k in range(segments):
            segment = first - fiber + k
            here = behind
            behind = vec3()
            for own in range(row_out_start[segment], row_out_start[segment + 1]):
                force = row_force[own]
                if force != zero:
                    push = force * row_normal[own]
                    here -= (one - row_s[own]) * push
                    behind -= row_s[own] * push
            for incoming in range(in_start[segment], in_start[segment + 1]):
                begin = pair_row[in_pair[incoming]]
                for r in range(begin, begin + pair_row_count[in_pair[incoming]]):
                    force = row_force[r]
                    if force != zero:
                        push = force * row_normal[r]
                        here += (one - row_t[r]) * push
                        behind += row_t[r] * push
            new_load[first + k] = new_load[first + k] + here
        new_load[first + segments] = new_load[first + segments] + behind

    @wp.kernel(**options)
    def add_load(
        offset: wp.int32,
        again: wp.int32,
        fiber_node_start: wp.array(dtype=wp.int32),
        node_push: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        new_load: wp.array(dtype=vec3),
    ):
        """The same where the solve has left the forces on the nodes."""
        if status[wp.static(HALT)] != 0:
            return
        fiber = wp.tid() + offset
        for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1]):
            push = node_push[i]
            if again != 0:
                push += new_load[i]
            new_load[i] = push

    @wp.kernel(**options)
    def keep_load(
        offset: wp.int32,
        rejected: wp.array(dtype=wp.int32),
        fiber_node_start: wp.array(dtype=wp.int32),
        new_load: wp.array(dtype=vec3),
        status: wp.array(dtype=wp.int32),
        fiber_loaded_out: wp.array(dtype=wp.uint8),
        contact_load_out: wp.array(dtype=vec3),
    ):
        """The forces of a step that is kept are the load of the next."""
        if status[wp.static(HALT)] != 0 or rejected[0] != 0:
            return
        fiber = wp.tid() + offset
        is_loaded = wp.uint8(0)
        for i in range(fiber_node_start[fiber], fiber_node_start[fiber + 1]):
            contact_load_out[i] = new_load[i]
            if wp.length_sq(new_load[i]) > zero:
                is_loaded = wp.uint8(1)
        fiber_loaded_out[fiber] = is_loaded

    kernels = [lay_on, take_off, note_load, add_load, keep_load]
    names = ["lay_on", "take_off", "note_load", "add_load", "keep_load"]
    return dict(zip(names, kernels, strict=True))


class ChainLoad:
    """Load of every node in the motion without contact: that of the scene and the last contacts.

    `step_load` (N) vec3 is a force, or the velocity of a node that `step_hold` says is held;
    `contact_load` is saved; `node_foreseen` (N) vec3 is where the step ends if the forces of
    contact stay as they are.
    """

    def __init__(
        self, model: Model, state: State, response: ChainResponse, node_hold: Any, node_load: Any
    ) -> None:
        self.model, self.state, self.response = model, state, response
        self.node_hold, self.node_load = node_hold, node_load
        p, device = model.precision, model.device

        def vectors() -> Any:
            return wp.zeros(model.node_count, dtype=p.vec3, device=device)

        self.contact_load, self.new_load, self.step_load = vectors(), vectors(), vectors()
        self.node_foreseen, self.node_shift = vectors(), vectors()
        self.fiber_loaded = wp.zeros(model.fiber_count, dtype=wp.uint8, device=device)
        loaded = node_hold.shape[0] > 0
        all_free = None if loaded else wp.zeros(model.node_count, dtype=wp.uint8, device=device)
        self.step_hold = node_hold if loaded else all_free
        self.kernels = make_chain_load(p.name, loaded, kernel_module("load", p.name, loaded))

    def _launch(self, name: str, inputs: list[Any], follows: bool = False) -> Launch:
        fibers = self.model.fiber_count
        return Launch(name, self.kernels[name], fibers, inputs, split=True, follows=follows)

    def lay_on(self) -> Launch:
        """Before the motion: loads of scene and contact together, every fiber at full pace."""
        given = [self.node_hold, self.node_load, self.contact_load]
        inputs = [*given, self.response.fiber_pace, self.step_load]
        return self._launch("lay_on", [self.model.fiber_node_start, *inputs])

    def take_off(self, step_size: Any) -> Launch:
        """After the motion: without what the contact forces did to it."""
        model, state, response = self.model, self.state, self.response
        inputs = [
            response.row_stride,
            step_size,
            response.fiber_pace,
            model.groups,
            model.fiber_node_start,
            model.fiber_group,
            response.rows,
            self.node_hold,
            self.fiber_loaded,
            self.contact_load,
            state.status,
            response.node_reply,
            response.reply_impulse,
            response.segment_impulse,
            self.node_shift,
            state.node_pos,
            state.node_velocity,
            response.tension,
            self.node_foreseen,
        ]
        return self._launch("take_off", inputs)

    def note(self, dual: ContactDual, again: bool) -> Launch:
        """After a solve: its forces on the nodes."""
        rows = dual.rows
        if dual.node_push.shape[0] > 0:
            first = [1 if again else 0, self.model.fiber_node_start]
            pushed = [dual.node_push, self.state.status, self.new_load]
            return self._launch("add_load", [*first, *pushed], follows=True)
        inputs = [
            1 if again else 0,
            self.model.fiber_node_start,
            rows.row_count,
            rows.row_out_start,
            dual.pairs.in_start,
            dual.pairs.in_pair,
            rows.pair_row,
            rows.pair_row_count,
            rows.row_s,
            rows.row_t,
            rows.row_normal,
            rows.row_force,
            self.state.status,
            self.new_load,
        ]
        return self._launch("note_load", inputs, follows=True)

    def keep(self, rejected: Any) -> Launch:
        """After the verdict: the forces of a step that is kept load the next."""
        kept = [self.new_load, self.state.status, self.fiber_loaded, self.contact_load]
        return self._launch("keep_load", [rejected, self.model.fiber_node_start, *kept])

    def restore(self, contact_load: Any) -> None:
        """Take over the loads that were saved."""
        self.contact_load.assign(contact_load)
        self.fiber_loaded.fill_(1)
