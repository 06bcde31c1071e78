"""Hand over the motions of your own network: what goes into motions.npz, and what is refused.

    python examples/02_your_own_motions.py OUT
"""

import sys
from pathlib import Path

import numpy as np

import vio
from vio import RelativeMotions, VioError

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_02")

# Ten frames at 3 Hz; the network says: 0.4 units forward (camera z) and a slight turn, every time.
frame_t_s = np.arange(10) / 3
turn_rad = 0.02
T_i_j = np.tile(np.eye(4), (9, 1, 1))
T_i_j[:, :3, :3] = [[np.cos(turn_rad), 0, np.sin(turn_rad)], [0, 1, 0], [-np.sin(turn_rad), 0, np.cos(turn_rad)]]
T_i_j[:, 2, 3] = 0.4

# How sure it is: 6×6, rotation first [rad²], then translation [motion units²], right perturbation of T_i_j.
cov = np.tile(np.diag([0.005**2] * 3 + [0.02**2] * 3), (9, 1, 1))

# How long a unit is: s = ln(metres per unit), here 2 mm give or take 15 %.
motions = RelativeMotions(frame_t_s[:-1], frame_t_s[1:], T_i_j, cov, scale_log_mean=np.log(0.002), scale_log_sd=0.15,
                          meta={"source": "my network"})
motions.save(out / "motions.npz")
print(f"{len(vio.load_motions(out / 'motions.npz'))} motions saved and read back")

try:
    RelativeMotions(frame_t_s[:-1], frame_t_s[1:], 2 * T_i_j, cov, np.log(0.002), 0.15)
except VioError as error:
    print("refused:", error)
