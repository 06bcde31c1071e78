"""A live capsule: samples and frames go in as they arrive, a pose comes out of each; then the same as one call.

    python examples/06_online_mode.py OUT
"""

import sys
from pathlib import Path

import numpy as np

import fusion
from vio.simulation import network_like_motions, simulate_recording

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_06")

# What would come over the radio: two simulated minutes of small bowel, and what a network sees in it.
recording = simulate_recording("small-bowel", "gaussian", level=3, duration_s=120, seed=6)
motions = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, seed=6).motions

estimator = fusion.OnlineEstimator(recording.calibration.imu_noise, recording.calibration.T_body_camera,
                                   motions.scale_log_mean, lag_s=30.0)
imu, fed = recording.imu, 0
for k, t in enumerate(recording.frame_t_s):
    arrived = int(np.searchsorted(recording.imu_t_s, t, side="right"))
    estimator.add_imu(recording.imu_t_s[fed:arrived], imu.gyro_rad_s[fed:arrived], imu.accel_m_s2[fed:arrived])
    fed = arrived
    seen = [] if k == 0 else [fusion.OnlineMotion(k - 1, motions.T_i_j[k - 1], motions.cov[k - 1])]
    answer = estimator.add_frame(t, seen)
    estimator.between_frames()  # there is a third of a second until the next one
    if answer is not None and k % 60 == 0:
        sd_mm = 1e3 * np.sqrt(np.diag(answer.newest.cov)[3:].max())
        position_mm = np.round(1e3 * answer.newest.T_world_body[:3, 3], 1)
        print(f"frame {k}: at {position_mm} mm, sd {sd_mm:.1f} mm beside the scale's, {1e3 * answer.latency_s:.1f} ms")

# The same on a whole recording, with the run folder that `capsule-vio refine --online --lag 30` writes.
refined = fusion.online_refine(recording, motions, lag_s=30.0)
provenance = fusion.Provenance(["example 06"], fusion.RefineConfig(), {})
accuracy = fusion.write_run(refined, out / "run", provenance, motions)["accuracy"]
for name in ("motions", "filtered", "refined"):
    print(f"{name}: ATE {1e3 * accuracy[name]['se3']['ate_rmse_m']:.1f} mm")
print(f"latency: {refined.online.latency_ms}")
