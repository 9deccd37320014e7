"""The command line: run, resume, check, info, plot, export, fit.

Exit codes: 0 finished; 2 a fault found before the first step; 3 diverged or a stage that missed its
condition; 4 a file error later; 130 Ctrl-C and 143 SIGTERM or wall limit, both with a checkpoint.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from warpfiber.output.record_error import RecordError
from warpfiber.scene import Fault, SceneError, load_scene, parse_override


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="warpfiber",
        description="Cells of very many flexible fibers, on CPU and CUDA.",
        epilog="Exit codes: 0 finished, 2 a fault in the input, 3 diverged or a limit reached, 4 a "
        "file error, 130 Ctrl-C, 143 SIGTERM or wall limit.",
    )
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    def add(name: str, text: str) -> argparse.ArgumentParser:
        return commands.add_parser(name, help=text, description=text)

    run = add("run", "Simulate a scene into a result folder.")
    run.add_argument("scene", help="scene file (.toml)")
    run.add_argument("--out", metavar="DIR", help="result folder (default results/<scene name>)")
    run.add_argument("--overwrite", action="store_true", help="replace an existing --out")
    resume = add("resume", "Continue a stopped run from its latest checkpoint.")
    resume.add_argument("folder", help="result folder")
    for command in (run, resume):
        command.add_argument("--device", help="auto, cpu, cuda, cuda:N")
        command.add_argument("--workers", type=_positive, help="CPU threads")
        command.add_argument("--quiet", action="store_true", help="no progress, no closing lines")
        command.add_argument(
            "--max-wall", type=_seconds, metavar="S", help="stop with a checkpoint after S seconds"
        )
    check = add("check", "Print derived numbers of a scene; runs and writes nothing.")
    check.add_argument("scene", help="scene file (.toml)")
    for command in (run, check):
        command.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="TABLE.KEY=VALUE",
            help="override a key of the scene; may be repeated",
        )
    info = add("info", "Tell what a result folder holds.")
    info.add_argument("result", help="result folder or its run.vtkhdf")
    plot = add("plot", "Draw the figures of one run, or of several in the same axes.")
    plot.add_argument("folders", nargs="+", help="result folders")
    plot.add_argument(
        "--out", metavar="DIR", help="folder of the pictures (default figures/ of the first)"
    )
    plot.add_argument("--exact", action="store_true", help="with the orientation without contact")
    export = add("export", "Write a run in another format.")
    export.add_argument("format", choices=["usd"])
    export.add_argument("result", help="result folder or its run.vtkhdf")
    export.add_argument("--out", type=_usd_name, metavar="FILE", help=".usdc, .usda or .usd")
    export.add_argument(
        "--frames", type=_frames, metavar="A:B:S", help="first:last:step, as a slice"
    )
    export.add_argument(
        "--wrap",
        choices=["none", "fiber", "split"],
        default="fiber",
        help="fibers as they moved, each back in the box, or cut at its faces (default fiber)",
    )
    export.add_argument("--smooth", action="store_true", help="cubic curves through the nodes")
    export.add_argument(
        "--color",
        choices=["orientation", "group"],
        default="orientation",
        help="of the fibers: by direction (default) or by group",
    )
    fit = add("fit", "Fit orientation models to a run; write constants and a figure into it.")
    fit.add_argument("result", help="result folder or its run.vtkhdf")
    fit.add_argument(
        "--model",
        action="append",
        metavar="MODEL",
        help="folgar_tucker, rsc, iard (these by default), pard, mrd; may be repeated",
    )
    fit.add_argument(
        "--closure",
        default="IBOF",
        help="as in fiberoripy (default IBOF), or NONE: exact, folgar_tucker alone",
    )
    fit.add_argument("--weighting", default="length", help="length (default) or number")
    fit.add_argument("--from", type=float, dest="low", metavar="S", help="first strain")
    fit.add_argument("--to", type=float, dest="high", metavar="S", help="last strain")
    fit.add_argument(
        "--noise", type=_seconds, default=0.005, help="standard deviation of a component, for chi2"
    )
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return value


def _seconds(text: str) -> float:
    value = float(text)
    if not value > 0.0:
        raise argparse.ArgumentTypeError("must be positive")
    return value


def _frames(text: str) -> slice:
    try:
        return slice(*(int(part) if part else None for part in text.split(":")))
    except (TypeError, ValueError):
        raise argparse.ArgumentTypeError("must be like 0:100:10, -1:") from None


def _usd_name(text: str) -> str:
    if not text.endswith((".usdc", ".usda", ".usd")):
        raise argparse.ArgumentTypeError("the name must end in .usdc, .usda or .usd")
    return text


def _load(args: argparse.Namespace) -> Any:
    return load_scene(args.scene, dict(parse_override(text) for text in args.set))


def _run(args: argparse.Namespace) -> int:
    from warpfiber.job import Job
    from warpfiber.progress import make_progress
    from warpfiber.stopping import Stopper

    options = {
        "device": args.device,
        "workers": args.workers,
        "progress": make_progress(args.quiet),
    }
    with Stopper(args.max_wall) as stopper:  # placing and compiling count, and can be stopped
        if args.command == "run":
            scene = _load(args)
            job = Job.start(scene, out=args.out, overwrite=args.overwrite, **options)
            if not args.quiet:
                for note in scene.notes:
                    print(f"note: {note}")
        else:
            job = Job.resume(args.folder, **options)
        if not args.quiet:
            print(job.describe(), flush=True)
        code = job.run(stopper)
    _finish(job, code, args.quiet)
    return code


def _finish(job: Any, code: int, quiet: bool) -> None:
    """Figures and USD of the run, and the closing lines that name what was written."""
    folder = job.folder.path
    if code == 0 and job.scene.record.figures:
        try:
            from warpfiber.output import plot_run

            plot_run(folder)
        except ImportError:
            job.folder.log("no figures: matplotlib is not installed (extra 'plot')")
    if code == 0 and job.scene.record.usd and job.scene.record.trajectory:
        from warpfiber.output import export_usd

        export_usd(folder)
    if code == 3:
        failure = job.summary.failure
        message = failure["message"] if failure else f"see {folder / 'log.txt'}"
        print(f"warpfiber: {message}", file=sys.stderr)
    if quiet:
        return
    if job.summary.half_turns:
        strains = ", ".join(f"{strain:.4f}" for strain in job.summary.half_turns)
        print(f"half turns at strain {strains}")
    print(f"wrote {folder}/:")
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        print(f"  {path.relative_to(folder)}  ({path.stat().st_size / 1e3:.1f} kB)")
    if code in (130, 143):
        print(f"stopped; go on with: warpfiber resume {folder}")


def _check(args: argparse.Namespace) -> int:
    from warpfiber.build import realized_scene
    from warpfiber.checking import check_lines
    from warpfiber.placement import place_fibers, split_tables
    from warpfiber.simulation import check_step

    scene = split_tables(_load(args))
    if any(group.node_file for group in scene.fibers):
        scene = realized_scene(scene, place_fibers(scene))
    print("\n".join(check_lines(scene)))
    for note in scene.notes:
        print(f"note: {note}")
    check_step(scene)
    return 0


def _info(args: argparse.Namespace) -> int:
    from warpfiber.output import ResultFolder, describe

    print(describe(ResultFolder.open(args.result)))
    return 0


def _plot(args: argparse.Namespace) -> int:
    from warpfiber.output import plot_run

    for path in plot_run(list(args.folders), args.out, args.exact):
        print(path)
    return 0


def _export(args: argparse.Namespace) -> int:
    from warpfiber.output import ResultFolder, export_usd

    folder = ResultFolder.open(args.result)
    path = export_usd(
        folder,
        out=args.out,
        frames=args.frames,
        wrap=args.wrap,
        smooth=args.smooth,
        color=args.color,
    )
    print(path)
    return 0


def _fit(args: argparse.Namespace) -> int:
    from warpfiber.output import fit_run

    options = {"closure": args.closure, "weighting": args.weighting, "noise": args.noise}
    if args.model:
        options["models"] = args.model
    report = fit_run(args.result, low=args.low, high=args.high, **options)
    print("\n".join(report.lines()))
    for path in report.files:
        print(path)
    return 0


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit code."""
    args = _parser().parse_args(argv)
    commands = {
        "run": _run,
        "resume": _run,
        "check": _check,
        "info": _info,
        "plot": _plot,
        "export": _export,
        "fit": _fit,
    }
    try:
        return commands[args.command](args)
    except SceneError as faults:
        print(f"warpfiber: {faults}", file=sys.stderr)
        return 2
    except RecordError as fault:
        print(f"warpfiber: {fault}", file=sys.stderr)
        return 4
    except OSError as fault:  # a full disk, a folder taken away
        print(f"warpfiber: {fault}", file=sys.stderr)
        return 4
    except ImportError as missing:
        extras = {"matplotlib": "plot", "tqdm": "plot", "pxr": "plot"}
        extras |= {"fiberoripy": "fit", "scipy": "fit"}
        if missing.name not in extras:
            raise
        remedy = f"install warpfiber with the extra '{extras[missing.name]}'"
        gap = Fault("command line", args.command, str(missing.name), f"not installed; {remedy}")
        print(f"warpfiber: {gap}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("warpfiber: aborted", file=sys.stderr)
        return 130


def entry() -> None:
    """Entry point of the installed command."""
    sys.exit(main())


if __name__ == "__main__":
    entry()
