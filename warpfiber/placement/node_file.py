"""Reads fibers that are given node by node.

`.npz` holds `node_pos` (fibers, nodes, 3) in m; `.csv` has the columns fiber,x,y,z (m), one row per
node, the rows of a fiber together and in order along it.
Limits: fibers of one group are alike: the same number of nodes, all segments equally long (1 %) and
    not shorter than the diameter.
"""

from __future__ import annotations

import csv
import zipfile
from pathlib import Path

import numpy as np

from warpfiber.placement.capsules import Floats

LENGTH_SPREAD = 0.01
"""Largest relative difference of segments: a group has one rest length."""


def read_node_file(path: str, diameter: float) -> list[Floats]:
    """Node positions (n_f, 3) m of every fiber; ValueError says what is wrong with the file."""
    fibers = _read_csv(path) if Path(path).suffix.lower() == ".csv" else _read_npz(path)
    if not fibers:
        raise ValueError("the file holds no fibers")
    shortest, longest = np.inf, 0.0
    for f, node_pos in enumerate(fibers):
        if len(node_pos) < 2:
            raise ValueError(f"fiber {f} has {len(node_pos)} node(s); at least 2 are needed")
        bad = np.flatnonzero(~np.all(np.isfinite(node_pos), axis=1))
        if len(bad):
            raise ValueError(f"node {bad[0]} of fiber {f} is {node_pos[bad[0]]}, not a position")
        length = np.linalg.norm(np.diff(node_pos, axis=0), axis=1)
        if length.min() < diameter * (1.0 - 1e-6):
            raise ValueError(
                f"segment {int(np.argmin(length))} of fiber {f} is {length.min():.4g} m long, "
                f"shorter than the diameter {diameter:.4g} m; use fewer nodes (positions are in m)"
            )
        if len(node_pos) != len(fibers[0]):
            raise ValueError(
                f"fiber {f} has {len(node_pos)} nodes, fiber 0 has {len(fibers[0])}; "
                "use one [[fibers]] and one file per kind of fiber"
            )
        shortest, longest = min(shortest, length.min()), max(longest, length.max())
        if longest > (1.0 + LENGTH_SPREAD) * shortest:
            raise ValueError(
                f"its segments are {shortest:.4g} to {longest:.4g} m long (fiber {f}); "
                "space nodes equally, with one file per length"
            )
    return fibers


def _read_npz(path: str) -> list[Floats]:
    try:
        archive = np.load(path, allow_pickle=False)
        node_pos = archive["node_pos"] if "node_pos" in getattr(archive, "files", ()) else None
    except (OSError, ValueError, zipfile.BadZipFile, EOFError) as error:
        raise ValueError(f"it cannot be read as .npz ({error})") from error
    if node_pos is None:
        raise ValueError("it holds no array named node_pos")
    if node_pos.ndim != 3 or node_pos.shape[2] != 3:
        raise ValueError(f"node_pos has shape {node_pos.shape}; it must be (fibers, nodes, 3)")
    if node_pos.dtype.kind not in "fiu":
        raise ValueError(f"node_pos holds {node_pos.dtype}; it must hold numbers")
    return [np.array(row, dtype=np.float64) for row in node_pos]


def _read_csv(path: str) -> list[Floats]:
    names: list[str] = []
    rows: list[list[list[float]]] = []
    try:
        with open(path, newline="", encoding="utf-8-sig") as stream:
            table = csv.reader(stream)
            header = [word.strip().lower() for word in next(table, [])]
            if header != ["fiber", "x", "y", "z"]:
                raise ValueError(f"its first line is {','.join(header)!r}; it must be fiber,x,y,z")
            known: set[str] = set()
            for line in table:
                if not line or not "".join(line).strip():
                    continue
                where = f"line {table.line_num}"
                if len(line) != 4:
                    raise ValueError(f"{where} has {len(line)} columns; it must have 4")
                name = line[0].strip()
                if not names or names[-1] != name:
                    if name in known:
                        raise ValueError(f"{where}: the rows of fiber {name} are not together")
                    names.append(name)
                    known.add(name)
                    rows.append([])
                try:
                    rows[-1].append([float(word) for word in line[1:]])
                except ValueError as error:
                    raise ValueError(f"{where}: {error}") from error
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"it cannot be read as .csv ({error})") from error
    return [np.array(row, dtype=np.float64) for row in rows]
