"""The command line: `capsule-vio demo | doctor | simulate | convert | inspect | train | evaluate | predict | refine |
compare | locate | report | view | benchmark`.

Exit codes: 0 done; 2 wrong usage; 3 the input cannot be used; 4 no estimator produced a trajectory;
1 a bug (traceback). Heavy libraries load only in the command that needs them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from fusion import cli_learned
from fusion.cli_output import print_json
from fusion.cli_parser import build_parser
from fusion.cli_progress import Progress
from vio.errors import UsageError, VioError

if TYPE_CHECKING:
    from vio.loops import Loops
    from vio.motions import RelativeMotions
    from vio.recording import Recording


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = build_parser().parse_args(argv)
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "demo": _demo, "doctor": _doctor, "simulate": _simulate, "convert": _convert, "inspect": _inspect,
        "train": cli_learned.train, "evaluate": cli_learned.evaluate, "predict": cli_learned.predict,
        "refine": _refine, "compare": _compare, "locate": _locate, "report": _report, "view": _view,
        "benchmark": cli_learned.benchmark,
    }
    try:
        return commands[arguments.command](arguments)
    except VioError as error:
        print(f"capsule-vio {arguments.command}: {_one_line(error)}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted; nothing half-written was kept; refine goes on where it stopped", file=sys.stderr)
        return 130


def _one_line(error: VioError) -> str:
    """The message on one line, without what a terminal would take for a command (file names can hold anything)."""
    return "".join(c if c.isprintable() or c == "\u00a0" else " " for c in str(error))


def _demo(arguments: argparse.Namespace) -> int:
    import learned
    from fusion.compare_text import format_table
    from fusion.demo import run_demo

    with Progress() as progress:
        demo = run_demo(arguments.out, arguments.seed, learned.predict, progress)
    if arguments.json:
        print_json(demo.comparison.to_dict() | {"rendered": demo.rendered.to_dict()})
        return 0
    print(f"{demo.about}\n\n{format_table(demo.comparison)}\n\n{demo.about_rendered}\n\n{format_table(demo.rendered)}\n")
    print(f"reports: {demo.report} and {demo.rendered_report}\nplot:    {demo.plot}")
    return 0


def _doctor(arguments: argparse.Namespace) -> int:
    from fusion.doctor import diagnose, format_findings

    findings = diagnose()
    if arguments.json:
        print_json([finding.__dict__ for finding in findings])
    else:
        print(format_findings(findings))
    return 0 if all(finding.ok or not finding.required for finding in findings) else 3


def _simulate(arguments: argparse.Namespace) -> int:
    from vio.formats.asl import write_asl
    from vio.simulation import network_like_motions, preset_camera, simulate
    from vio.simulation.images import write_rendered

    if arguments.dataset is not None:
        return _simulate_dataset(arguments)
    simulation = simulate(arguments.organ, arguments.vibration, arguments.level, arguments.duration, arguments.seed,
                          driving=arguments.driving, start=arguments.start,
                          camera=preset_camera(arguments.camera, arguments.size))
    recording = simulation.recording
    if arguments.no_images:
        write_asl(recording, arguments.out)
    else:
        with Progress() as progress:
            write_rendered(simulation, arguments.out, products=arguments.products, progress=progress.count)
    if arguments.motions is not None:
        truth, T_body_camera = recording.truth_at_frames(), recording.calibration.T_body_camera
        network_like_motions(truth, T_body_camera, arguments.seed).motions.save(arguments.motions)
    print(f"{arguments.out}: {len(recording)} frames, {len(recording.imu)} inertial samples, "
          f"path {recording.truth_at_frames().path_length_m:.3f} m")
    return 0


def _simulate_dataset(arguments: argparse.Namespace) -> int:
    from vio.simulation.dataset import plan, write_dataset

    if arguments.no_images or arguments.motions is not None or arguments.products:
        raise UsageError("--dataset writes images; it goes without --no-images, --motions and --products")
    sequences = plan(arguments.dataset, arguments.seed, arguments.duration, arguments.camera, arguments.size)
    with Progress() as progress:
        manifest = write_dataset(sequences, arguments.out, arguments.workers, progress.count)
    print(f"{manifest}: {len(sequences)} sequences")
    return 0


def _convert(arguments: argparse.Namespace) -> int:
    from vio.conversion import convert_to_asl
    from vio.formats import open_recording
    from vio.formats.declared import Declared
    from vio.formats.kalibr import read_calibration, write_kalibr
    from vio.inspection import describe

    if arguments.imu_calibration is not None and arguments.calibration is None:
        raise UsageError("--imu-calibration needs --calibration, which says where the camera sits on that IMU")
    calibration = None
    if arguments.calibration is not None:
        calibration = read_calibration(arguments.calibration, arguments.imu_calibration)
    planes = None if arguments.depth_planes is None else tuple(arguments.depth_planes)
    declared = Declared(calibration, arguments.rate_hz, arguments.unit_m, planes, arguments.presentation_times)
    if arguments.to == "kalibr":
        recording = open_recording(arguments.source, arguments.format, declared)
        write_kalibr(recording.calibration, arguments.out)
    else:
        with Progress() as progress:
            recording = convert_to_asl(arguments.source, arguments.out, arguments.format, declared, progress.count)
    found = describe(recording)
    if arguments.json:
        print_json(found)
    else:
        print(f"{arguments.out}: written as {arguments.to}")
        print("\n".join(f"{name.ljust(8)} {text}" for name, text in found.items()))
    return 0


def _inspect(arguments: argparse.Namespace) -> int:
    from vio.formats import open_recording
    from vio.inspection import format_inspection, inspect_recording

    recording = open_recording(arguments.recording)
    inspection = inspect_recording(recording, pixels=arguments.html is not None)
    if arguments.html is not None:
        from fusion.report.inspection_page import write_inspection

        write_inspection(replace(recording, name=arguments.html.stem), inspection, arguments.html)
    if arguments.json:
        print_json(inspection.to_dict())
    else:
        print(format_inspection(inspection))
    if inspection.usable:
        return 0
    first = next(check for check in inspection.checks if check.level == "error")
    print(f"capsule-vio inspect: {first.text}", file=sys.stderr)
    return 3


def _refine(arguments: argparse.Namespace) -> int:
    from fusion.checkpoint import unfinished
    from fusion.config import RefineConfig, load_config
    from fusion.online_run import online_refine
    from fusion.refine import refine
    from fusion.run_folder import Provenance, write_run
    from fusion.stages import remaining_s
    from fusion.summary import sentences
    from vio.formats import open_recording

    config = RefineConfig() if arguments.config is None else load_config(arguments.config)
    if arguments.estimator is not None:
        config = replace(config, estimator=arguments.estimator)
    recording = open_recording(arguments.recording)
    inputs = {"imu": arguments.recording / "mav0" / "imu0" / "data.csv",
              "frames": arguments.recording / "mav0" / "cam0" / "data.csv"}
    inputs |= {"motions" if k == 0 else f"motions_{k + 1}": path for k, path in enumerate(arguments.motions or ())}
    inputs = {name: path for name, path in inputs.items() if path.is_file()}
    if arguments.loops_from is not None:
        inputs["loops"] = arguments.loops_from
    if arguments.online and (arguments.loops or arguments.loops_from):
        raise UsageError("loops are closed when a recording is whole; leave out --online, or --loops and --loops-from")
    with unfinished(arguments.out) as kept:
        motions = _motions(arguments, recording, inputs, kept)
        loops = _loops(arguments, recording, motions, kept)
        with Progress(remaining_s) as progress:
            if arguments.online:
                refined = online_refine(recording, motions, config, arguments.lag, progress.count)
            else:
                refined = refine(recording, motions, config, progress, kept / "graph", loops)
            # What people call their files may be a patient's name: a run is named after the folder it is written to.
            refined = replace(refined, name=arguments.out.resolve().name)
            progress("run_folder")
            provenance = Provenance(["refine", "REC", "--out", "RUN"], config, inputs)
            summary = write_run(refined, arguments.out, provenance, motions)
    if arguments.json:
        print_json(summary)
    else:
        print(sentences(summary))
        print(f"run folder: {arguments.out}")
    return 0


def _motions(arguments: argparse.Namespace, recording: Recording, inputs: dict[str, Path],
             kept: Path) -> RelativeMotions:
    """The motions that were given, or measured by the network and kept until the run is written."""
    from fusion.checkpoint import Checkpoint, digest
    from fusion.run_folder import sha256_of
    from vio.motion_sources import merge_motions
    from vio.motions import load_motions

    if arguments.motions is not None:
        sources = [load_motions(path) for path in arguments.motions]
        return sources[0] if len(sources) == 1 else merge_motions(sources).motions
    import learned

    weights = "bundled" if arguments.weights is None else sha256_of(arguments.weights)
    images = [f"{path.name} {path.stat().st_mtime_ns}" for path in recording.frame_paths if path is not None]
    key = digest(text.encode() for text in (weights, *map(sha256_of, inputs.values()), *images))
    stored = Checkpoint(kept / "prediction", key).folder / "motions.npz"
    if not stored.is_file():
        with Progress() as progress:
            learned.predict(recording, arguments.weights, unfinished=kept / "pairs",
                            progress=progress.count).save(stored)
    return load_motions(stored)


def _loops(arguments: argparse.Namespace, recording: Recording, motions: RelativeMotions, kept: Path) -> Loops | None:
    """The loops that were given, or found in the images and kept until the run is written."""
    from fusion.checkpoint import Checkpoint, refinement_key
    from fusion.config import RefineConfig
    from fusion.run_folder import sha256_of
    from vio.loops import load_loops

    if arguments.loops_from is not None:
        return load_loops(arguments.loops_from)
    if not arguments.loops:
        return None
    from learned.loops import find_loops

    weights = "bundled" if arguments.weights is None else sha256_of(arguments.weights)
    key = f"{weights} {refinement_key(recording, motions, RefineConfig())}"
    stored = Checkpoint(kept / "loops", key).folder / "loops.npz"
    if not stored.is_file():
        with Progress() as progress:
            find_loops(recording, motions, arguments.weights, progress=progress.count).save(stored)
    return load_loops(stored)


def _compare(arguments: argparse.Namespace) -> int:
    from fusion.compare_files import compare_paths, write_comparison
    from fusion.compare_text import format_table

    comparison = compare_paths(arguments.runs, arguments.truth)
    if arguments.out is not None:
        write_comparison(comparison, arguments.out)
    if arguments.json:
        print_json(comparison.to_dict())
    else:
        print(format_table(comparison))
    return 0


def _locate(arguments: argparse.Namespace) -> int:
    from fusion.lesions import locate, write_lesions
    from fusion.lesions.text import format_lesions
    from vio.formats import open_recording

    recording = None if arguments.recording is None else open_recording(arguments.recording)
    table = locate(arguments.run, arguments.lesions, depth=arguments.depth, recording=recording,
                   between=None if arguments.between is None else (arguments.between[0], arguments.between[1]),
                   video=arguments.video, depth_relative_sd=arguments.depth_sd)
    out = arguments.run if arguments.out is None else arguments.out
    paths = write_lesions(table, out)
    if arguments.json:
        print_json(table.to_dict())
    else:
        print(format_lesions(table))
        print("\n".join(str(path) for path in paths))
        print(f"in pictures: capsule-vio report {arguments.run}" if out == arguments.run else "")
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from fusion.lesions import read_lesions
    from fusion.report import write_report
    from fusion.run_folder import read_summary
    from fusion.run_stream import RunFrames
    from vio.formats import open_recording

    recording = None if arguments.recording is None else open_recording(arguments.recording)
    summary = read_summary(arguments.run)
    write_report(RunFrames(arguments.run), summary, arguments.run / "report.html", lesions=read_lesions(arguments.run),
                 recording=recording)
    print(arguments.run / "report.html")
    return 0


def _view(arguments: argparse.Namespace) -> int:
    from fusion.lesions import read_lesions
    from fusion.run_states import read_refinement
    from fusion.view import write_rerun
    from vio.depth_folder import read_depth_folder
    from vio.formats import open_recording

    recording = None if arguments.recording is None else open_recording(arguments.recording)
    depth = None if arguments.depth is None else read_depth_folder(arguments.depth, recording)
    write_rerun(read_refinement(arguments.run), arguments.out, recording=recording, depth=depth,
                lesions=read_lesions(arguments.run))
    print(f"{arguments.out}: open it with `rerun {arguments.out.name}`")
    return 0


if __name__ == "__main__":
    sys.exit(main())
