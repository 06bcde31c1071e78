"""Lesions through the whole pipeline: rendered frames, the bundled network's motions and depth, the graph, `locate`.

    python benchmarks/bench_lesions.py --rendered
    python benchmarks/bench_lesions.py --rendered --seeds 731 732 --duration 60

Spots are pixels of rendered frames. Where they lie is known from the rendered depth; what `locate` is told is the
pixel, and the depth is the network's. The simulator's own marks (polyps, ulcers, bleedings) are among them.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from bench_lesions import ARC_HEADER, AROUND, CHI2_3_95, Row, arc_cells, by_id, held, judge, motions_alone, values
from results import record, table
from simulated_lesions import Lumen, SimulatedLesion, nearest_arc, true_lumen

import learned
import vio
from fusion import Sighting, locate, refine
from vio import se3
from vio.consistency import fix_gauge
from vio.metrics import accuracy_table
from vio.recording import Recording
from vio.simulation import Simulation, preset_camera, simulate
from vio.simulation.images import write_rendered

SEEDS = tuple(range(731, 736))
"""No network was trained or calibrated on them, and no constant was chosen on them."""
SCENES = (("gaussian", 1), ("peristalsis", 3), ("collision", 5), ("gaussian", 3), ("none", 0))
CAMERAS, SIZE = ("fisheye-140", "mirocam"), 160
SPOTS, MARGIN_PX = 8, 20
NEAR_M, FAR_M = 5e-3, 60e-3
SAME_DEPTH = 0.08
"""A spot is seen in a neighbouring frame where the rendered depth at its pixel is its own, to so much."""


def run_rendered(job: tuple[str, str, int, int, str, float], weights: Path | None = None
                 ) -> tuple[list[Row], tuple[float, float]]:
    """Render one recording, measure it with a network (None = the bundled one), refine, and place its spots and marks.

    Returns:
        The rows, and error and claimed standard deviation of the refined scale, both as shares.
    """
    organ, kind, level, seed, camera, duration_s = job
    simulation = simulate(organ, kind, level, duration_s, seed, driving="operated", camera=preset_camera(camera, SIZE))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_rendered(simulation, folder / "REC")
        recording = vio.open_recording(folder / "REC")
        motions = learned.predict(recording, weights, depth_dir=folder / "DEPTH")
        lumen = true_lumen(simulation)
        spots = draw_spots(recording, lumen, np.random.default_rng(seed)) + marks_of(folder / "REC", recording, lumen)
        rows = [row for k, spot in enumerate(spots) for row in seen_around(recording, spot, k)]
        refined = refine(recording, motions)
        found = by_id(locate(refined, rows, depth=folder / "DEPTH", recording=recording))
        alone = by_id(locate(motions_alone(refined, recording, motions), rows, depth=folder / "DEPTH",
                             recording=recording))
    names = (kind, level, organ)
    judgements = [judged(simulation, recording, lumen, spot, found[str(k)], alone[str(k)], refined, names)
                  for k, spot in enumerate(spots) if str(k) in found and str(k) in alone]
    scale_error = accuracy_table(refined.trajectory, refined.truth)["scale_error"]
    return judgements, (float(scale_error), refined.scale.log_sd)


def judged(simulation: Simulation, recording: Recording, lumen: Lumen, spot: SimulatedLesion, row, other, refined,
           names: tuple[str, int, str]) -> Row:
    """One spot's errors; what this benchmark does not measure is NaN."""
    kind, level, organ = names
    truth, nan = recording.truth, float("nan")
    gauge = fix_gauge(refined.trajectory, truth).T_world_body[0] @ se3.inverse(truth.T_world_body[0])
    off = row.point_m - (gauge[:3, :3] @ spot.point_m + gauge[:3, 3])
    inside = float(off @ np.linalg.solve(row.cov_m2, off) <= CHI2_3_95)
    path, track = 1e3 * np.ptp(lumen.frame_arc_m), 1e3 * truth.path_length_m
    return Row(f"{kind} {level}", organ, "operated", path, track, *judge(row.arc_m, 1e3, spot.arc_m, True),
               *[nan] * 4, 1e3 * float(np.linalg.norm(off)), nan, inside, nan, nan,
               *judge(other.arc_m, 1e3, spot.arc_m, True))


def at_pixel(recording: Recording, lumen: Lumen, frame: int, pixel: tuple[float, float]) -> SimulatedLesion | None:
    """The place on the wall that a frame shows at a pixel; None where it shows none, or one too near or far."""
    depth = recording.depth_m(frame)
    depth_m = float(depth[round(pixel[1]), round(pixel[0])])
    ray = recording.calibration.camera.unproject(np.array(pixel))
    if not (NEAR_M < depth_m < FAR_M and ray[2] > 0.2):
        return None
    T = truth_camera(recording, frame)
    point = T[:3, :3] @ (ray / ray[2] * depth_m) + T[:3, 3]
    arc = nearest_arc(lumen.arc_m, lumen.points_m, point, float(lumen.frame_arc_m[frame]))
    return SimulatedLesion(frame, pixel, depth_m, arc - lumen.first_arc_m, point)


def truth_camera(recording: Recording, frame: int) -> np.ndarray:
    """(4, 4) true pose of the camera at a frame."""
    at = recording.truth.interpolate(recording.frame_t_s[frame:frame + 1]).T_world_body[0]
    return at @ recording.calibration.T_body_camera


def draw_spots(recording: Recording, lumen: Lumen, rng: np.random.Generator) -> list[SimulatedLesion]:
    """Random pixels of frames spread over the recording, on the part of the gut that was travelled."""
    low, high = lumen.frame_arc_m.min() + 5e-3, lumen.frame_arc_m.max() - 5e-3
    found: list[SimulatedLesion] = []
    edges = np.linspace(0, len(recording), SPOTS + 1)
    for k in range(60 * SPOTS):
        if len(found) == SPOTS:
            break
        span = edges[len(found):len(found) + 2] if k % 60 < 50 else (0, len(recording))
        frame = int(rng.uniform(*span))
        u, v = rng.integers(MARGIN_PX, SIZE - MARGIN_PX, 2).tolist()
        spot = at_pixel(recording, lumen, frame, (float(u), float(v)))
        if spot is not None and low < spot.arc_m + lumen.first_arc_m < high:
            found.append(spot)
    return found


def marks_of(folder: Path, recording: Recording, lumen: Lumen) -> list[SimulatedLesion]:
    """The simulator's own lesions where they are seen best, if the capsule passes them."""
    low, high = lumen.frame_arc_m.min() + 5e-3, lumen.frame_arc_m.max() - 5e-3
    with (folder / "lesions.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] == "finding"]
    spots = [at_pixel(recording, lumen, int(row["best_frame"]), (float(row["best_u"]), float(row["best_v"])))
             for row in rows]
    return [spot for spot in spots if spot is not None and low < spot.arc_m + lumen.first_arc_m < high]


def seen_around(recording: Recording, spot: SimulatedLesion, number: int) -> list[Sighting]:
    """What a reader would note: the frame it was found in, and its neighbours that show it too."""
    camera, rows = recording.calibration.camera, []
    for frame in range(max(spot.frame - AROUND, 0), min(spot.frame + AROUND + 1, len(recording))):
        T = truth_camera(recording, frame)
        point = T[:3, :3].T @ (spot.point_m - T[:3, 3])
        pixel, valid = camera.project(point)
        inside = bool(valid) and point[2] > NEAR_M and bool(camera.contains(pixel))
        if frame != spot.frame and not (inside and shows(recording.depth_m, frame, pixel, float(point[2]))):
            continue
        u, v = spot.pixel if frame == spot.frame else (float(pixel[0]), float(pixel[1]))
        rows.append(Sighting(f"spot {number}", "finding", frame, None, (u, v), "", id=str(number)))
    return rows


def shows(depth_of: Callable[[int], np.ndarray], frame: int, pixel: np.ndarray, depth_m: float) -> bool:
    """Whether the wall at a pixel is as far as it should be, and nothing stands before it."""
    there = float(depth_of(frame)[round(float(pixel[1])), round(float(pixel[0]))])
    return there > 0 and abs(there / depth_m - 1) < SAME_DEPTH


TEXT = """{duration:g} s at 3 Hz per recording, {seeds} seeds ({first}-{last}) that nothing was trained on, in
colon and small bowel, driven ("operated"), rendered at {size} x {size} pixels through two cameras, with vibrations
from none to collisions of level 5. Motions and depth are those of the bundled network; pixels are exact, truth comes
from the rendered depth. Each lesion is a random spot of the wall or one of the simulator's marks, noted in up to five
neighbouring frames. "Motions alone" is the learned trajectory without IMU: the chain of the same motions at their prior
scale, with the network's own covariances and the same depth. Intervals are at 95 %.

{arcs}

In space the refined places are {space:.1f} mm off in the median, and {ellipsoid} % lie in their 95 % ellipsoid. Refined
is nearer along the gut than motions alone for {better:.0f} % of the lesions. Errors within one recording are
correlated: {recordings} recordings are few.

{judgement}

The refined scale is {scale:.0f} % off in the median (worst {scale_worst:.0f} %) where it claims a standard
deviation of {claimed:.0f} %, and arc length is proportional to scale."""
AIM = (90.0, 99.0)


def judgement(rows: list[Row]) -> str:
    """Whether the intervals hold what was aimed at, plainly."""
    share = 100 * float(values(rows, "inside").mean())
    text = f"Aimed at: the 95 % intervals hold the truth for {AIM[0]:.0f} to {AIM[1]:.0f} % of the lesions"
    if AIM[0] <= share <= AIM[1]:
        return f"{text}; they do, for {share:.1f} %."
    return f"{text}; **missed**: they do for {share:.1f} %."


def main_rendered(arguments: argparse.Namespace) -> None:
    """Run the recordings one after the other and record one table."""
    seeds = arguments.seeds or list(SEEDS)
    jobs = [(organ, *SCENES[k % len(SCENES)], seed, CAMERAS[(k + j) % 2], arguments.duration or 120.0)
            for k, seed in enumerate(seeds) for j, organ in enumerate(("small-bowel", "colon"))]
    rows: list[Row] = []
    scales = []
    for job in jobs:
        found, scale = run_rendered(job, arguments.weights)
        print(job, len(found), np.round(values(found, "error"), 1).tolist(), held(found, "inside"), scale, flush=True)
        rows += found
        scales.append(scale)
    off, claimed = 100 * np.abs(np.array(scales)).T
    groups = [[replace(row, scene="all") for row in rows if organ in ("both", row.organ)]
              for organ in ("small-bowel", "colon", "both")]
    groups[2] = [replace(row, organ="both") for row in groups[2]]
    both = [row for row in rows if np.isfinite(row.error) and np.isfinite(row.motions_error)]
    body = TEXT.format(
        duration=jobs[0][-1], seeds=len(seeds), first=min(seeds), last=max(seeds), size=SIZE, recordings=len(jobs),
        arcs=table(ARC_HEADER, [arc_cells(group) for group in groups if group]),
        space=np.median(values(rows, "space_error")), ellipsoid=held(rows, "space_inside"),
        judgement=judgement(rows), scale=np.median(off), scale_worst=off.max(), claimed=np.median(claimed),
        better=100 * np.mean([abs(row.error) < abs(row.motions_error) for row in both]))
    name = "lesions_rendered" if arguments.name == "lesions" else arguments.name
    record(name, "Lesions along the gut, from rendered frames through the bundled network", body)
