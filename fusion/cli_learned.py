"""The commands about networks: `train | evaluate | predict | benchmark`."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from fusion.cli_output import print_json
from fusion.cli_progress import Progress
from vio.errors import UsageError

if TYPE_CHECKING:
    from vio.motions import RelativeMotions
    from vio.recording import Recording


def train(arguments: argparse.Namespace) -> int:
    """Train, and calibrate what was trained."""
    from fusion.teaching import teaching_trajectories
    from learned.distributed import leads
    from learned.train_command import run_training
    from vio.formats import open_recording

    recordings, others = ([open_recording(path) for path in paths]
                          for paths in (arguments.recordings, arguments.calibrate))
    taught_by = None if arguments.refined is None else teaching_trajectories(recordings, arguments.refined)
    with Progress() as progress:
        trained = run_training(recordings, others, vars(arguments), progress.count, taught_by)
    if leads():
        print(trained)
    return 0


def evaluate(arguments: argparse.Namespace) -> int:
    """Judge weights beside guesses without a network."""
    from learned.report import evaluate, format_evaluation
    from learned.weights import load_weights
    from vio.formats import open_recording

    weights = load_weights(arguments.weights)
    evaluation = evaluate([open_recording(path) for path in arguments.recordings], weights)
    if arguments.json:
        print_json(evaluation.to_dict())
    else:
        print(format_evaluation(evaluation))
    return 0


def predict(arguments: argparse.Namespace) -> int:
    """Measure relative motions."""
    from vio.formats import open_recording

    recording = open_recording(arguments.recording)
    motions: RelativeMotions
    if arguments.method == "classical":
        from vio.odometry import measure_recording

        motions = measure_recording(recording)
    elif arguments.method == "depth-aligned":
        motions = _depth_aligned(recording, arguments)
    else:
        import learned

        with Progress() as progress:
            motions = learned.predict(recording, arguments.weights, rotation=arguments.rotation,
                                      depth_dir=arguments.depth, progress=progress.count,
                                      unfinished=arguments.out.with_name(f"{arguments.out.name}.unfinished"))
    motions.save(arguments.out)
    lost = motions.meta.get("unreadable_frames", {})
    print(f"{arguments.out}: {len(motions)} motions"
          + (f"; without frame {', '.join(lost)}: {next(iter(lost.values()))}" if lost else ""))
    if arguments.loops is not None:
        from learned.loops import find_loops

        with Progress() as progress:
            loops = find_loops(recording, motions, arguments.weights, progress=progress.count)
        loops.save(arguments.loops)
        print(f"{arguments.loops}: {len(loops)} loops of {loops.proposed} pairs of frames that look alike")
    return 0


def _depth_aligned(recording: Recording, arguments: argparse.Namespace) -> RelativeMotions:
    from learned.depth_aligned import depth_aligned_motions

    if arguments.depth is not None or arguments.rotation != "network":
        raise UsageError("--method depth-aligned goes without --depth and --rotation gyro, which belong to --method "
                         "learned")
    with Progress() as progress:
        return depth_aligned_motions(recording, arguments.weights, progress=progress.count)


def benchmark(arguments: argparse.Namespace) -> int:
    """Measure one of the paper's tables."""
    from learned.benchmark.command import run_table, summary
    from learned.distributed import leads

    with Progress() as progress:
        result = run_table(arguments.table, arguments.data, arguments.budget, arguments.out, seeds=arguments.seeds,
                           method=arguments.method, device=arguments.device, progress=progress)
    if not leads():
        return 0
    if arguments.json:
        print_json(result)
    else:
        print(summary(result, arguments.out))
    return 0
