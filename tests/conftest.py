"""Fixtures that several rooms of tests share: simulations that are closed, scenes in files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

# Dense solves of tests are small: threads of the linear algebra wait for each other on a busy
# machine (ten times slower). Read when NumPy is loaded, which is after this.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@pytest.fixture
def write_scene(tmp_path: Path) -> Callable[..., Path]:
    """Function (text, name="scene.toml") -> path of a scene file with that text."""

    def write(text: str, name: str = "scene.toml") -> Path:
        path = tmp_path / name
        path.write_text(text)
        return path

    return write


@pytest.fixture
def start() -> Iterator[Callable[..., Any]]:
    """`tests.cell.start_cell`; worker threads of its simulations end with the test."""
    from tests.cell import start_cell

    running: list[Any] = []

    def begin(*args: Any, **keys: Any) -> Any:
        running.append(start_cell(*args, **keys))
        return running[-1]

    yield begin
    for sim in running:
        sim.close()
