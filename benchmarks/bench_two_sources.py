"""The pose network's motions and depth-aligned ones together: is the mean better, and honest; does the graph gain?

    python benchmarks/make_training_data.py DATA
    python benchmarks/bench_two_sources.py DATA --out OUT

Motions are files in OUT as soon as they are measured; started again, it goes on where it stopped.
"""

from __future__ import annotations

import argparse
import os
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from bench_learned import part
from results import record, table

import learned
from fusion import refine
from learned.depth_aligned import depth_aligned_motions
from learned.uncertainty import motion_nees
from vio import load_motions, se3
from vio.metrics import ate
from vio.motion_sources import MergedMotions, merge_motions
from vio.motions import RelativeMotions
from vio.recording import Recording

MOVING_M = 0.5e-3
RULES = ("correlation ignored", "from their closeness", "as the weights declare")


@dataclass(frozen=True)
class Pair:
    """Errors of one recording's motions by one rule, on the pairs that both sources measured."""

    rotation_deg: np.ndarray
    direction_deg: np.ndarray
    nees: np.ndarray
    """Per degree of freedom, at the recording's own scale."""
    log_likelihood: np.ndarray


def motions_of(recording: Recording, out: Path) -> tuple[RelativeMotions, RelativeMotions]:
    """The network's and the depth-aligned ones: read, or measured."""
    found = []
    for name, measure in (("network", learned.predict), ("aligned", depth_aligned_motions)):
        path = out / f"{recording.provenance['seed']}-{name}.npz"
        if not path.is_file():
            out.mkdir(parents=True, exist_ok=True)
            measure(recording).save(path)
        found.append(load_motions(path))
    return found[0], found[1]


def merged(a: RelativeMotions, b: RelativeMotions, rule: str) -> MergedMotions:
    """Both in one unit, with covariances that count shared errors once, or twice where their correlation is ignored."""
    if rule == RULES[2]:
        return merge_motions([a, b])
    both = merge_motions([a, replace(b, meta={})])
    if rule == RULES[1]:
        return both
    factor = np.sqrt(np.repeat(1 + both.correlation[0, 1], 3))
    shared = np.isin(both.motions.t_i_s, b.t_i_s)
    cov = np.where(shared[:, None, None], both.motions.cov / np.outer(factor, factor), both.motions.cov)
    return replace(both, motions=replace(both.motions, cov=cov))


def means(both: MergedMotions, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times (K,), motions and covariances of the pairs that `count` sources measured, weighed by their covariances."""
    by_source = [both.motions.t_i_s[both.source == k] for k in range(2)]
    shared = np.intersect1d(*by_source)
    parts = []
    for k, t in enumerate(by_source):
        at = np.flatnonzero(both.source == k)[np.searchsorted(t, shared)]
        parts.append((both.motions.T_i_j[at], both.motions.cov[at]))
    (A, cov_a), (B, cov_b) = parts
    if count == 1:
        return shared, A, cov_a
    gain = cov_a @ np.linalg.inv(cov_a + cov_b)
    return shared, A @ se3.exp((gain @ se3.log(se3.inverse(A) @ B)[..., None])[..., 0]), cov_a - gain @ cov_a


def errors(recording: Recording, t_s: np.ndarray, T: np.ndarray, cov: np.ndarray, log_scale: float) -> Pair:
    """Against truth."""
    truth = recording.truth_at_frames().T_world_body @ recording.calibration.T_body_camera
    k = np.searchsorted(recording.frame_t_s, t_s - 1e-6)
    true = se3.inverse(truth[k]) @ truth[k + 1]
    moving = np.linalg.norm(true[:, :3, 3], axis=1) > MOVING_M
    scaled = true.copy()
    scaled[:, :3, 3] *= np.exp(-log_scale)
    error = se3.log(se3.inverse(T) @ scaled)
    nees = motion_nees(error, cov)
    a, b = T[moving, :3, 3], true[moving, :3, 3]
    cosine = (a * b).sum(axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1))
    return Pair(np.degrees(np.linalg.norm(se3.so3_log(np.swapaxes(T[:, :3, :3], 1, 2) @ true[:, :3, :3]), axis=1)),
                np.degrees(np.arccos(np.clip(cosine, -1, 1))), nees,
                -3 * nees - 0.5 * np.linalg.slogdet(cov)[1])


def own_scale(recording: Recording, motions: RelativeMotions) -> float:
    """ln(metres per unit) by the median of moving steps."""
    truth = recording.truth_at_frames().T_world_body @ recording.calibration.T_body_camera
    k = np.searchsorted(recording.frame_t_s, motions.t_i_s - 1e-6)
    true = np.linalg.norm((se3.inverse(truth[k]) @ truth[k + 1])[:, :3, 3], axis=1)
    moving = true > MOVING_M
    return float(np.median(np.log(true[moving] / np.linalg.norm(motions.T_i_j[moving, :3, 3], axis=1))))


def pair_row(name: str, pairs: list[Pair]) -> list[str]:
    """One line over all recordings."""
    rotation, direction, nees, likelihood = (np.concatenate([getattr(p, key) for p in pairs]) for key in (
        "rotation_deg", "direction_deg", "nees", "log_likelihood"))
    return [name, f"{rotation.mean():.2f}°", f"{np.median(direction):.1f}°", f"{direction.mean():.1f}°",
            f"{nees.mean():.2f}", f"{np.median(nees):.2f}", f"{likelihood.mean():.2f}"]


def main() -> None:
    """Measure what is missing, and record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=Path("out/training_data"))
    parser.add_argument("--out", type=Path, default=Path("out/two_sources"))
    args = parser.parse_args()
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    sections = []
    for name in ("calibration", "held-out"):
        recordings = part(args.data, name)
        found = [motions_of(recording, args.out) for recording in recordings]
        scales = [own_scale(r, a) for r, (a, _) in zip(recordings, found, strict=True)]
        rows = [("network alone", [means(merged(a, b, RULES[0]), 1) for a, b in found])]
        rows += [(f"mean of both, {rule}", [means(merged(a, b, rule), 2) for a, b in found]) for rule in RULES]
        sections.append(f"## Pairs of frames, {name}\n\n" + table(
            ["motion", "rotation", "direction, median", "mean", "NEES", "NEES, median", "log likelihood"],
            [pair_row(row, [errors(r, *m, s) for r, m, s in zip(recordings, parts, scales, strict=True)])
             for row, parts in rows]))
    rows = []
    for recording, (a, b) in zip(recordings, found, strict=True):
        truth = recording.truth_at_frames()
        runs = [refine(recording, motions) for motions in (a, *(merged(a, b, rule).motions for rule in RULES))]
        rows.append([1e3 * ate(run.trajectory, truth, "se3").rmse_m for run in runs])
    shown = [[r.name, *(f"{x:.1f}" for x in row)] for r, row in zip(recordings, rows, strict=True)]
    shown.append(["**median**", *(f"{x:.1f}" for x in np.median(rows, axis=0))])
    record("two_sources", "The pose network and depth-aligned motions together", "\n\n".join([
        "Both look at the same images and depth, so their errors hang together. Covariances of both are those of the "
        "weights' card; the mean weighs both by them. NEES per degree of freedom and log likelihood per pair (without "
        "its constant) at each recording's own scale; on the pairs that both measured. The choice between the rules "
        "was made on the calibration recordings.", *sections,
        "## Trajectory, held-out\n\nATE of the refined trajectory [mm], rmse of position after SE3 alignment.\n\n"
        + table(["recording", "network alone", *(f"both, {rule}" for rule in RULES)], shown)]))


if __name__ == "__main__":
    main()
