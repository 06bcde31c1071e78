"""Train on recordings of your own, calibrate, judge, and use the weights: the whole way, tiny.

    python examples/07_train_on_own_recordings.py [OUT]

Real training takes thousands of steps on dozens of recordings; 6 steps on two show the way and teach nothing.
"""

import sys
from pathlib import Path

import learned
import vio
from learned.calibration import write_calibrated
from learned.methods import method_config
from learned.report import evaluate, format_evaluation
from learned.train_config import train_config
from learned.training import train
from learned.weights import load_weights
from vio.simulation import preset_camera, simulate
from vio.simulation.images import write_rendered


def rendered(folder: Path, seed: int, seconds: float) -> vio.Recording:
    """In place of your own recording: any folder that `vio.open_recording` reads."""
    simulation = simulate("colon", "gaussian", 3, seconds, seed, driving="operated",
                          camera=preset_camera("pinhole-110", 64))
    write_rendered(simulation, folder)
    return vio.open_recording(folder)


def main(out: Path) -> None:
    train_on, calibrate_on = rendered(out / "train", 1, 6.0), rendered(out / "calibrate", 2, 21.0)

    # 1. Every decision has a name and a default; here a small network and few steps.
    method = method_config("gyro-correlation", width=0.125, image_size=(64, 64))
    config = train_config(method, steps=6, batch_size=2, validate_every=6, precision="float32", light_start_steps=2)

    # 2. Train without truth. Stopped and started again, it goes on where it was and ends with the same weights.
    run = train([train_on], config, out / "run")

    # 3. Scale prior and covariances come from recordings with truth that were not trained on.
    card = write_calibrated(run, [train_on], [calibrate_on], out / "weights.safetensors")
    print(f"{run.step} steps; one motion unit is about {1e3 * 2.718 ** card['scale_log_mean']:.0f} mm")

    # 4. Judge them beside guesses that need no network, then use them.
    print(format_evaluation(evaluate([calibrate_on], load_weights(out / "weights.safetensors"))))
    motions = learned.predict(train_on, out / "weights.safetensors")
    print(f"{len(motions)} motions of {motions.meta['predictor']['method']}, ready for fusion.refine")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/own_training"))
