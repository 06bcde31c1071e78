"""Does vibration help our own method? Vision-only against vision–vibration, same data, seeds, steps and start.

    python benchmarks/make_training_data.py DATA
    python benchmarks/bench_vibration.py DATA --out OUT [--steps 400] [--seeds 3]

Every training and its scores are files in OUT as soon as they are there; started again, it goes on where it stopped.
Trained on the recordings with vibration among the first 36; judged on all of the parts that nothing is trained on.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from bench_learned import part, priors
from make_training_data import plan
from results import record, table

import vio
from learned.benchmark.scores import mean_log_snr
from learned.benchmark.statistics import paired_difference
from learned.evaluation import depth_score, motion_score, trivial_depths, trivial_motions
from learned.measured import Measured, measure
from learned.methods import assemble, method_config
from learned.train_config import MEASURED_BRANCH, MEASURED_FUSION, TrainConfig, train_config, train_config_to_dict
from learned.training import train
from vio.atomic import atomic_write
from vio.recording import Recording

ARMS = ("vision-only", "vision–vibration")
FILES = dict(zip(ARMS, ("vision", "vibration"), strict=True))
METRICS = {"abs_rel_image": ("AbsRel", 1, 3, "lower"), "acc_image": ("Acc [%]", 100, 1, "higher"),
           "abs_rel_sequence": ("AbsRel, sequence", 1, 3, "lower"), "rotation_deg": ("rotation [°]", 1, 2, "lower"),
           "direction_deg": ("direction [°]", 1, 1, "lower"), "step_mm": ("step [mm]", 1, 2, "lower")}
"""Label, factor, digits, which is better; means over recordings, direction the median within each."""
JUDGED = ("calibration", "held-out")
GUESS = {"depth": "geometric mean of the last two", "motion": "identity"}


def decisions(arm: str, seed: int, steps: int) -> TrainConfig:
    """The measured recipe; the two arms differ in the vibration alone."""
    method = method_config("gyro-correlation", vibration=arm == ARMS[1], fusion=MEASURED_FUSION,
                           branch=MEASURED_BRANCH)
    return train_config(method, steps=steps, seed=seed, validate_every=steps, checkpoint_every=50)


def training_recordings(data: Path) -> list[Recording]:
    """Those of the first 36 that vibrate."""
    return [vio.open_recording(data / s.path) for s in plan() if s.path.startswith("train/") and s.vibration != "none"]


def scores(depth: list[np.ndarray], motion: list[np.ndarray], measured: list[Measured]) -> list[dict[str, float]]:
    """Metrics of every recording by itself."""
    rows = []
    for maps, T, m in zip(depth, motion, measured, strict=True):
        d, s = depth_score([maps], [m]), motion_score([T], [m])
        rows.append({name: float(getattr(d if hasattr(d, name) else s, name)) for name in METRICS})
    return rows


def run(arm: str, seed: int, steps: int, data: Path, out: Path, judged: list[Recording]) -> dict:
    """Scores of one training: read, or trained and judged for."""
    config, name = decisions(arm, seed, steps), f"{FILES[arm]}_seed-{seed}"
    path, decided = out / f"{name}.json", json.loads(json.dumps(train_config_to_dict(config)))
    if path.is_file():
        found = json.loads(path.read_text(encoding="utf-8"))
        if found["decisions"] != decided:
            sys.exit(f"{path.name} was made with other decisions; choose another --out")
        return found
    trained = train(training_recordings(data), config, out / name,
                    progress=lambda k, n: print(f"{name}: {k} of {n}", flush=True) if k % 50 == 0 else None)
    measured = [measure(trained.method, config.depth_kind, recording) for recording in judged]
    found = {"decisions": decided, "steps": trained.step, "skipped": trained.skipped, "loss": trained.validation,
             "scores": scores([m.depth for m in measured], [m.T_i_j for m in measured], measured),
             "log_snr": [mean_log_snr(m) for m in measured]}
    with atomic_write(path) as file:
        file.write(json.dumps(found, indent=1).encode())
    return found


def guesses(data: Path, judged: list[Recording], steps: int) -> list[dict[str, float]]:
    """The best depth without a network, and rest."""
    config = decisions(ARMS[0], 0, steps)
    measured = [measure(assemble(config.method, seed=0).eval(), config.depth_kind, recording) for recording in judged]
    maps = priors(part(data, "train")[:36], measured, [m.camera for m in measured])
    return scores(trivial_depths(measured, maps)[GUESS["depth"]], trivial_motions(measured)[GUESS["motion"]], measured)


def cells(found: dict[tuple[str, int], dict], arm: str, metric: str, seeds: int, chosen: list[int]) -> np.ndarray:
    """(seeds, recordings)."""
    return np.array([[found[arm, seed]["scores"][k][metric] for k in chosen] for seed in range(seeds)])


def difference_row(found: dict, metric: str, seeds: int, row: str, chosen: list[int]) -> list[str]:
    """One metric of one choice of recordings: both arms, the difference with its interval, who is ahead where."""
    label, factor, digits, better = METRICS[metric]
    one, other = (factor * cells(found, arm, metric, seeds, chosen) for arm in ARMS)
    d = paired_difference(one, other, f"{row} {metric}")
    interval = "too few" if d.low is None else f"{d.low:+.{digits}f} to {d.high:+.{digits}f}"
    ahead = d.candidate_lower if better == "lower" else d.candidate_higher
    verdict = ("no telling" if not d.excludes_zero else
               f"{ARMS[1] if (d.mean < 0) == (better == 'lower') else ARMS[0]} better")
    return [row, label, f"{one.mean():.{digits}f}", f"{other.mean():.{digits}f}", f"{d.mean:+.{digits}f}", interval,
            f"{ahead} of {one.size}", verdict]


def groups(judged: list[Recording]) -> dict[str, list[int]]:
    """Numbers of recordings by kind of vibration, those that vibrate together first."""
    kinds = [str(r.provenance["vibration"]) for r in judged]
    return {"all that vibrate": [k for k, kind in enumerate(kinds) if kind != "none"],
            **{kind: [k for k, one in enumerate(kinds) if one == kind] for kind in sorted(set(kinds))}}


def body(found: dict, seeds: int, steps: int, data: Path, judged: list[Recording], note: str) -> str:
    """The page."""
    of = groups(judged)
    whole = of["all that vibrate"]
    header = ["recordings", "metric", *ARMS, "difference", "95 % interval", "vibration ahead", "says"]
    return "\n\n".join([
        "The fifth method, `gyro-correlation`, with Fourier heterogeneous fusion and without vibration: "
        f"{seeds} seeds, {steps} steps at batch 4 and 128 × 128 px with the measured recipe, from random weights, on "
        f"the {len(training_recordings(data))} recordings with vibration among the 36 training recordings. Judged on "
        f"{len(judged)} recordings that nothing was trained on, {len(whole)} of them with vibration. The arms share "
        "data, order of data, seeds, steps and the start of their vision networks. Both have the gyro's rotation in "
        "the warp while they train.",
        *([note] if note else []),
        "## Differences\n\nMeans over seeds and recordings, vision–vibration minus vision-only; intervals from seeds "
        "and recordings, both resampled and stretched for how few they are (`learned/benchmark/statistics.py`). Depth "
        "after one median scale per image (AbsRel, Acc) or per recording; rotation: mean angle; direction: median "
        "angle of each recording where the camera moves more than 0.5 mm; step: after one scale per recording.\n\n"
        + table(header, [difference_row(found, m, seeds, row, chosen) for row, chosen in of.items() for m in METRICS]),
        "## Trainings\n\nOver the recordings that vibrate. \"No network\": the geometric mean of brightness^-1/2 and "
        "the mean inverse-depth map of the training recordings, and rest. Photometric: of the validation split.\n\n"
        + table(["arm", "seed", *(label for label, *_ in METRICS.values()), "photometric", "steps lost"],
                training_rows(found, seeds, whole, guesses(data, judged, steps))),
        "## SNR\n\nGeometric mean over the blocks of both networks and the pairs of each recording; all blocks start "
        "at 4, and where it does not differ between recordings the branch has learned nothing.\n\n"
        + table(["vibration", *(f"seed {seed}" for seed in range(seeds))], snr_rows(found, seeds, judged))])


def training_rows(found: dict, seeds: int, chosen: list[int], guess: list[dict[str, float]]) -> list[list[str]]:
    """Every training by itself, and no network."""
    def shown(values: dict[str, float]) -> list[str]:
        return [f"{METRICS[m][1] * values[m]:.{METRICS[m][2]}f}" for m in METRICS]
    rows = []
    for seed in range(seeds):
        for arm in ARMS:
            means = {m: float(cells(found, arm, m, seeds, chosen)[seed].mean()) for m in METRICS}
            run_ = found[arm, seed]
            rows.append([arm, str(seed), *shown(means), f"{run_['loss']['photometric']:.4f}", str(run_["skipped"])])
    nothing = {m: float(np.mean([guess[k][m] for k in chosen])) for m in METRICS}
    return [*rows, ["no network", "", *shown(nothing), "", ""]]


def snr_rows(found: dict, seeds: int, judged: list[Recording]) -> list[list[str]]:
    """SNR of every recording, by kind and level of vibration."""
    order = sorted(range(len(judged)), key=lambda k: (str(judged[k].provenance["vibration"]),
                                                      int(judged[k].provenance["vibration_level"])))
    return [[f"{judged[k].provenance['vibration']}, level {judged[k].provenance['vibration_level']}",
             *(f"{np.exp(found[ARMS[1], seed]['log_snr'][k]):.2f}" for seed in range(seeds))] for k in order]


def main() -> None:
    """Train what is missing, and record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", default=Path("out/training_data"))
    parser.add_argument("--out", type=Path, default=Path("out/vibration"))
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--note", default="", help="a remark for the page")
    args = parser.parse_args()
    sys.argv = [word for word in sys.argv if word not in ("--note", args.note)]  # a remark is no part of the command
    torch.set_num_threads(int(os.environ["OMP_NUM_THREADS"]))
    judged = [recording for name in JUDGED for recording in part(args.data, name)]
    found = {(arm, seed): run(arm, seed, args.steps, args.data, args.out, judged)
             for seed in range(args.seeds) for arm in ARMS}
    record("vision_vibration", "Vision alone against vision and vibration",
           body(found, args.seeds, args.steps, args.data, judged, args.note))


if __name__ == "__main__":
    main()
