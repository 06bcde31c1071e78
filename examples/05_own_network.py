"""Hand over the motions of your own network: what goes into motions.npz, what is refused, and the refinement of it.

    python examples/05_own_network.py OUT
"""

import sys
from pathlib import Path

import numpy as np

import fusion
import vio
from vio import RelativeMotions, VioError, se3
from vio.simulation import simulate_recording

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_05")
recording = simulate_recording("small-bowel", "gaussian", level=1, duration_s=60, seed=5)  # yours: vio.open_recording

# In place of your network: the camera's true motion between neighbouring frames, with errors and in a unit of its own.
rng, unit_m = np.random.default_rng(5), 0.002
T_world_camera = recording.truth_at_frames().T_world_body @ recording.calibration.T_body_camera
T_i_j = se3.inverse(T_world_camera[:-1]) @ T_world_camera[1:]
T_i_j[:, :3, 3] /= unit_m
rotation_sd_rad, translation_sd = 0.005, 0.05
T_i_j = T_i_j @ se3.exp(rng.normal(size=(len(T_i_j), 6)) * ([rotation_sd_rad] * 3 + [translation_sd] * 3))

# How sure it is: 6×6, rotation first [rad²], then translation [motion units²], right perturbation of T_i_j.
cov = np.tile(np.diag([rotation_sd_rad**2] * 3 + [translation_sd**2] * 3), (len(T_i_j), 1, 1))

# How long a unit is: s = ln(metres per unit); the network's idea of it is 10 % off, and it says so.
t_s = recording.frame_t_s
motions = RelativeMotions(t_s[:-1], t_s[1:], T_i_j, cov, scale_log_mean=np.log(1.1 * unit_m), scale_log_sd=0.15,
                          meta={"source": "my network"})
motions.save(out / "motions.npz")
print(f"{len(vio.load_motions(out / 'motions.npz'))} motions saved and read back")

try:
    RelativeMotions(t_s[:-1], t_s[1:], 2 * T_i_j, cov, np.log(unit_m), 0.15)
except VioError as error:
    print("refused:", error)

refined = fusion.refine(recording, motions)
estimates = {"my network": refined.motions_only, "refined": refined.trajectory}
print(fusion.format_table(fusion.compare(estimates, refined.truth, [("my network", "refined")])))
