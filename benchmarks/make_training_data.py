"""Recordings to train on, to calibrate with and to judge by: all organs, vibrations, levels and three cameras.

    python benchmarks/make_training_data.py DATA        # DATA/train/00 …, DATA/calibration/00 …, DATA/held-out/00 …
    python benchmarks/make_training_data.py DATA --train 9 --seconds 8

No two parts share a seed, so no tract is in two of them. What is there already is not rendered again.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from itertools import product
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("NUMBA_NUM_THREADS", "1")

from vio.simulation import KINDS, ORGANS
from vio.simulation.dataset import Sequence, write_dataset

CAMERAS = ("fisheye-140", "pinhole-110", "mirocam")
LEVELS = (3, 1, 5, 2, 4)
DRIVINGS = ("operated", "brisk", "operated", "brisk", "natural")
VIBRATIONS = ("gaussian", "collision", "peristalsis", "gaussian", "none", "collision", "gaussian")
TRAIN_SEED, CALIBRATION_SEED, HELD_OUT_SEED = 5000, 7000, 9000
SIZE = 160


def sequences(part: str, count: int, first_seed: int, duration_s: float) -> Iterator[Sequence]:
    """`count` recordings; the first nine show every organ through every camera, then again with other vibrations."""
    views = list(product(ORGANS, CAMERAS))
    for k in range(count):
        organ, camera = views[(4 * k) % len(views)]
        vibration = VIBRATIONS[k % len(VIBRATIONS)]
        level = 0 if vibration == "none" else LEVELS[k % len(LEVELS)]
        yield Sequence(f"{part}/{k:02d}", organ, vibration, level, DRIVINGS[k % len(DRIVINGS)], first_seed + k,
                       duration_s, camera, SIZE)


def plan(train: int = 36, calibration: int = 9, held_out: int = 9, seconds: float = 20.0) -> tuple[Sequence, ...]:
    """All recordings of the three parts."""
    return (*sequences("train", train, TRAIN_SEED, seconds),
            *sequences("calibration", calibration, CALIBRATION_SEED, seconds),
            *sequences("held-out", held_out, HELD_OUT_SEED, seconds))


def main() -> None:
    """Render what is missing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--train", type=int, default=36)
    parser.add_argument("--calibration", type=int, default=9)
    parser.add_argument("--held-out", type=int, default=9)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    assert set(VIBRATIONS) == set(KINDS)
    recordings = plan(args.train, args.calibration, args.held_out, args.seconds)
    print(write_dataset(recordings, args.data, args.workers,
                        lambda done, total: print(f"{done} of {total}", flush=True)))


if __name__ == "__main__":
    main()
