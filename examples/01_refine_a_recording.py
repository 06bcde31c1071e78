"""Refine a recording: motions from any source + IMU → one trajectory with covariance.

    python examples/01_refine_a_recording.py OUT
"""

import sys
from pathlib import Path

import numpy as np

import fusion
import vio
from vio.simulation import network_like_motions, simulate_recording

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_01")

# A recording on disk. Yours would already be there; this one is two simulated minutes of small bowel.
simulated = simulate_recording("small-bowel", "gaussian", level=3, duration_s=120, seed=1)
vio.write_asl(simulated, out / "recording")
recording = vio.open_recording(out / "recording")

# Relative motions of the camera. Yours would come from `vio.load_motions("motions.npz")` or from a network.
motions = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, seed=1).motions

refined = fusion.refine(recording, motions)

end = refined.trajectory
sd_mm = 1e3 * np.sqrt(np.diag(end.cov[-1])[3:].max())
print(f"estimator: {refined.estimator}; scale: {refined.scale.policy}, {refined.scale.reason}")
print(f"last position {np.round(1e3 * end.positions_m[-1], 1)} mm, sd {sd_mm:.1f} mm in the worst direction")
fusion.write_run(refined, out / "run", fusion.Provenance(["example 01"], fusion.RefineConfig(), {}), motions)
print(fusion.format_table(fusion.compare_paths([out / "run"], None)))
