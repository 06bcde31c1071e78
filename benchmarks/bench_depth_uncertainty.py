"""How honest the sd of predicted depth is, and depth-aligned motions beside the pose network's, on held-out recordings.

    python benchmarks/make_training_data.py DATA
    python benchmarks/bench_depth_uncertainty.py DATA [--weights W]

What the weights' card lacks is calibrated on DATA/calibration first, as `learned.calibration.extend_card` does.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from make_training_data import plan
from results import record, table

import vio
from learned.aligned_calibration import Aligned, align, aligned_nees, network_correlation, tracks_of
from learned.calibration import depth_sections
from learned.camera_rays import camera_batch
from learned.depth_aligned import ALIGNED_SIGNALS as SIGNALS_OF_FITS
from learned.depth_aligned import AlignedModel, aligned_model_from_dict, aligned_signals, depth_aligned_motions
from learned.depth_calibration import PIXELS_PER_IMAGE, SEED, depth_coverage, pixel_errors
from learned.depth_uncertainty import FOLDS, depth_uncertainty_from_dict
from learned.dihedral import Symmetry
from learned.evaluation import angle_deg
from learned.inference import SIGNALS
from learned.measured import BATCH, MOVING_M, Measured, measure
from learned.pixel_signals import PIXEL_SIGNALS
from learned.training_source import SourceSettings, TrainingSource
from learned.uncertainty import UncertaintyModel, fit_log_sd, motion_nees, standardised, uncertainty_from_dict
from learned.warping import to_z_depth
from learned.weights import Weights, bundled_path, load_weights, rewrite_card
from vio import se3
from vio.recording import Recording
from vio.simulation.dataset import write_dataset

MIRROR = Symmetry(mirror_x=True)


def part(data: Path, name: str) -> list[Recording]:
    """The recordings of a part, in order."""
    return [vio.open_recording(path) for path in sorted((data / name).iterdir()) if not path.name.startswith(".")]


def mirrored_depth(recording: Recording, m: Measured, weights: Weights) -> np.ndarray:
    """(N, H, W) what the network says of the mirrored frames, with the IMU mirrored too, mirrored back."""
    config = weights.method.config
    source = TrainingSource(recording, SourceSettings(*config.image_size, imu=True, imu_samples=config.branch.samples))
    windows = MIRROR.imu(source.vibration(np.arange(len(m))), source.R_body_camera)
    out = []
    for start in range(0, len(m), BATCH):
        images = torch.from_numpy(m.images[start : start + BATCH]).permute(0, 3, 1, 2).float() / 255
        shaken = torch.from_numpy(windows[start : start + BATCH]).float().transpose(1, 2).contiguous()
        with torch.no_grad():
            found = weights.method(MIRROR.image(images)[:, None], shaken, depth_frames=(0,), pairs=())
        cameras = camera_batch([MIRROR.camera(m.camera)] * len(images))
        z = to_z_depth(found.depth[0].depth[0].float(), cameras, weights.card["depth_kind"])
        out.append(MIRROR.image(z)[:, 0].numpy())
    return np.concatenate(out)


def mirror_gain(measured: list[Measured], mirrored: list[np.ndarray], chosen: list[str], scale: float) -> float:
    """Gain in log likelihood per pixel, on recordings left out, of the mirrored pass beside the chosen signals."""
    pixels = pixel_errors(measured, scale, np.random.default_rng(SEED))
    columns = pixels.signals[:, [PIXEL_SIGNALS.index(name) for name in chosen]]
    apart = [np.log(np.abs(np.log(np.maximum(other, 1e-6) / np.maximum(m.depth, 1e-6))) + 0.01)
             for m, other in zip(measured, mirrored, strict=True)]
    rng, rows = np.random.default_rng(SEED), []
    for m, map_ in zip(measured, apart, strict=True):  # the same draws as in `pixel_errors`
        for k in range(len(m)):
            index = np.flatnonzero((m.depth_true_m[k] > 0) & m.usable & (m.depth[k] > 0))
            taken = np.arange(len(index)) if len(index) <= PIXELS_PER_IMAGE else np.sort(
                rng.choice(len(index), PIXELS_PER_IMAGE, replace=False))
            rows.append(map_[k].ravel()[index[taken]])
    both = np.column_stack([columns, np.concatenate(rows)])
    return left_out(pixels.error, both, pixels.recording) - left_out(pixels.error, columns, pixels.recording)


def left_out(error: np.ndarray, columns: np.ndarray, recording: np.ndarray) -> float:
    """Mean Gaussian log likelihood on recordings left out, without its constant."""
    total = 0.0
    for fold in range(FOLDS):
        out = np.isin(recording, np.unique(recording)[fold::FOLDS])
        mean, sd = columns[~out].mean(axis=0), columns[~out].std(axis=0) + 1e-6
        w = fit_log_sd(np.abs(error[~out, None]), standardised(columns[~out], mean, sd))
        log_sd = standardised(columns[out], mean, sd) @ w
        total += float(np.sum(-log_sd - 0.5 * (error[out] * np.exp(-log_sd)) ** 2))
    return total / len(error)


def coverage_row(name: str, measured: list[Measured], card: dict, scale: float) -> list[str]:
    """One line about the depth of a part."""
    found = depth_coverage(measured, depth_uncertainty_from_dict(card), scale)
    assert found is not None
    return [name, *(f"{100 * x:.1f} %" for x in (found.image, found.image_gaussian, found.prior)),
            f"{100 * min(found.recordings):.1f} – {100 * max(found.recordings):.1f} %", f"{found.rms_over_sd:.2f}",
            f"{found.best_tenth:.2f}", f"{found.worst_tenth:.2f}"]


def fused(one: Aligned, model: AlignedModel, network: UncertaintyModel, scale: float) -> np.ndarray:
    """Both sources weighed by their covariances, correlation ignored, each metric at its prior scale."""
    parts = []
    for T, cov, log_scale in (
            (one.pairs.T_i_j, network.covariance(one.pairs.signals, SIGNALS), scale),
            (one.fits.T_i_j, model.uncertainty.covariance(aligned_signals(one.fits), SIGNALS_OF_FITS),
             model.scale_log_mean)):
        unit = np.array([1.0] * 3 + [np.exp(log_scale)] * 3)
        metric = T.copy()
        metric[:, :3, 3] *= unit[3]
        parts.append((metric, cov * np.outer(unit, unit)))
    (A, cov_a), (B, cov_b) = parts
    gain = cov_a @ np.linalg.inv(cov_a + cov_b)
    return A @ se3.exp((gain @ se3.log(se3.inverse(A) @ B)[..., None])[..., 0])


def motion_row(name: str, motions: list[np.ndarray], aligned: list[Aligned], nees: np.ndarray | None) -> list[str]:
    """One line about a source, on the pairs that both measured."""
    rotation, direction, step = [], [], []
    for T, one in zip(motions, aligned, strict=True):
        true, t = one.pairs.T_true_m, T[:, :3, 3]
        t_true = true[:, :3, 3]
        rotation.append(angle_deg(T, true))
        cosine = (t * t_true).sum(1) / np.maximum(np.linalg.norm(t, axis=1) * np.linalg.norm(t_true, axis=1), 1e-12)
        direction.append(np.degrees(np.arccos(np.clip(cosine, -1, 1)))[np.linalg.norm(t_true, axis=1) > MOVING_M])
        scale = max((t * t_true).sum() / (t * t).sum(), 0.0)
        step.append(1e3 * np.linalg.norm(scale * t - t_true, axis=1))
    cells = [f"{f(np.concatenate(x)):.{n}f}{u}" for x, n, u in ((rotation, 2, "°"), (direction, 1, "°"),
                                                               (step, 2, " mm")) for f in (np.median, np.mean)]
    return [name, *cells, "" if nees is None else f"{nees.mean():.2f}"]


def network_nees(aligned: list[Aligned], network: UncertaintyModel) -> np.ndarray:
    """NEES per degree of freedom of the pose network on the same pairs, each recording at its own scale."""
    return np.concatenate([motion_nees(a.pairs.errors(a.pairs.log_scale),
                                       network.covariance(a.pairs.signals, SIGNALS)) for a in aligned])


def cpu_ms_per_frame(recording: Recording, weights: Path | None, sections: dict) -> float:
    """Processor time of `depth_aligned_motions`, decoding included."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "extended.safetensors"
        rewrite_card(weights or bundled_path(), file, sections)
        depth_aligned_motions(recording, file)
        start = time.process_time()
        depth_aligned_motions(recording, file)
    return 1e3 * (time.process_time() - start) / len(recording)


def main() -> None:
    """Measure everything and record one page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=Path("out/training_data"), help="rendered if missing")
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--name", default="depth_uncertainty")
    args = parser.parse_args()
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    write_dataset(plan(), args.data)
    weights, recordings = load_weights(args.weights), {p: part(args.data, p) for p in ("calibration", "held-out")}
    measured = {name: [measure(weights.method, weights.card["depth_kind"], r) for r in found]
                for name, found in recordings.items()}
    network, scale = uncertainty_from_dict(weights.card["uncertainty"]), float(weights.card["scale_log_mean"])
    names = ("depth_uncertainty", "depth_aligned")
    sections = {name: weights.card.get(name) for name in names}
    if None in sections.values():
        sections = depth_sections(measured["calibration"], network, scale)
    of_depth, model = sections["depth_uncertainty"], aligned_model_from_dict(sections["depth_aligned"])
    mirrored = [mirrored_depth(r, m, weights) for r, m in zip(recordings["calibration"], measured["calibration"],
                                                              strict=True)]
    gain = mirror_gain(measured["calibration"], mirrored, of_depth["signals"], scale)
    aligned = {name: [align(m, tracks, model.noise) for m in found for tracks in [tracks_of(m)] if tracks is not None]
               for name, found in measured.items()}
    found, pairs = aligned["held-out"], sum(len(m) for m in measured["held-out"])
    correlation = {name: network_correlation(some, model, network) for name, some in aligned.items()}
    rows = [motion_row("pose network", [a.pairs.T_i_j for a in found], found, network_nees(found, network)),
            motion_row("depth-aligned", [a.fits.T_i_j for a in found], found, aligned_nees(found, model)),
            motion_row("both, weighed by covariance", [fused(a, model, network, scale) for a in found], found, None)]
    alone = ", ".join(f"{name} {value:+.3f}" for name, value in of_depth["gain_alone"].items())
    calibration, held = measured["calibration"], measured["held-out"]
    body = "\n\n".join([
        f"Weights `{weights.name}`, SHA-256 {weights.card['sha256'][:12]}…; calibrated on {len(calibration)} "
        f"recordings, judged on {len(held)} others ({pairs} pairs of frames). Nothing was chosen on held-out "
        "recordings.",
        "## Standard deviation of ln depth, per pixel\n\nShare of all pixels with known truth in the 95 % interval: "
        f"at the image's median scale (± {of_depth['interval_95']:.2f} sd), there with ± 1.96 sd, and of the depth as "
        f"written, at the prior scale (± {of_depth['prior_interval_95']:.2f} sd, a whole image being off by "
        f"{of_depth['common_log_sd']:.2f} in ln scale, rms). Error: rms of ln depth at the image's scale, of the tenth "
        "of the pixels with the smallest and with the largest sd.\n\n"
        + table(["part", "image scale", "± 1.96 sd", "prior scale", "image scale, by recording", "rms error / sd",
                 "error, surest tenth", "error, least sure tenth"],
                [coverage_row(name, some, of_depth, scale) for name, some in measured.items()]),
        f"Signals chosen: {', '.join(of_depth['signals']) or 'none'}; coverage on calibration recordings left out of "
        f"the fit {100 * of_depth['left_out_coverage']:.1f} %. Gain of each signal alone in log likelihood per pixel, "
        f"left out: {alone}. A mirrored pass (how far its ln depth is from the first's) beside the chosen ones: "
        f"{gain:+.3f}, for one more run of the depth network; it is not used.",
        "## Depth-aligned motions\n\n"
        f"Noise from calibration: tracks {model.noise.pixel_px:.2f} px, two depths of a point "
        f"{model.noise.depth_relative:.3f} each, scale prior {1e3 * np.exp(model.scale_log_mean):.1f} mm per unit, sd "
        f"of its logarithm {model.noise.scale_log_sd:.2f} (the network's {1e3 * np.exp(scale):.1f} mm, "
        f"{weights.card['scale_log_sd']:.2f}). Covariance from {', '.join(model.uncertainty.signals) or 'no signal'}; "
        f"NEES on calibration recordings {aligned_nees(aligned['calibration'], model).mean():.2f}. Held out, on the "
        f"{sum(len(a.pairs) for a in found)} of {pairs} pairs whose points determine a motion; median and mean; "
        "direction where the camera moves more than 0.5 mm; step after one scale per recording; NEES per degree of "
        "freedom at each recording's own scale:\n\n"
        + table(["motion", "rotation, median", "mean", "direction, median", "mean", "step, median", "mean", "NEES"],
                rows),
        "Correlation of its errors with the pose network's, both over their sds:\n\n"
        + table(["part", "rotation", "translation", "x, y, z turn; x, y, z shift"],
                [[name, f"{c['rotation']:.2f}", f"{c['translation']:.2f}",
                  " ".join(f"{x:+.2f}" for x in c["per_axis"])] for name, c in correlation.items()]),
        "`depth_aligned_motions` takes "
        f"{cpu_ms_per_frame(recordings['held-out'][0], args.weights, sections):.0f} ms of processor time per frame, "
        "images decoded twice included."])
    record(args.name, "How wrong predicted depth is, and motions aligned by it", body)


if __name__ == "__main__":
    main()
