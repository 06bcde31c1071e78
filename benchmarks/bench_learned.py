"""The learned pipeline on recordings that nothing was trained, calibrated or tuned on: depth, motion, trajectory.

    python benchmarks/make_training_data.py DATA
    python benchmarks/bench_learned.py DATA [--weights W]
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from make_training_data import plan
from results import RESULTS, record, table

import learned
import vio
from fusion import refine
from learned.evaluation import mean_inverse_depth
from learned.inference import SIGNALS
from learned.measured import Measured, measure
from learned.report import DEPTH_HEADER, MOTION_HEADER, Evaluation, depth_rows, evaluation_of, motion_rows
from learned.truth import truth_of
from learned.uncertainty import uncertainty_from_dict
from learned.weights import Weights, load_weights
from vio.camera import Camera
from vio.metrics import ate
from vio.recording import Recording
from vio.simulation.dataset import write_dataset

TARGETS = (("depth AbsRel, one scale per image", 0.11, "≤"), ("depth Acc, one scale per image, %", 88.0, "≥"),
           ("depth AbsRel, one scale per sequence", 0.13, "≤"), ("rotation, network alone, °", 1.5, "≤"),
           ("rotation, with the gyro, °", 0.2, "≤"), ("translation direction, median, °", 13.0, "≤"))
EVERY = 4  # frames of the training recordings that the mean inverse-depth map is made of


@dataclass(frozen=True)
class EndToEnd:
    """One recording, predicted and refined."""

    name: str
    path_mm: float
    alone_mm: float
    gyro_mm: float
    refined_mm: float
    estimator: str
    policy: str


def part(data: Path, name: str) -> list[Recording]:
    """The recordings of a part, in order."""
    return [vio.open_recording(path) for path in sorted((data / name).iterdir()) if not path.name.startswith(".")]


def priors(training: list[Recording], measured: list[Measured], cameras: list[Camera]) -> list[np.ndarray]:
    """Mean inverse-depth map of the training recordings with the same camera, for each recording."""
    maps: dict[tuple[str, float], np.ndarray] = {}
    for camera in cameras:
        key = (camera.model, round(camera.fx, 3))
        if key in maps:
            continue
        found = []
        for recording in training:
            own = recording.calibration.camera.resized(camera.width, camera.height)
            if (own.model, round(own.fx, 3)) == key:
                depth = truth_of(recording, np.arange(0, len(recording), EVERY), own).depth_m[:, 0].numpy()
                found.append(Known(depth))
        maps[key] = mean_inverse_depth(found)
    return [maps[camera.model, round(camera.fx, 3)] for camera in cameras]


@dataclass(frozen=True)
class Known:
    """True depth alone."""

    depth_true_m: np.ndarray


def end_to_end(recording: Recording, weights: Path | None) -> EndToEnd:
    """Predict, refine, and compare with the motions alone, all SE3-aligned."""
    truth = recording.truth_at_frames()
    refined = refine(recording, learned.predict(recording, weights))
    corrected = refine(recording, learned.predict(recording, weights, rotation="gyro"))
    return EndToEnd(recording.name, 1e3 * truth.path_length_m, 1e3 * ate(refined.motions_only, truth, "se3").rmse_m,
                    1e3 * ate(corrected.motions_only, truth, "se3").rmse_m,
                    1e3 * ate(refined.trajectory, truth, "se3").rmse_m, refined.estimator, refined.scale.policy)


def speed(recording: Recording, weights: Path | None) -> float:
    """Frames per second of `predict`, with this process's threads."""
    learned.predict(recording, weights)
    start = time.perf_counter()
    learned.predict(recording, weights)
    return len(recording) / (time.perf_counter() - start)


def target_rows(evaluation: Evaluation, runs: list[EndToEnd]) -> list[list[str]]:
    """What was to be reached, and what was."""
    depth, motion = evaluation.depth["network"], evaluation.motion
    values = (depth.abs_rel_image, 100 * depth.acc_image, depth.abs_rel_sequence, motion["network"].rotation_deg,
              motion["network with gyro"].rotation_deg, motion["network"].direction_deg)
    rows = [[name, f"{sign} {limit:g}", f"{value:.2f}", "yes" if (value <= limit) == (sign == "≤") else "**no**"]
            for (name, limit, sign), value in zip(TARGETS, values, strict=True)]
    nees = evaluation.nees or float("nan")
    ratio = np.array([r.refined_mm / r.alone_mm for r in runs])
    return [*rows, ["motion NEES per degree of freedom", "0.5 – 2", f"{nees:.2f}", "yes" if 0.5 <= nees <= 2 else
                    "**no**"],
            ["ATE refined / alone, median", "≤ 0.5", f"{np.median(ratio):.2f}", "yes" if np.median(ratio) <= 0.5 else
             "**no**"],
            ["ATE refined / alone, worst", "≤ 1", f"{ratio.max():.2f}", "yes" if ratio.max() <= 1 else "**no**"]]


def better_guesses(evaluation: Evaluation) -> str:
    """Where something without a network does better, metric by metric."""
    lines = []
    for scores, metrics in ((evaluation.depth, {"abs_rel_image": 1, "acc_image": -1, "abs_rel_sequence": 1,
                                                "acc_sequence": -1}),
                            (evaluation.motion, {"rotation_deg": 1, "direction_deg": 1, "step_mm": 1,
                                                 "length_correlation": -1})):
        for metric, sign in metrics.items():
            own = getattr(scores["network"], metric)
            wins = [name for name, score in scores.items() if not name.startswith("network")
                    and sign * getattr(score, metric) < sign * own]
            if wins:
                lines.append(f"`{metric}`: {', '.join(wins)}")
    return "Guesses that beat the network – " + ("; ".join(lines) or "none") + "."


def trajectory_rows(runs: list[EndToEnd]) -> list[list[str]]:
    """One line per recording, and the medians."""
    rows = [[r.name, f"{r.path_mm:.0f}", f"{r.alone_mm:.1f}", f"{r.gyro_mm:.1f}", f"{r.refined_mm:.1f}",
             f"{r.refined_mm / r.alone_mm:.2f}", r.estimator, r.policy] for r in runs]
    ratio = np.array([r.refined_mm / r.alone_mm for r in runs])
    medians = [f"{np.median([getattr(r, name) for r in runs]):.1f}" for name in ("alone_mm", "gyro_mm", "refined_mm")]
    return [*rows, ["**median**", f"{np.median([r.path_mm for r in runs]):.0f}", *medians, f"{np.median(ratio):.2f}",
                    f"worst {ratio.max():.2f}", ""]]


def by_camera(measured: list[Measured], cameras: list[Camera], maps: list[np.ndarray], weights: Weights
              ) -> list[list[str]]:
    """Depth and motion per camera."""
    rows = []
    for key in dict.fromkeys((c.model, round(c.fx)) for c in cameras):
        chosen = [k for k, c in enumerate(cameras) if (c.model, round(c.fx)) == key]
        one = evaluation_of([measured[k] for k in chosen], weights, [maps[k] for k in chosen])
        depth, motion = one.depth["network"], one.motion["network"]
        guess = one.depth["geometric mean of the last two"]
        rows.append([f"{key[0]}, f = {key[1]} px", f"{depth.abs_rel_image:.3f}", f"{guess.abs_rel_image:.3f}",
                     f"{motion.rotation_deg:.2f}°", f"{motion.direction_deg:.1f}°", f"{one.nees or float('nan'):.2f}"])
    return rows


def picture(measured: list[Measured]) -> None:
    """Frames with predicted and true depth and the error, one recording a row: docs/images/depth.png."""
    import cv2

    rows = []
    for m in measured:
        k = len(m) // 2
        mask = (m.depth_true_m[k] > 0) & m.usable & (m.depth[k] > 0)
        scale = np.median(m.depth_true_m[k][mask]) / np.median(m.depth[k][mask])
        low, high = np.log(np.percentile(m.depth_true_m[k][mask], [1, 99]))
        maps = [np.clip((np.log(np.maximum(depth, 1e-6)) - low) / (high - low), 0, 1)
                for depth in (m.depth_true_m[k], m.depth[k] * scale)]
        error = np.clip(np.abs(m.depth[k] * scale / np.maximum(m.depth_true_m[k], 1e-6) - 1) / 0.5, 0, 1)
        shown = [cv2.applyColorMap((255 * (1 - x)).astype(np.uint8), cv2.COLORMAP_VIRIDIS) for x in maps]
        shown.append(cv2.applyColorMap((255 * error).astype(np.uint8), cv2.COLORMAP_INFERNO))
        rows.append(np.hstack([m.images[k][..., ::-1], *(np.where(mask[..., None], x, 0) for x in shown)]))
    path = RESULTS.parent / "images" / "depth.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.vstack(rows), [cv2.IMWRITE_PNG_COMPRESSION, 9])


def main() -> None:
    """Measure everything and record one page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=Path("out/training_data"), help="rendered if missing")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--name", default="learned")
    parser.add_argument("--note", default="", help="a remark for the page")
    args = parser.parse_args()
    sys.argv = [word for word in sys.argv if word not in ("--note", args.note)]  # a remark is no part of the command
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    write_dataset(plan(), args.data)
    weights, held_out = load_weights(args.weights), part(args.data, "held-out")
    measured = [measure(weights.method, weights.card["depth_kind"], recording) for recording in held_out]
    height, width = weights.method.config.image_size
    cameras = [recording.calibration.camera.resized(width, height) for recording in held_out]
    maps = priors(part(args.data, "train"), measured, cameras)
    evaluation = evaluation_of(measured, weights, maps)
    runs = [end_to_end(recording, args.weights) for recording in held_out]
    picture([measured[k] for k in range(min(3, len(measured)))])
    model, card = uncertainty_from_dict(weights.card["uncertainty"]), weights.card
    spread = np.concatenate([model.deviations(m.signals, SIGNALS) for m in measured])
    body = "\n\n".join([
        f"{evaluation.recordings} held-out recordings, {evaluation.pairs} pairs of frames; weights of "
        f"`{card['method']['name']}`, {card['steps']} steps on {card['data']['summary']}. No truth in the training "
        "loss; scale and covariances calibrated on recordings of their own.",
        "## Targets\n\n" + table(["what", "target", "measured", "reached"], target_rows(evaluation, runs))
        + "\n\n" + better_guesses(evaluation) + (f"\n\n{args.note}" if args.note else ""),
        "## How the weights came about\n\n" + "\n".join(f"- {line}" for line in card.get("history", []))
        + f"\n- in all {card['steps']} steps in the last stage, {card['skipped_steps']} skipped",
        "## Depth\n\nAbsRel and Acc(1.25) after one median scale per image and per sequence. The guesses know the mean "
        "inverse depth of the training recordings with the same camera.\n\n"
        + table(DEPTH_HEADER, depth_rows(evaluation)),
        "![Frames, true depth, predicted depth, error](../images/depth.png)\n\nThe first three recordings: frame, true "
        "depth, prediction at the image's median scale (bright = near), relative error (white = 50 % and more).",
        "## Motion\n\nRotation: mean angle; direction: where the camera moves more than 0.5 mm; step after one scale "
        "per recording. \"Constant velocity\" is shown the TRUE step before.\n\n"
        + table(MOTION_HEADER, motion_rows(evaluation))
        + f"\n\nThe gyro alone, its bias of 0.5°/s (sd) left in: {evaluation.gyro_alone_deg:.2f}° per step; freed of "
        f"the bias that gravity and the network's rotations tell: {evaluation.gyro_unbiased_deg:.3f}°.",
        "## By camera\n\n" + table(["camera", "AbsRel, image", "best guess", "rotation", "direction", "NEES"],
                                   by_camera(measured, cameras, maps, weights)),
        "## Covariances\n\nNEES is at each recording's own true scale; the scale prior answers for the rest.\n\n"
        "Signals chosen on the calibration recordings: "
        f"{', '.join(model.signals) or 'none'}. Median sd over the held-out pairs: rotation "
        f"{np.degrees(np.median(spread[:, :3])):.2f}°, translation {np.median(spread[:, 3:]):.3f} units of "
        f"{1e3 * np.exp(card['scale_log_mean']):.1f} mm. The scale prior's sd is {card['scale_log_sd']:.2f}; held out, "
        f"scale was off by {evaluation.scale_error:.2f} (rms of the logarithm).",
        "## Trajectory\n\nATE [mm], rmse of position after SE3 alignment: the motions chained at the prior scale, the "
        "same with their rotation corrected by the gyro, and refined by the graph.\n\n"
        + table(["recording", "path", "alone", "alone, gyro", "refined", "refined / alone", "estimator", "scale"],
                trajectory_rows(runs)),
        f"`predict` runs at {speed(held_out[0], args.weights):.0f} frames/s on one thread, images decoded from disk "
        "included."])
    record(args.name, "The learned pipeline on held-out rendered recordings", body)


if __name__ == "__main__":
    main()
