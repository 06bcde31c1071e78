"""Does refinement help? The network's own trajectory and the refined one, side by side, with how sure the answer is.

    python examples/02_compare_with_the_network.py OUT
"""

import sys
from pathlib import Path

import fusion
from vio.simulation import network_like_motions, simulate_recording

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_02")

# Five examinations with truth. Yours would be recordings of a phantom or of another simulator, with motions.npz each.
for seed in range(1, 6):
    recording = simulate_recording("colon", "gaussian", level=2, duration_s=40, seed=seed, driving="operated")
    network = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, seed)
    for estimator in ("graph", "ekf") if seed == 1 else ("graph",):
        config = fusion.RefineConfig(estimator=estimator)
        refined = fusion.refine(recording, network.motions, config)
        fusion.write_run(refined, out / f"{estimator}{seed}", fusion.Provenance(["example 02"], config, {}))

# One recording: the pure learned ATE beside the refined one under EVERY alignment, and whether that is chance.
print(fusion.format_table(fusion.compare_paths([out / "graph1", out / "ekf1"], None)), end="\n\n")

# Several recordings: each by its own truth, and what they say together.
comparison = fusion.compare_paths([out / f"graph{seed}" for seed in range(1, 6)], None)
print(fusion.format_table(comparison))

# TUM files for evo, a table and JSON: `evo_ape tum truth.tum graph1_motions_only.tum -a` gives the column SE3.
print(fusion.write_comparison(comparison, out / "compared"))
