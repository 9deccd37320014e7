"""The two plane walls of one axis of the box: stages move one of them, both are metered.

A stage begins with a jump of its wall to the outermost fiber, if that lies further in; it then
moves at the stage's speed, inwards to compress and outwards to unload. The pressure that ends a
stage is the mean of the last steps; of `unload` also no touch at all. With control = "load" the
wall is a plate as heavy as the fibers, and its load changes at `pressure_rate` from what it bears
when the stage begins; `speed` only bounds its motion. A stage that grips the bed
begins with the upper wall back at the top of the box, where it leaves the bed free.
Symbols: place of a wall, push = the normal force of all fibers on it, gap = distance of the two.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import warp as wp

from warpfiber.methods.bond_constants import fiber_mass
from warpfiber.model import Model, State
from warpfiber.passes.executor import Launch
from warpfiber.passes.wall_press import CHUNK, make_push_sum, make_wall_meter, make_wall_motion
from warpfiber.passes.wall_servo import (
    BEGIN,
    BOUND,
    FIRST,
    INWARD,
    MASS,
    RATE,
    SERVO_SIZE,
    SIDE,
    make_wall_servo,
)
from warpfiber.scene import Fault, Scene, SceneError, Stage
from warpfiber.scene.containers import container
from warpfiber.scene.derived import fiber_volume
from warpfiber.scene.gripping import GRIPPING, HEIGHT
from warpfiber.scene.planes import free_planes
from warpfiber.scene.pouring import UP
from warpfiber.scene.pressing import PRESSING, pressed_axis, wall_side

LOOK = 16  # steps from one look at the pressure to the next
AWAY = 2.0  # heights of the box that the top is out of the way of fibers that are poured
LEAST_GAP = 0.5  # diameters of the thickest fiber

_CARRIED = "place velocity push mean work servo".split()


class Press:
    """Walls of `axis` (-1: none is moved or metered; the walls of all axes still have a place)."""

    def __init__(self, scene: Scene, model: Model, state: State, dt: float) -> None:
        self.scene, self.model, self.state, self.dt = scene, model, state, dt
        self.axis = pressed_axis(scene)
        self.fibers = model.fiber_count  # of them, the first ones are in the box
        device = model.device
        low = np.asarray(model.domain.low)
        self.corners = np.array([low, low + np.asarray(model.domain.size)])
        places, round_wall = self.corners, container(scene)
        if round_wall is not None:  # its axis and radius
            assert round_wall.center is not None and round_wall.radius is not None
            side = np.array([*round_wall.center[:2], round_wall.radius]) / model.units.length
            places = np.concatenate([places, side[None]])
        for plane in free_planes(scene):  # inwards, and a point
            point = np.asarray(plane.position) / model.units.length
            places = np.concatenate([places, [plane.normal, point]])
        self.place = wp.array(places, dtype=wp.vec3d, device=device)
        metered = int(self.axis >= 0)
        fibers = metered * model.fiber_count
        self.velocity = wp.zeros(metered, dtype=wp.vec2d, device=device)
        self.push = wp.zeros(metered, dtype=wp.vec2d, device=device)
        self.mean = wp.zeros(metered, dtype=wp.vec3d, device=device)
        self.work = wp.zeros(metered, dtype=wp.float64, device=device)
        self.loaded = any(stage.control == "load" for stage in scene.stages)
        self.servo = wp.array(_led() * self.loaded, dtype=wp.float64, device=device)
        self.fiber_push = wp.zeros(fibers, dtype=wp.vec2d, device=device)
        self.chunk_push = wp.zeros(-(-fibers // CHUNK), dtype=wp.vec2d, device=device)
        if metered:
            self.mean.assign(np.array([[0.0, 0.0, self._gap()]]))
            assert scene.box is not None
            rule = scene.box.volume_rule
            self.area = scene.box.volume / scene.box.size[self.axis]
            if round_wall is not None and round_wall.radius is not None and self.axis == 2:
                self.area = math.pi * round_wall.radius**2
            self.fiber_volumes = [
                fiber_volume(rule, group.diameter, group.length) for group in scene.fibers
            ]

    # -- the step ---------------------------------------------------------------------------------

    def motion(self) -> list[Launch]:
        """Before the loads of a step."""
        if self.axis < 0:
            return []
        inputs = [wp.float64(self.dt), self.state.status, self.velocity, self.place]
        motion = Launch("walls", make_wall_motion(self.axis), 1, inputs, follows=True)
        if not self.loaded:
            return [motion]
        inputs = [wp.float64(self.dt), self.state.status, self.state.time]
        inputs += [self.servo, self.push, self.velocity]
        return [Launch("wall servo", make_wall_servo(), 1, inputs, follows=True), motion]

    def meter(self) -> list[Launch]:
        """After them."""
        if self.axis < 0:
            return []
        inputs = [wp.float64(self.dt), self.state.status, self.chunk_push, self.place]
        inputs += [self.velocity, self.push, self.mean, self.work]
        sums = [self.fiber_push, self.chunk_push]
        return [
            Launch("push sums", make_push_sum(), self.chunk_push.shape[0], sums),
            Launch("wall meter", make_wall_meter(self.axis), 1, inputs, follows=True),
        ]

    # -- stages -----------------------------------------------------------------------------------

    def begin(self, stage: Stage, nodes: np.ndarray) -> None:
        """Let the stage's wall jump to the nodes (N, 3; run units) and give it its speed."""
        if stage.kind == "pour" or self.place.numpy()[1, UP] > self.corners[1, UP]:
            place = self.place.numpy()
            away = AWAY * (self.corners[1, UP] - self.corners[0, UP])
            place[1, UP] = self.corners[1, UP] + (away if stage.kind == "pour" else 0.0)
            self._set_places(place)
        if self.axis < 0:
            return
        velocity, servo = np.zeros((1, 2)), _led()
        if stage.kind in GRIPPING and self.axis == HEIGHT:
            place = self.place.numpy()
            place[1] = self.corners[1]
            self._set_places(place)
        if stage.kind in PRESSING:
            side = wall_side(stage)
            inward = 1.0 - 2.0 * side
            self._jump(side, nodes)
            way = inward if stage.kind == "compress" else -inward
            if stage.control == "load":
                servo = self._servo(stage, side, inward)
            else:
                velocity[0, side] = way * (stage.speed or 0.0) / self.model.units.velocity
        self.velocity.assign(velocity)
        if self.loaded:
            self.servo.assign(servo)

    def _servo(self, stage: Stage, side: int, inward: float) -> np.ndarray:
        """The load of a stage, from the mean push now on."""
        units, servo = self.model.units, np.zeros(SERVO_SIZE)
        rate = (stage.pressure_rate or 0.0) * self.area / units.force * units.time
        counts = np.bincount(self.model.host["fiber_group"], minlength=len(self.scene.fibers))
        masses = [fiber_mass(self.scene, group) for group in self.scene.fibers]
        servo[SIDE], servo[INWARD] = side, inward
        servo[MASS] = math.fsum(counts * masses) / units.mass
        servo[BOUND] = (stage.speed or 0.0) / units.velocity
        servo[FIRST] = self.mean.numpy()[0][side]
        servo[RATE] = rate if stage.kind == "compress" else -rate
        servo[BEGIN] = float(self.state.time.numpy()[0])
        return servo

    def _load(self) -> float:
        """Pressure (Pa) that the plate is loaded with now; NaN while the wall is led."""
        servo = self.servo.numpy()
        if servo[SIDE] < 0.0:
            return math.nan
        past = float(self.state.time.numpy()[0]) - servo[BEGIN]
        load: float = max(0.0, servo[FIRST] + servo[RATE] * past)
        return load * self.model.units.force / self.area

    def _jump(self, side: int, nodes: np.ndarray) -> None:
        """Never outwards: a wall that presses already would lose its contact."""
        host = self.model.host
        radius = np.asarray([row["radius"] for row in self.model.group_rows])
        mine = np.repeat(radius[host["fiber_group"]], np.diff(host["fiber_node_start"]))
        along = nodes[:, self.axis]
        place = self.place.numpy()
        if side == 1:
            place[1, self.axis] = min(place[1, self.axis], (along + mine).max())
        else:
            place[0, self.axis] = max(place[0, self.axis], (along - mine).min())
        self._set_places(place)

    def _set_places(self, place: np.ndarray) -> None:
        """Put the walls elsewhere; the mean distance starts anew."""
        self.place.assign(place)
        if self.axis >= 0:
            mean = self.mean.numpy()
            mean[0, 2] = self._gap()
            self.mean.assign(mean)

    @property
    def solid(self) -> float:
        """Volume of the fibers, m^3."""
        present = self.model.host["fiber_group"][: self.fibers]
        counts = np.bincount(present, minlength=len(self.fiber_volumes)).tolist()
        return math.fsum(n * volume for n, volume in zip(counts, self.fiber_volumes, strict=True))

    def steps_left(self, stage: Stage, step: int) -> int:
        """Steps before which no condition of a pressing stage surely ends it.

        Raises SceneError where the wall has no way left.
        """
        travel = self.dt * (stage.speed or 0.0) / self.model.units.velocity
        counts = []
        if stage.end_volume_fraction is not None:
            end = self.solid / (self.area * stage.end_volume_fraction * self.model.units.length)
            way = self._gap() - end
            way = way if stage.kind == "compress" else -way
            counts.append(max(0, math.ceil(way / travel - 1e-6)))
        if stage.end_pressure is not None:
            waits = LOOK - step % LOOK
            counts.append(0 if waits == LOOK and self._pressure_met(stage) else waits)
        if 0 in counts:
            return 0
        room = self._room(stage)
        if room < travel:
            unmet = self.unmet(stage) or "end_time"
            remedy = f"has come as far as it can; not met: {unmet}; end it earlier"
            where = f"stage '{stage.name}': wall"
            raise SceneError([Fault(self.scene.path, where, stage.wall, remedy)])
        return min([*counts, math.floor(room / travel)])

    def _pressure_met(self, stage: Stage) -> bool:
        end, side = stage.end_pressure or 0.0, wall_side(stage)
        if stage.kind == "compress":
            return bool(self.pressures()[side] >= end)
        return bool(self.pressures()[side] <= end or self.push.numpy()[0][side] == 0.0)

    def _gap(self) -> float:
        place = self.place.numpy()
        return float(place[1, self.axis] - place[0, self.axis])

    def _room(self, stage: Stage) -> float:
        """Way (run units) to the opposite wall, or back to the box."""
        if stage.kind == "compress":
            thickest = 2.0 * max(row["radius"] for row in self.model.group_rows)
            return self._gap() - LEAST_GAP * float(thickest)
        side = wall_side(stage)
        place = float(self.place.numpy()[side, self.axis])
        return abs(float(self.corners[side, self.axis]) - place)

    def unmet(self, stage: Stage) -> str:
        """What a pressing stage still waits for."""
        waits = []
        if stage.end_volume_fraction is not None:
            waits.append(
                f"end_volume_fraction = {stage.end_volume_fraction:g}; it is {self._fraction():.4g}"
            )
        if stage.end_pressure is not None:
            pressure = self.pressures()[wall_side(stage)]
            waits.append(f"end_pressure = {stage.end_pressure:g} Pa; it is {pressure:.4g} Pa")
        return "; ".join(waits)

    # -- what is saved and told -------------------------------------------------------------------

    def pressures(self) -> np.ndarray:
        """Mean pressures on the lower and the upper wall, Pa."""
        pushes: np.ndarray = self.mean.numpy()[0, :2] * self.model.units.force / self.area
        return pushes

    def _fraction(self) -> float:
        """Volume fraction between the walls, of the mean distance, in the box at most."""
        edge = self.corners[1, self.axis] - self.corners[0, self.axis]
        height = min(float(self.mean.numpy()[0, 2]), float(edge)) * self.model.units.length
        return self.solid / (self.area * height)

    def measure(self) -> dict[str, float]:
        """Pressures, volume fraction and work, where `record.quantities` asks for them."""
        row: dict[str, float] = {}
        if self.axis < 0:
            return row
        if "stress" in self.scene.record.quantities:
            low, high = self.pressures().tolist()
            row |= {"pressure_low": low, "pressure_high": high}
            row |= {"volume_fraction": self._fraction()}
            if self.loaded:
                row["pressure_load"] = self._load()
        if "energy" in self.scene.record.quantities:
            row["wall_work"] = float(self.work.numpy()[0]) * self.model.units.energy
        return row

    def saved(self) -> dict[str, np.ndarray]:
        """Places, velocities, forces, means and work; without meters the places alone."""
        names = _CARRIED if self.axis >= 0 else _CARRIED[:1]
        return {f"press_{name}": getattr(self, name).numpy().copy() for name in names}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `saved` returned."""
        for name in _CARRIED if self.axis >= 0 else _CARRIED[:1]:
            getattr(self, name).assign(arrays[f"press_{name}"])


def _led() -> np.ndarray:
    """The servo of a wall that moves as told."""
    servo = np.zeros(SERVO_SIZE)
    servo[SIDE] = -1.0
    return servo
