"""The command line: `capsule-vio demo | doctor | simulate | convert | inspect | train | evaluate | predict | refine |
compare | locate | report`.

Exit codes: 0 done; 2 wrong usage; 3 the input cannot be used; 4 no estimator produced a trajectory;
1 a bug (traceback). Heavy libraries load only in the command that needs them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from tqdm import tqdm

from fusion.cli_parser import build_parser
from vio.errors import UsageError, VioError


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = build_parser().parse_args(argv)
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "demo": _demo, "doctor": _doctor, "simulate": _simulate, "convert": _convert, "inspect": _inspect,
        "train": _train, "evaluate": _evaluate, "predict": _predict, "refine": _refine, "compare": _compare,
        "locate": _locate, "report": _report,
    }
    try:
        return commands[arguments.command](arguments)
    except VioError as error:
        print(f"capsule-vio {arguments.command}: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("interrupted; nothing half-written was kept", file=sys.stderr)
        return 130


class _Progress:
    """Stages on stderr: a line that rewrites itself on a terminal, plain lines otherwise."""

    def __init__(self) -> None:
        self.bar = tqdm(bar_format="{desc} {elapsed}", leave=False, disable=not sys.stderr.isatty())

    def __enter__(self) -> _Progress:
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.close()

    def __call__(self, stage: str) -> None:
        """Announce a stage."""
        text = f"… {stage.replace('_', ' ')}"
        if self.bar.disable:
            print(text, file=sys.stderr, flush=True)
        else:
            self.bar.set_description_str(text)

    def count(self, done: int, total: int) -> None:
        """Announce how much of a known total is done, in steps of a tenth where lines are plain."""
        if not self.bar.disable:
            self.bar.set_description_str(f"… {done} of {total}")
        elif done * 10 // total != (done - 1) * 10 // total:
            self(f"{done} of {total}")


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, sort_keys=True, allow_nan=False))


def _demo(arguments: argparse.Namespace) -> int:
    from fusion.compare import format_table
    from fusion.demo import run_demo

    with _Progress() as progress:
        demo = run_demo(arguments.out, arguments.seed, progress)
    if arguments.json:
        _print_json(demo.comparison.to_dict())
        return 0
    print(format_table(demo.comparison))
    print(f"report: {demo.report}\nplot:   {demo.plot}")
    return 0


def _doctor(arguments: argparse.Namespace) -> int:
    from fusion.doctor import diagnose, format_findings

    findings = diagnose()
    if arguments.json:
        _print_json([finding.__dict__ for finding in findings])
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
        with _Progress() as progress:
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
    with _Progress() as progress:
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
        with _Progress() as progress:
            recording = convert_to_asl(arguments.source, arguments.out, arguments.format, declared, progress.count)
    found = describe(recording)
    if arguments.json:
        _print_json(found)
    else:
        print(f"{arguments.out}: written as {arguments.to}")
        print("\n".join(f"{name.ljust(8)} {text}" for name, text in found.items()))
    return 0


def _inspect(arguments: argparse.Namespace) -> int:
    from vio.formats import open_recording
    from vio.inspection import format_inspection, inspect_recording

    inspection = inspect_recording(open_recording(arguments.recording))
    if arguments.json:
        _print_json(inspection.to_dict())
    else:
        print(format_inspection(inspection))
    if inspection.usable:
        return 0
    first = next(check for check in inspection.checks if check.level == "error")
    print(f"capsule-vio inspect: {first.text}", file=sys.stderr)
    return 3


def _train(arguments: argparse.Namespace) -> int:
    from learned.train_command import run_training
    from vio.formats import open_recording

    recordings, others = ([open_recording(path) for path in paths]
                          for paths in (arguments.recordings, arguments.calibrate))
    with _Progress() as progress:
        trained = run_training(recordings, others, vars(arguments), progress.count)
    print(trained)
    return 0


def _evaluate(arguments: argparse.Namespace) -> int:
    from learned.report import evaluate, format_evaluation
    from learned.weights import load_weights
    from vio.formats import open_recording

    weights = load_weights(arguments.weights)
    evaluation = evaluate([open_recording(path) for path in arguments.recordings], weights)
    if arguments.json:
        _print_json(evaluation.to_dict())
    else:
        print(format_evaluation(evaluation))
    return 0


def _predict(arguments: argparse.Namespace) -> int:
    from vio.formats import open_recording

    recording = open_recording(arguments.recording)
    if arguments.method == "classical":
        from vio.odometry import measure_recording

        motions = measure_recording(recording)
    elif arguments.method == "depth-aligned":
        motions = _depth_aligned(recording, arguments)
    else:
        import learned

        with _Progress() as progress:
            motions = learned.predict(recording, arguments.weights, rotation=arguments.rotation,
                                      depth_dir=arguments.depth, progress=progress.count)
    motions.save(arguments.out)
    print(f"{arguments.out}: {len(motions)} motions")
    return 0


def _depth_aligned(recording: Any, arguments: argparse.Namespace) -> Any:
    from learned.depth_aligned import depth_aligned_motions

    if arguments.depth is not None or arguments.rotation != "network":
        raise UsageError("--method depth-aligned goes without --depth and --rotation gyro, which belong to --method "
                         "learned")
    with _Progress() as progress:
        return depth_aligned_motions(recording, arguments.weights, progress=progress.count)


def _refine(arguments: argparse.Namespace) -> int:
    from fusion.config import RefineConfig, load_config
    from fusion.refine import refine
    from fusion.run_folder import Provenance, write_run
    from vio.formats import open_recording
    from vio.motions import load_motions

    config = RefineConfig() if arguments.config is None else load_config(arguments.config)
    if arguments.estimator is not None:
        config = replace(config, estimator=arguments.estimator)
    recording = open_recording(arguments.recording)
    inputs = {"imu": arguments.recording / "mav0" / "imu0" / "data.csv",
              "frames": arguments.recording / "mav0" / "cam0" / "data.csv"}
    if arguments.motions is not None:
        motions = load_motions(arguments.motions)
        inputs["motions"] = arguments.motions
    else:
        import learned

        motions = learned.predict(recording, arguments.weights)
    inputs = {name: path for name, path in inputs.items() if path.is_file()}
    with _Progress() as progress:
        refined = refine(recording, motions, config, progress)
    command = ["refine", arguments.recording.name, "--out", arguments.out.name]
    summary = write_run(refined, arguments.out, Provenance(command, config, inputs), motions)
    if arguments.json:
        _print_json(summary)
    else:
        print(_sentences(summary))
        print(f"run folder: {arguments.out}")
    return 0


def _sentences(summary: dict[str, Any]) -> str:
    from fusion.compare import verdict

    scale, fallback = summary["scale"], summary["fallback_reason"]
    lines = [
        f"estimator: {summary['estimator']}" + (f" (fell back: {fallback})" if fallback else ""),
        f"{summary['frames']} frames, {summary['duration_s']:.1f} s, path {summary['path_length_m']:.4f} m",
        f"scale: {scale['policy']} – {scale['reason']}",
        f"motions: {summary['motions']['used']} used, {summary['motions']['rejected']} rejected",
    ]
    if "accuracy" in summary:
        lines.append(verdict(summary["accuracy"]["motions"], summary["accuracy"]["refined"]))
    return "\n".join(lines)


def _compare(arguments: argparse.Namespace) -> int:
    from fusion.compare import compare_paths, format_table

    comparison = compare_paths(arguments.runs, arguments.truth)
    if arguments.json:
        _print_json(comparison.to_dict())
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
        _print_json(table.to_dict())
    else:
        print(format_lesions(table))
        print("\n".join(str(path) for path in paths))
        print(f"in pictures: capsule-vio report {arguments.run}" if out == arguments.run else "")
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from fusion.lesions import read_lesions
    from fusion.report import write_report
    from fusion.run_folder import read_run
    from fusion.run_states import read_refinement

    refinement, summary = read_refinement(arguments.run), read_run(arguments.run).summary
    write_report(refinement, summary, arguments.run / "report.html", lesions=read_lesions(arguments.run))
    print(arguments.run / "report.html")
    return 0


if __name__ == "__main__":
    sys.exit(main())
