"""Your own data: frames with a table of times, an IMU log in your units, a Kalibr calibration, to a refined run.

    python examples/04_own_data.py OUT
"""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np

import fusion
import learned
import vio
from vio.formats.kalibr import write_kalibr
from vio.inspection import format_inspection, inspect_recording
from vio.recording import Recording
from vio.simulation import preset_camera, simulate
from vio.simulation.images import write_rendered


def as_somebody_has_it(recording: Recording, folder: Path) -> None:
    """The layout that docs/formats.md calls "one's own frames": in place of your files."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "frames.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t_ms", "filename"])
        for k, t_ns in enumerate(recording.frame_t_ns):
            cv2.imwrite(str(folder / f"img_{k:04d}.png"), recording.frame(k)[..., ::-1])
            table.writerow([f"{t_ns / 1e6:.6f}", f"img_{k:04d}.png"])
    with (folder / "imu.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["t_ms", *(f"gyro_{a}_deg_s" for a in "xyz"), *(f"accel_{a}_g" for a in "xyz")])
        gyro, accel = np.rad2deg(recording.imu.gyro_rad_s), recording.imu.accel_m_s2 / 9.80665
        table.writerows([f"{t / 1e6:.6f}", *g, *a] for t, g, a in zip(recording.imu.t_ns, gyro, accel, strict=True))
    write_kalibr(recording.calibration, folder / "kalibr")
    for file in (folder / "kalibr").iterdir():
        file.rename(folder / file.name)


out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_04")
simulation = simulate("colon", "gaussian", 1, 8.0, seed=4, driving="operated", camera=preset_camera("fisheye-140", 96))
write_rendered(simulation, out / "simulated")
as_somebody_has_it(vio.open_recording(out / "simulated"), out / "mine")

# The format is recognised by what lies there; what the files do not say and you know comes in as `vio.Declared(...)`.
recording = vio.convert_to_asl(out / "mine", out / "recording")

# Look before you solve: rates, holes, gravity, whether camera and gyro agree, and what to do about it.
print(format_inspection(inspect_recording(recording, pixels=True)))

motions = learned.predict(recording)  # the bundled weights; or vio.odometry.measure_recording(recording), no network
refined = fusion.refine(recording, motions)
print(f"{len(refined.trajectory)} poses by the {refined.estimator}; {refined.scale.policy}: {refined.scale.reason}")
vio.write_tum(refined.trajectory, out / "trajectory.tum")
