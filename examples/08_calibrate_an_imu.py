"""Let an IMU lie still for hours: its noise from the Allan deviation, ready for imu0/sensor.yaml.

    python examples/08_calibrate_an_imu.py OUT [LOG.npz]

LOG.npz holds `counts` (N, 6), gyro and accelerometer of an ADIS16405 at 100 Hz, as in ../shared/data; without one, an
IMU of known noise is simulated, and the two are compared.
"""

import sys
from pathlib import Path

import numpy as np
import yaml

from vio.allan import calibrate_noise
from vio.imu import ImuNoise, ImuSamples

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_08")
log = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("../shared/data/imu_static_adis16405/adis_16405_imu1.npz")

if log.is_file():
    with np.load(log) as data:
        counts = data["counts"]
    gyro_rad_s, accel_m_s2 = np.deg2rad(0.05 * counts[:, :3]), 9.80665 * 0.00333 * counts[:, 3:]
    print(f"{log.name}: {len(counts) / 100 / 3600:.1f} hours")
else:
    known, rng = ImuNoise(gyro_density_rad_s_rthz=6e-4, accel_density_m_s2_rthz=4e-3), np.random.default_rng(8)
    gyro_rad_s = known.gyro_density_rad_s_rthz * 10 * rng.normal(size=(100_000, 3)) + 0.01
    accel_m_s2 = known.accel_density_m_s2_rthz * 10 * rng.normal(size=(100_000, 3)) + [0, 0, 9.81]
    print(f"simulated: gyro {known.gyro_density_rad_s_rthz:.1e}, accelerometer {known.accel_density_m_s2_rthz:.1e}")

t_ns = np.arange(len(gyro_rad_s), dtype=np.int64) * 10_000_000
noise, axes = calibrate_noise(ImuSamples(t_ns, gyro_rad_s, accel_m_s2))

for name, axis in zip(("gyro x", "gyro y", "gyro z", "accel x", "accel y", "accel z"), axes, strict=True):
    lowest = int(np.argmin(axis.deviation))
    print(f"{name}: density {axis.density:.2e}/√Hz, instability {axis.instability:.1e}, walk {axis.walk:.1e}/s/√Hz, "
          f"lowest deviation {axis.deviation[lowest]:.1e} at {axis.tau_s[lowest]:.0f} s")

# What goes into imu0/sensor.yaml. A capsule in a patient is worse off than an IMU on a table: inflate, then inspect.
out.mkdir(parents=True, exist_ok=True)
(out / "sensor.yaml").write_text(yaml.safe_dump({
    "sensor_type": "imu", "rate_hz": round(noise.rate_hz, 3),
    "gyroscope_noise_density": noise.gyro_density_rad_s_rthz,
    "gyroscope_random_walk": noise.gyro_walk_rad_s2_rthz,
    "accelerometer_noise_density": noise.accel_density_m_s2_rthz,
    "accelerometer_random_walk": noise.accel_walk_m_s3_rthz,
}), encoding="utf-8")
print(f"written: {out / 'sensor.yaml'}")
