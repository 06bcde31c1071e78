"""Where is the lesion on frame 204, and how sure is that? Lesions along the gut, with 95 % intervals.

    python examples/03_localise_lesions.py OUT
"""

import sys
from pathlib import Path

import fusion
from vio.simulation import network_like_motions, simulate_recording

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_03")

# A refined examination. Yours comes from `capsule-vio refine` and lies in its run folder.
recording = simulate_recording("small-bowel", "peristalsis", level=2, duration_s=120, seed=4, driving="operated")
motions = network_like_motions(recording.truth_at_frames(), recording.calibration.T_body_camera, seed=4).motions
refined = fusion.refine(recording, motions)
fusion.write_run(refined, out / "run", fusion.Provenance(["example 03"], fusion.RefineConfig(), {}), motions)

# What the reader noted: frames (or timestamp_s), optionally pixels u,v. Landmarks give percentages their meaning.
# Kvasir-Capsule's metadata.csv is read as it is. Several rows with one label, close together, are one lesion.
out.joinpath("lesions.csv").write_text("""label,frame,u,v,kind
Pylorus,40,,,landmark
angiectasia,204,120,180,finding
angiectasia,206,131,175,finding
polyp,290,,,finding
Ileocecal valve,350,,,landmark
""", encoding="utf-8")

# With `depth="…"`, the maps that `predict --depth` writes, lesions are placed at the wall they lie on; without, at
# the camera, and every row says so.
found = fusion.locate(out / "run", out / "lesions.csv")
for lesion in found.lesions:
    arc = lesion.arc_m
    print(f"{lesion.label}: {1e3 * arc.value:.0f} mm along the gut [{1e3 * arc.low:.0f}, {1e3 * arc.high:.0f}], "
          f"from {len(lesion.sightings)} sighting(s)")
    if lesion.kind == "finding" and lesion.percent_path is not None:
        path = lesion.percent_path
        print(f"    {path.value:.0f} % [{path.low:.0f}, {path.high:.0f}] of the way from {' to '.join(found.between)}, "
              f"{lesion.percent_time:.0f} % of the time; {1e3 * lesion.from_landmark_m.value:+.0f} mm from "
              f"{lesion.nearest_landmark}")

fusion.write_lesions(found, out / "run")  # lesions.csv and lesions.json, as `capsule-vio locate` writes them
print(f"pictures: capsule-vio report {out / 'run'}")
