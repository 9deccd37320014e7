"""Lengths and layers of a fiber group: their tables and CSV files, completed and checked.

A histogram has the columns lower,upper,count (m, m, number; bins from short to long without gaps),
in a file or as a list of such rows; layers have thickness,volume_fraction,a11,a22,a33,a12,a13,a23
(m; from z = 0 up), or are a list of tables.
Limits: what one table alone shows; whether the fibers can be packed is known after placing them.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path

from warpfiber.scene.draft import Draft
from warpfiber.scene.faults import number_text
from warpfiber.scene.keys import Values, dotted
from warpfiber.scene.kinds import KindError, OrientationTensor
from warpfiber.scene.tables import Layer, LengthDistribution

HISTOGRAM = ("lower", "upper", "count")
LAYERS = ("thickness", "volume_fraction", "a11", "a22", "a33", "a12", "a13", "a23")
SHORTEST = 2.0
"""Default of the shortest fiber in diameters: one segment as long as the diameter."""
ROUNDED = 1e-7
"""What an eigenvalue of zero may become by the rounding of its formula: sqrt of it, of angles."""
FLATTEST = 1e-4
"""Smallest eigenvalue, other than 0, of an orientation tensor of law bingham."""
SUM_ERROR = 1e-6
"""Relative error at which thicknesses still add up to the height, gaps between bins are none."""


def resolve_lengths(draft: Draft, group: Values, path: str) -> None:
    """Replace the table `length_distribution` by a `LengthDistribution`, or add its faults."""
    values, place = group["length_distribution"], dotted(path, "length_distribution")
    if values is None or group["diameter"] is None:
        return
    if draft.raw_value(dotted(path, "position")) not in (None, "random"):
        remedy = "fibers of many lengths have random centers; remove it"
        draft.blame(dotted(path, "position"), remedy)
    group["length_distribution"] = None
    least = SHORTEST * group["diameter"]
    rows = None
    if values["histogram"] is not None:
        rows = values["histogram"]
        if isinstance(rows, str):
            rows = _rows(draft, dotted(place, "histogram"), rows, HISTOGRAM)
        if rows is None or _bad_histogram(draft, dotted(place, "histogram"), rows):
            return
        values["kind"], longest = "histogram", rows[-1][1]
        if longest <= least:
            draft.blame(dotted(place, "histogram"), "its fibers are shorter than 2 diameters")
            return
    elif draft.faulty(place):
        return
    else:
        values["kind"] = values["kind"] or "lognormal"
        if values["maximum"] is None:
            remedy = "missing; give the length of the longest fiber in m"
            draft.faults.add(dotted(place, "maximum"), None, remedy)
            return
        longest = values["maximum"]
        if values["kunc_diameter"] is not None:
            draft.note(f"{place}.kunc_diameter has no effect; it corrects a histogram")
    values["maximum"] = min(values["maximum"] or longest, longest)
    given_least = values["minimum"]
    if given_least is None:
        values["minimum"] = least
    elif given_least < least * (1.0 - SUM_ERROR):
        remedy = f"below 2 diameters; give at least {number_text(least)}"
        draft.blame(dotted(place, "minimum"), remedy)
        return
    if rows is not None and rows[0][0] < values["minimum"]:
        cut = number_text(values["minimum"])
        draft.note(f"{place}.histogram: what is shorter than {cut} m is left out")
    if _bad_order(draft, place, values) or _outside_box(draft, place, values):
        return
    values["histogram"] = rows
    group["length_distribution"] = LengthDistribution(**values)


def _bad_order(draft: Draft, place: str, values: Values) -> bool:
    """Report averages and limits that are not minimum < L_N < L_W < maximum."""
    names = ("minimum", "number_average", "weight_average", "maximum")
    known = [(name, values[name]) for name in names if values[name] is not None]
    for (name, low), (other, high) in zip(known, known[1:], strict=False):
        if low >= high:
            at, word, than = (other, "above", name)
            if other == "maximum" and name == "minimum":
                at = name if draft.is_given(dotted(place, name)) else other
                word, than = ("below", other) if at == name else (word, than)
            bound = number_text(low if at == other else high)
            draft.blame(dotted(place, at), f"must be {word} {than} = {bound}")
            return True
    return False


def _outside_box(draft: Draft, place: str, values: Values) -> bool:
    """Report fibers longer than a periodic edge: they would meet their own images."""
    for axis, edge in draft.axes("periodic"):
        if values["maximum"] > edge:
            key = "histogram" if values["histogram"] is not None else "maximum"
            wide = f"the periodic box is {number_text(edge)} m along {'xyz'[axis]}"
            draft.blame(dotted(place, key), f"longer than {wide}; enlarge box.size, or cut it")
            return True
    return False


def _bad_histogram(draft: Draft, key: str, rows: tuple[tuple[float, ...], ...]) -> bool:
    """Report bins that are negative, empty, backward, or apart from each other."""
    end = rows[0][0]
    for index, (low, high, count) in enumerate(rows):
        name = f"bin {index} ({number_text(low)} to {number_text(high)} m)"
        if low < 0.0 or high <= low:
            draft.blame(key, f"{name} has no width; give 0 <= lower < upper")
            return True
        if count < 0.0:
            draft.blame(key, f"{name} has {number_text(count)} fibers; counts are 0 or more")
            return True
        if abs(low - end) > SUM_ERROR * high:
            gap = "a gap" if low > end else "an overlap"
            draft.blame(key, f"{gap} before {name}; start it at {number_text(end)} m")
            return True
        end = high
    if math.fsum(row[2] for row in rows) <= 0.0:
        draft.blame(key, "all its counts are 0")
        return True
    return False


def resolve_layers(draft: Draft, group: Values, path: str) -> None:
    """Replace `layers` by a tuple of `Layer`; `volume_fraction` becomes their mean."""
    values, place = group["layers"], dotted(path, "layers")
    if not draft.is_given(place):
        if draft.is_given(dotted(path, "wedged")) and group["length_distribution"] is None:
            draft.note(f"{path}.wedged has no effect without layers or a length_distribution")
        if draft.is_given(dotted(path, "layer_mode")):
            draft.note(f"{path}.layer_mode has no effect without layers")
        group["layers"] = group["layer_mode"] = None
        return
    group["layers"] = None
    if isinstance(values, str):
        rows = _rows(draft, place, values, LAYERS)
        layers = _layers_of(draft, place, rows) if rows is not None else None
    elif values is None or draft.faulty(place):
        return
    else:
        layers = tuple(_layer(draft, row, dotted(place, str(k))) for k, row in enumerate(values))
    if not layers:
        if layers is not None:
            draft.blame(place, "no layers; give at least one")
        return
    if draft.box is None or draft.box["size"] is None or draft.box["boundary"] is None:
        if draft.box is None:
            draft.blame(place, "needs a [box]; its height is that of all layers")
        return
    if draft.raw_value(dotted(path, "position")) not in (None, "random"):
        draft.blame(dotted(path, "position"), "layers place the fibers; remove it")
    if draft.is_given(dotted(path, "orientation")):
        draft.note(f"{path}.orientation has no effect; each layer has its own")
    if draft.box["boundary"][2] != "wall":
        draft.blame("box.boundary", "layers lie between walls; make z a wall")
    height, total = draft.box["size"][2], math.fsum(layer.thickness for layer in layers)
    if abs(total - height) > SUM_ERROR * height:
        tall = number_text(float(f"{total:.6g}"))
        draft.blame(place, f"they add up to {tall} m; the box is {number_text(height)} m high")
        return
    group["layers"] = layers
    group["layer_mode"] = group["layer_mode"] or "span"
    group["volume_fraction"] = math.fsum(x.volume_fraction * x.thickness for x in layers) / total


def check_law(draft: Draft, group: Values, path: str) -> None:
    """Report tensors that are too flat for law bingham; call after `resolve_layers`."""
    if group["orientation_law"] != "bingham" or group["node_file"] is not None:
        return
    asked = [(dotted(path, "orientation"), group["orientation"])]
    if group["layers"]:
        asked = [(dotted(path, "layers"), layer.orientation) for layer in group["layers"]]
    for key, tensor in asked:
        if isinstance(tensor, tuple) and ROUNDED < smallest_eigenvalue(tensor) < FLATTEST:
            least = number_text(float(f"{smallest_eigenvalue(tensor):.3g}"))
            remedy = f"smallest eigenvalue {least}; law bingham takes 0, or {FLATTEST:g} and more"
            draft.blame(key, remedy + '; or set orientation_law = "acg"')
            return


def smallest_eigenvalue(tensor: tuple[float, ...]) -> float:
    """Of a symmetric tensor a11, a22, a33, a12, a13, a23, by the trigonometric formula."""
    a11, a22, a33, a12, a13, a23 = tensor
    mean = (a11 + a22 + a33) / 3.0
    x, y, z = a11 - mean, a22 - mean, a33 - mean
    off = a12 * a12 + a13 * a13 + a23 * a23
    size = math.sqrt((x * x + y * y + z * z + 2.0 * off) / 6.0)
    if size == 0.0:
        return mean
    determinant = (
        x * (y * z - a23 * a23) - a12 * (a12 * z - a23 * a13) + a13 * (a12 * a23 - y * a13)
    )
    turn = math.acos(max(-1.0, min(1.0, 0.5 * determinant / size**3))) / 3.0
    return mean + 2.0 * size * math.cos(turn + 2.0 * math.pi / 3.0)


def _layer(draft: Draft, values: Values, path: str) -> Layer:
    if values["orientation"] == "aligned":
        values["direction"] = values["direction"] or (1.0, 0.0, 0.0)
    elif values["direction"] is not None:
        draft.note(f"{path}.direction has no effect; it belongs to orientation = aligned")
        values["direction"] = None
    return Layer(**values)


def _layers_of(
    draft: Draft, key: str, rows: tuple[tuple[float, ...], ...]
) -> tuple[Layer, ...] | None:
    """The layers of a file; None with a fault."""
    layers = []
    for index, (thickness, fraction, *tensor) in enumerate(rows):
        name = f"layer {index}"
        if thickness <= 0.0 or not 0.0 < fraction < 1.0:
            draft.blame(key, f"{name}: give thickness > 0 and 0 < volume_fraction < 1")
            return None
        try:
            orientation = OrientationTensor().read(tensor)
        except KindError as problem:
            draft.blame(key, f"{name}: {problem}")
            return None
        layers.append(Layer(thickness=thickness, volume_fraction=fraction, orientation=orientation))
    return tuple(layers)


def _rows(
    draft: Draft, key: str, name: str, columns: tuple[str, ...]
) -> tuple[tuple[float, ...], ...] | None:
    """Numbers of a CSV file beside the scene; None with a fault."""
    file = Path(draft.folder / name)
    rows: list[tuple[float, ...]] = []
    wanted = ",".join(columns)
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            table = csv.reader(stream)
            header = tuple(word.strip().lower() for word in next(table, []))
            if header != columns:
                draft.blame(key, f"its first line is {','.join(header)!r}; it must be {wanted}")
                return None
            for line in table:
                if not "".join(line).strip():
                    continue
                numbers = tuple(float(word) for word in line)
                if len(numbers) != len(columns) or not all(map(math.isfinite, numbers)):
                    raise ValueError(f"it must hold {len(columns)} numbers")
                rows.append(numbers)
    except FileNotFoundError:
        draft.blame(key, f"no such file: {file}; it is sought beside the scene")
        return None
    except ValueError as error:
        draft.blame(key, f"line {table.line_num}: {error}; the columns are {wanted}")
        return None
    except (OSError, csv.Error) as error:
        draft.blame(key, f"it cannot be read as .csv ({error})")
        return None
    if not rows:
        draft.blame(key, "it holds no rows")
        return None
    return tuple(rows)
