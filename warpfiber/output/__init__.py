"""Output: from arrays to files. The only room that knows h5py, pxr and matplotlib.

It takes plain NumPy arrays and dicts; the heavy packages are imported inside functions, so
importing this room costs nothing.
"""

from warpfiber.output.checkpoint import (
    checkpoint_paths,
    latest_checkpoint,
    read_checkpoint,
    write_checkpoint,
)
from warpfiber.output.description import describe
from warpfiber.output.fit_report import FitReport, fit_run
from warpfiber.output.folder import ResultFolder
from warpfiber.output.orientation_curve import exact_orientation
from warpfiber.output.plots import plot_run
from warpfiber.output.record_error import RecordError
from warpfiber.output.scalars import ScalarsWriter, read_scalars
from warpfiber.output.trajectory import TrajectoryReader, TrajectoryWriter
from warpfiber.output.usd import export_usd

__all__ = [
    "FitReport",
    "RecordError",
    "ResultFolder",
    "ScalarsWriter",
    "TrajectoryReader",
    "TrajectoryWriter",
    "checkpoint_paths",
    "describe",
    "exact_orientation",
    "export_usd",
    "fit_run",
    "latest_checkpoint",
    "plot_run",
    "read_checkpoint",
    "read_scalars",
    "write_checkpoint",
]
