"""Stopped runs: by limit, signal or kill, with damage; resumed, they end as if never stopped."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.stress.small_cell import CELL, Shell, shell
from warpfiber import job as job_module
from warpfiber.output import TrajectoryReader, checkpoint_paths, read_checkpoint
from warpfiber.output.scalars import ScalarsWriter
from warpfiber.stopping import Stopper

__all__ = ["shell"]  # a fixture

ROOT = Path(__file__).parents[2]
# Dense enough for contacts, so that pairs, list and overlaps are part of what must be continued.
CROWD = CELL.replace("[2e-4, 2e-4, 2e-4]", "[1.4e-4, 1.4e-4, 1.4e-4]").replace(
    '"periodic", "periodic", "wall"', '"periodic", "periodic", "periodic"'
)
CROWD = CROWD.replace("aspect_ratio = 10", "aspect_ratio = 6").replace("count = 10", "count = 150")
CROWD = CROWD.replace(
    "frames = 5",
    'frames = 5\nquantities = ["orientation", "contacts", "overlap", "energy", "rotation"]',
)


def _stop_after(monkeypatch: pytest.MonkeyPatch, steps: int, reason: str = "SIGTERM") -> None:
    """The next runs of this process are asked to stop once this many steps have been taken."""

    class Counted(Stopper):
        @property
        def reason(self) -> str:
            job = jobs[-1] if jobs else None
            if job is not None and job.simulation.step_count >= steps:
                self._reason = reason
            return self._reason

    jobs: list[job_module.Job] = []
    run = job_module.Job.run

    def watched(job: job_module.Job, stopper: Stopper | None = None) -> int:
        del stopper  # the command line's own
        jobs.append(job)
        return run(job, Counted())

    monkeypatch.setattr(job_module.Job, "run", watched)
    monkeypatch.setattr(job_module, "LOOK_EVERY", 0.0)  # a look after every step


def _same(shell: Shell, one: str, two: str) -> None:
    """Both folders hold the same rows and frames, bit by bit."""
    first, second = shell.folder / one, shell.folder / two
    rows, others = ((f / "scalars.csv").read_text().splitlines() for f in (first, second))
    assert rows[0] == others[0]
    names = rows[0].split(",")
    for row, other in zip(rows[1:], others[1:], strict=True):
        pairs = zip(names, row.split(","), other.split(","), strict=True)
        assert not [pair for pair in pairs if pair[1] != pair[2]]
    if not (first / "run.vtkhdf").exists():
        return
    with TrajectoryReader(first / "run.vtkhdf") as a, TrajectoryReader(second / "run.vtkhdf") as b:
        assert np.array_equal(a.step, b.step)
        for frame in range(a.frame_count):
            assert np.array_equal(a.node_pos(frame), b.node_pos(frame)), frame
    last = [read_checkpoint(checkpoint_paths(f)[0])[0] for f in (first, second)]
    for name in last[0]:
        assert np.array_equal(last[0][name], last[1][name]), name


# 0: before the first step; 37: between rows; 50: anywhere; the last: where a row is due
@pytest.mark.parametrize("steps", [0, 37, 50, 62])
def test_a_stopped_run_goes_on_bit_by_bit(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, steps: int
) -> None:
    assert shell.run("whole", text=CROWD) == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, steps)
        assert shell.run("parts", text=CROWD) == 143
    assert shell.summary("parts")["outcome"] == "stopped"
    # steps whose passes are timed are taken together
    assert 0 <= shell.summary("parts")["steps"] - steps <= job_module.PROFILE_STEPS
    assert shell("resume", shell.folder / "parts", "--quiet") == 0
    _same(shell, "whole", "parts")
    assert shell.summary("parts")["outcome"] == "finished"
    assert shell.summary("parts")["final"] == shell.summary("whole")["final"]


@pytest.mark.parametrize(
    "settings",
    [
        ("fibers.0.youngs_modulus=1e4",),  # stretches: the neighbor list has to allow for it
        ("numerics.precision=float32",),
        ('contact.lubrication="paper"',),
        ("numerics.workers=2",),
        ("flow.schedule=[[0.0, 1.0], [0.05, 0.3]]",),
        ("record.trajectory=false", "record.quantities=[]"),
    ],
    ids=lambda settings: settings[0].split("=")[0],
)
def test_every_kind_of_run_goes_on_bit_by_bit(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, settings: tuple[str, ...]
) -> None:
    assert shell.run("whole", *settings, text=CROWD) == 0, shell.err
    with monkeypatch.context() as patch:
        _stop_after(patch, 70)
        assert shell.run("parts", *settings, text=CROWD) == 143
    assert shell("resume", shell.folder / "parts", "--quiet") == 0
    _same(shell, "whole", "parts")


def test_max_wall_stops_with_a_checkpoint(shell: Shell) -> None:
    assert shell.run("whole") == 0
    assert shell.run("parts", options=("--max-wall", "1e-9")) == 143
    assert len(checkpoint_paths(shell.folder / "parts")) == 1
    assert shell("info", shell.folder / "parts") == 0
    assert "outcome stopped" in shell.out
    assert shell("resume", shell.folder / "parts") == 0
    _same(shell, "whole", "parts")


def test_resuming_a_finished_run_changes_nothing(shell: Shell) -> None:
    assert shell.run("out") == 0
    before = {path: path.read_bytes() for path in (shell.folder / "out").glob("*.[jc]s*")}
    assert len(before) == 4  # scalars.csv, columns.csv, scene.json, summary.json
    assert shell("resume", shell.folder / "out", "--quiet") == 0
    assert all(path.read_bytes() == data for path, data in before.items())


def test_stages_are_resumed_where_they_were(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    text = CELL.replace("end_strain = 0.1", 'name = "one"\nend_strain = 0.04')
    text += '[[stage]]\nkind = "flow"\nname = "two"\nend_time = 4e-4\n'
    assert shell.run("whole", text=text) == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, 60)
        assert shell.run("parts", text=text) == 143
    assert shell("resume", shell.folder / "parts") == 0
    _same(shell, "whole", "parts")


def test_a_kill_between_checkpoint_and_row_writes_no_row_twice(
    shell: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert shell.run("whole", text=CROWD) == 0

    class Killed(BaseException):
        pass

    written: list[int] = []
    append = ScalarsWriter.append

    def counted(writer: object, row: dict[str, float]) -> None:
        append(writer, row)  # type: ignore[arg-type]
        written.append(1)
        if len(written) == 9:
            raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(ScalarsWriter, "append", counted)
        # nothing that an orderly stop writes
        patch.setattr(job_module, "LOOK_EVERY", 0.0)
        with pytest.raises(Killed):
            shell.run("parts", "record.checkpoint_every=1e-9", text=CROWD)
    assert shell("resume", shell.folder / "parts") == 0
    _same(shell, "whole", "parts")


def test_a_damaged_checkpoint_is_passed_over(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    assert shell.run("whole") == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, 70)
        assert shell.run("parts", "record.checkpoint_every=1e-9") == 143
    folder = shell.folder / "parts"
    newest, older = checkpoint_paths(folder)
    newest.write_bytes(newest.read_bytes()[:-500])
    assert shell("resume", folder) == 0
    log = (folder / "log.txt").read_text()
    assert f"passed over: {folder.name}/{newest.name}" in log.replace(f"{shell.folder}/", "")
    assert f"from {older.name}" in log
    _same(shell, "whole", "parts")


def test_only_damaged_checkpoints_are_named(shell: Shell) -> None:
    assert shell.run("out", options=("--max-wall", "1e-9")) == 143
    (path,) = checkpoint_paths(shell.folder / "out")
    nodes = read_checkpoint(path)[0]["node_pos"].tobytes()
    data = path.read_bytes()
    assert data.count(nodes[:64]) >= 1
    path.write_bytes(data.replace(nodes[:64], bytes(64)))
    assert shell("resume", shell.folder / "out") == 4
    assert path.name in shell.err
    path.unlink()
    assert shell("resume", shell.folder / "out") == 4
    assert "no checkpoint" in shell.err


def test_resuming_needs_no_node_file(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    nodes = np.zeros((2, 3, 3))
    nodes[..., 0] = np.linspace(0.0, 9e-5, 3)
    nodes[:, :, 2] = np.array([[0.0, 1e-5, 2e-5], [4e-5, 5e-5, 5.9e-5]])
    nodes += 5e-5
    nodes[0, 1] *= 1.001  # unequal segments: the rest length is a mean
    np.savez(shell.folder / "fibers.npz", node_pos=nodes)
    text = CELL.replace("aspect_ratio = 10", 'node_file = "fibers.npz"').replace("count = 10", "")
    text = text.replace("segments = 2", "")
    assert shell.run("whole", text=text) == 0
    with monkeypatch.context() as patch:
        _stop_after(patch, 40)
        assert shell.run("parts", text=text) == 143
    (shell.folder / "fibers.npz").unlink()
    assert shell("resume", shell.folder / "parts") == 0
    _same(shell, "whole", "parts")


def test_the_first_request_waits_and_the_second_aborts() -> None:
    with Stopper() as stopper:
        assert stopper.reason == ""
        os.kill(os.getpid(), signal.SIGINT)
        assert stopper.reason == "SIGINT" and stopper.exit_code == 130
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.1)
    for name in ("SIGTERM", "SIGUSR1"):
        with Stopper() as stopper:
            os.kill(os.getpid(), getattr(signal, name))
            assert stopper.reason == name and stopper.exit_code == 143


# -- signals, which need processes of their own ---------------------------------------------------


def _start(shell: Shell, out: str, text: str) -> subprocess.Popen[str]:
    path = shell.scene(text)
    command = [sys.executable, "-m", "warpfiber", "run", str(path), "--out", out, "--quiet"]
    return subprocess.Popen(
        command,
        cwd=shell.folder,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def _wait(process: subprocess.Popen[str], seen: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not seen():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "the run did not get there"
        time.sleep(0.005)


LONG = CELL.replace("end_strain = 0.1", "end_strain = 30").replace("scalars = 20", "scalars = 60")


@pytest.fixture(scope="module")
def whole_rows() -> dict[str, str]:
    """Rows of the uninterrupted run, once it has been made."""
    return {}


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGKILL"])
def test_signals(shell: Shell, whole_rows: dict[str, str], name: str) -> None:
    text = LONG.replace("[record]", "[record]\ncheckpoint_every = 0.1")
    folder = shell.folder / "parts"
    process = _start(shell, "parts", text)

    def under_way() -> bool:
        table = folder / "scalars.csv"
        rows = table.read_text().count("\n") if table.exists() else 0
        return rows > 4 and (name != "SIGKILL" or bool(checkpoint_paths(folder)))

    _wait(process, under_way)
    process.send_signal(getattr(signal, name))
    out, err = process.communicate(timeout=30)
    assert process.returncode == {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9}[name], err
    arrays, _ = read_checkpoint(checkpoint_paths(folder)[0])
    assert all(np.isfinite(values).all() for values in arrays.values())
    assert shell("info", folder) == 0
    if name != "SIGKILL":
        assert "whole       yes" in shell.out
        assert "Traceback" not in err
    assert shell("resume", folder, "--quiet") == 0
    if "rows" not in whole_rows:
        assert shell.run("whole", text=text) == 0
        whole_rows["rows"] = (shell.folder / "whole" / "scalars.csv").read_text()
    assert (folder / "scalars.csv").read_text() == whole_rows["rows"]


def test_a_second_start_is_quick(
    shell: Shell, record_property: Callable[[str, object], None]
) -> None:
    """Kernels come from the cache; the time to the first row is reported, not judged."""
    assert shell.run("warm") == 0
    began = time.perf_counter()
    process = _start(shell, "out", CELL)
    table = shell.folder / "out" / "scalars.csv"
    _wait(process, lambda: table.exists() and table.read_text().count("\n") > 1)
    seconds = time.perf_counter() - began
    assert process.communicate(timeout=30) and process.returncode == 0
    record_property("seconds_to_first_row", seconds)
    print(f"second start: first row after {seconds:.2f} s")
