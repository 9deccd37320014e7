"""A sheared cell of ten short fibers that runs in a tenth of a second, and how tests run it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from warpfiber.__main__ import main
from warpfiber.output import read_scalars

CELL = """
[box]
size = [2e-4, 2e-4, 2e-4]
boundary = ["periodic", "periodic", "wall"]
[flow]
kind = "simple_shear"
shear_rate = 100
viscosity = 100
[[fibers]]
aspect_ratio = 10
diameter = 1e-5
count = 10
density = 4e9
youngs_modulus = 2e9
[contact]
[[stage]]
kind = "flow"
end_strain = 0.1
[record]
scalars = 20
frames = 5
figures = false
[numerics]
method = "bead_chain"
segments = 2
device = "cpu"
"""


class Shell:
    """Runs commands of `warpfiber` in this process, inside one folder."""

    def __init__(self, folder: Path, capture: pytest.CaptureFixture[str]) -> None:
        self.folder, self.capture = folder, capture
        self.out = self.err = ""

    def scene(self, text: str = CELL, name: str = "cell.toml") -> Path:
        """Write a scene file."""
        path = self.folder / name
        path.write_text(text, encoding="utf-8")
        return path

    def __call__(self, *words: object) -> int:
        """Exit code of a command; its output is in `out` and `err`."""
        self.capture.readouterr()
        try:
            code = main([str(word) for word in words])
        except SystemExit as usage:  # argparse
            code = int(str(usage.code))
        self.out, self.err = self.capture.readouterr()
        return code

    def run(self, out: str, *settings: str, text: str = CELL, options: Any = ()) -> int:
        """Exit code of `run` into the folder `out` with `--set` of every setting."""
        words = [word for setting in settings for word in ("--set", setting)]
        path = self.scene(text)
        return self("run", path, "--out", self.folder / out, "--quiet", *options, *words)

    def summary(self, out: str) -> dict[str, Any]:
        """`summary.json` of a result folder."""
        content: dict[str, Any] = json.loads((self.folder / out / "summary.json").read_text())
        return content

    def header(self, out: str) -> list[str]:
        """Columns of `scalars.csv`."""
        return (self.folder / out / "scalars.csv").read_text().split("\n")[0].split(",")

    def rows(self, out: str) -> dict[str, np.ndarray]:
        """Columns of `scalars.csv` by name."""
        return read_scalars(self.folder / out / "scalars.csv")

    def listing(self) -> set[str]:
        """Names in the folder."""
        return {path.name for path in self.folder.iterdir()}


@pytest.fixture
def shell(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Shell:
    """A Shell in an empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return Shell(tmp_path, capsys)
