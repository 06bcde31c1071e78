"""What becomes of an examination whose sensors, clock, calibration or motions are broken: refused by name, or told.

    python benchmarks/bench_faults.py --frames 86400 --name faults_86k
    python benchmarks/bench_faults.py --frames 86400 --name faults_86k --only "IMU silent for 60 s"

With `--only`, the other rows of the page stay as they are.
"""

from __future__ import annotations

import argparse
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
from results import RESULTS, record, table

from fusion import Refinement, refine
from fusion.checkpoint import digest
from vio import se3
from vio.errors import VioError
from vio.metrics import ate, nees
from vio.motions import RelativeMotions
from vio.recording import Recording
from vio.sensor_faults import (
    outside_gap,
    with_bias_drift,
    with_bias_step,
    with_clock_jump,
    with_dead_axis,
    with_gap,
    with_swapped_axes,
    with_time_shift,
    without_frames,
)
from vio.simulation import network_like_motions, simulate_recording

FRAME_RATE_HZ = 3.0
SEED = 631
"""Nothing was tuned on it."""
LONG_FRAMES, LONG_SCALE_WALK = 20_000, 0.02
"""Beyond so many frames, the scale drifts by less per square root of 1000 frames than the 0.10 of short ones."""
Case = tuple[Recording, RelativeMotions]
KILLED = "killed at every stage"
GYRO_STEP, ACCEL_STEP = (0.02, -0.01, 0.01), (0.2, -0.1, 0.1)


def imu(change: Callable[..., object], *arguments: object, **options: object) -> Callable[[Case], Case]:
    """A fault of the inertial samples."""
    return lambda case: (replace(case[0], imu=change(case[0].imu, *arguments, **options)), case[1])


def turned(degrees: tuple[float, float, float]) -> Callable[[Case], Case]:
    """A calibration whose camera is turned."""
    def spoil(case: Case) -> Case:
        calibration = case[0].calibration
        T = calibration.T_body_camera @ se3.transform(se3.so3_exp(np.deg2rad(degrees)), np.zeros(3))
        return replace(case[0], calibration=replace(calibration, T_body_camera=T)), case[1]
    return spoil


def upside_down(case: Case) -> Case:
    """The IMU turned about its x axis, the calibration as before."""
    flip, samples = np.diag([1.0, -1.0, -1.0]), case[0].imu
    return replace(case[0], imu=replace(samples, gyro_rad_s=samples.gyro_rad_s @ flip,
                                        accel_m_s2=samples.accel_m_s2 @ flip)), case[1]


def frames_missing(case: Case, start_s: float, duration_s: float) -> Case:
    """Frames that were never recorded, with the motions that touch them."""
    recording, motions = case
    kept = outside_gap(recording.frame_t_s, start_s, duration_s)
    use = np.flatnonzero(kept[:-1] & kept[1:])
    return without_frames(recording, kept), _some(motions, use)


def _some(motions: RelativeMotions, use: np.ndarray) -> RelativeMotions:
    return replace(motions, t_i_s=motions.t_i_s[use], t_j_s=motions.t_j_s[use], T_i_j=motions.T_i_j[use],
                   cov=motions.cov[use])


def standing(case: Case) -> Case:
    """Motions that are all the identity."""
    return case[0], replace(case[1], T_i_j=np.broadcast_to(np.eye(4), case[1].T_i_j.shape).copy())


def shuffled(case: Case) -> Case:
    """Motions in random order."""
    order = np.random.default_rng(0).permutation(len(case[1]))
    return case[0], replace(case[1], T_i_j=case[1].T_i_j[order])


def faults(duration_s: float) -> dict[str, Callable[[Case], Case]]:
    """Every fault by name."""
    half = 0.5 * duration_s
    missing_s = min(600.0, half)
    out: dict[str, Callable[[Case], Case]] = {
        "none": lambda case: case,
        "IMU silent for 60 s": imu(with_gap, half, 60.0),
        f"{missing_s:g} s of frames missing": lambda case: frames_missing(case, 0.3 * duration_s, missing_s),
        "IMU clock jumps by 0.3 s": imu(with_clock_jump, half, 0.3),
        "IMU clock 50 ms off": imu(with_time_shift, 0.05),
        "gyro bias steps by 1.4 deg/s": imu(with_bias_step, half, gyro_rad_s=GYRO_STEP),
        "accelerometer bias steps by 0.24 m/s²": imu(with_bias_step, half, accel_m_s2=ACCEL_STEP),
        "both warm up": imu(with_bias_drift, GYRO_STEP, (0.3, -0.2, 0.2), 300.0),
        "IMU upside down": upside_down,
        "extrinsics 180 degrees wrong": turned((0.0, 0.0, 180.0)),
        "extrinsics 5 degrees wrong": turned((3.0, -4.0, 0.0)),
        "motions all identity": standing,
        "motions in random order": shuffled,
    }
    for sensor, name in (("gyro", "gyro"), ("accel", "accelerometer")):
        out[f"{name} y dead"] = imu(with_dead_axis, sensor, 1)
        out[f"{name} x and z swapped"] = imu(with_swapped_axes, sensor, 0, 2)
    return out


def outcome(case: Case) -> list[str]:
    """Errors in mm, consistency, CPU seconds and what was said; or the refusal."""
    begun = time.process_time()
    try:
        refined = refine(*case)
    except VioError as error:
        return ["–", "–", "–", f"{time.process_time() - begun:.1f}", f"refused, exit code {error.exit_code}: {error}"]
    cpu_s = time.process_time() - begun
    truth = case[0].truth_at_frames()
    errors = [1e3 * ate(estimate, truth).rmse_m for estimate in (refined.motions_only, refined.trajectory)]
    said = [refined.fallback_reason, f"scale {refined.scale.policy}: {refined.scale.reason}",
            refined.camera_imu.reason if refined.camera_imu.applied else None,
            f"{len(refined.imu.gaps)} hole in the IMU" if refined.imu.gaps else None,
            *(change.in_words() for change in (*refined.imu.bias_steps, *refined.imu.bias_wanders))]
    consistency = float(np.nanmean(nees(refined.trajectory, truth)))
    return [*(f"{error:.1f}" for error in errors), f"{consistency:.2f}", f"{cpu_s:.1f}",
            "; ".join(text for text in said if text)]


def resumed(folder: Path) -> None:
    """Refine the pickled case of a folder as far as it comes, saying every stage; keep what was concluded."""
    with (folder / "case.pkl").open("rb") as file:
        case = pickle.load(file)
    refined = refine(*case, announce=lambda stage: print(stage, flush=True), resume=folder / "unfinished")
    _digest(refined, folder)


def _digest(refined: Refinement, folder: Path) -> None:
    arrays = (refined.trajectory.T_world_body, refined.trajectory.cov, refined.velocity_m_s, refined.log_scale,
              refined.log_scale_sd, refined.gyro_bias_rad_s, refined.accel_bias_m_s2, refined.rejected)
    sampled = () if refined.joint is None else (refined.joint.xi, refined.joint.log_scale)
    (folder / "digest").write_text(digest(np.ascontiguousarray(a).tobytes() for a in (*arrays, *sampled)))


def killed(case: Case) -> list[str]:
    """Kill the refinement at the first stage, go on, kill it at the second, and so on: are the bytes the same?"""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with (folder / "case.pkl").open("wb") as file:
            pickle.dump(case, file)
        refined = refine(*case)
        _digest(refined, folder)
        whole = (folder / "digest").read_text()
        (folder / "digest").unlink()
        del refined
        kills = 0
        while _killed_once(folder, kills):
            kills += 1
        same = (folder / "digest").read_text() == whole
    return ["–", "–", "–", "–", f"killed {kills} times, each time one stage later, and resumed each time: "
            + ("the same bytes as uninterrupted" if same else "OTHER BYTES than uninterrupted")]


def _killed_once(folder: Path, after: int) -> bool:
    """Whether the resumed process was still there to be killed at its stage number `after`."""
    command = [sys.executable, __file__, "--resumed", str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for number, _ in enumerate(process.stdout):
            if number == after:
                os.kill(process.pid, signal.SIGKILL)
                break
        process.stdout.read()
        code = process.wait()
    if code not in (0, -signal.SIGKILL):
        raise SystemExit(f"the resumed refinement ended with exit code {code}")
    return code != 0


def _rows_of(name: str) -> dict[str, list[str]]:
    """What a page holds already, by fault."""
    path = RESULTS / f"{name}.md"
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    rows = [line[2:-2].split(" | ") for line in lines if line.startswith("| ")]
    return {row[0]: row[1:] for row in rows if len(row) == len(HEADER) and row != HEADER}


HEADER = ["fault", "motions mm", "refined mm", "pose NEES/dof", "CPU s", "what was said"]


def main() -> None:
    """Break one examination in every way and record one table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=3000)
    parser.add_argument("--name", default="faults")
    parser.add_argument("--only", nargs="+", metavar="FAULT", help="measure these again, keep the page's other rows")
    parser.add_argument("--resumed", type=Path, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.resumed:
        resumed(arguments.resumed)
        return
    duration_s = arguments.frames / FRAME_RATE_HZ
    spoils = faults(duration_s)
    wanted = arguments.only or [*spoils, KILLED]
    unknown = [fault for fault in wanted if fault not in spoils and fault != KILLED]
    if unknown:
        parser.error(f"unknown fault {unknown[0]!r}; known are {', '.join([*spoils, KILLED])}")
    recording = simulate_recording("small-bowel", "gaussian", 3, duration_s, SEED)
    walk = 0.10 if arguments.frames <= LONG_FRAMES else LONG_SCALE_WALK
    network = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, SEED,
                                   scale_walk_per_sqrt_1000_frames=walk)
    case = recording, network.motions
    rows = _rows_of(arguments.name) if arguments.only else {}
    for fault in wanted:
        rows[fault] = killed(case) if fault == KILLED else outcome(spoils[fault](case))
        body = (f"One examination of {arguments.frames} frames, gaussian vibration level 3, seed {SEED}, 2 % outliers, "
                f"scale walk {walk:g} per √1000 frames. ATE after SE3 alignment.\n\n"
                + table(HEADER, [[name, *rows[name]] for name in [*spoils, KILLED] if name in rows]))
        record(arguments.name, "Broken examinations", body)


if __name__ == "__main__":
    main()
