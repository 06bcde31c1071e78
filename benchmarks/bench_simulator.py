"""What the simulator's images cost, and how exact they are: time per stage, memory, scaling over processes, geometry.

    python benchmarks/bench_simulator.py

Times are CPU time of one process; the machine's other load does not count, what it does to the caches does.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import resource
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path

import cv2
import numpy as np
from results import record, table

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from oracles.tube_march import march

from vio import se3
from vio.simulation import ORGANS, images, preset_camera, simulate
from vio.simulation.cameras import fisheye, pinhole
from vio.simulation.dataset import Sequence, write_dataset
from vio.simulation.images import write_rendered
from vio.simulation.rendering import renderer as rendering
from vio.simulation.rendering.renderer import Renderer, RenderOptions
from vio.simulation.wall_motion import CAPSULE_RADIUS_M, capsule_axis, rows_between

cv2.setNumThreads(1)
SEEDS = (5, 7, 11)
SHARP = RenderOptions(motion_blur=False, supersampling="none")
STAGES = {"wall as it is": (Renderer, "_scene"), "which point each pixel sees": (rendering._Hits, "look"),
          "shading": (Renderer, "_shaded"), "motion blur": (rendering, "blur"),
          "sensor": (rendering.Sensor, "expose"), "PNG and disk": (images, "write_png")}


def timed_stages() -> dict[str, float]:
    """Wrap the stages so that they add their CPU time to the returned table."""
    spent: dict[str, float] = defaultdict(float)

    def wrap(owner: object, name: str, label: str) -> None:
        call = getattr(owner, name)

        def timed(*args: object, **kwargs: object) -> object:
            start = time.process_time()
            result = call(*args, **kwargs)
            spent[label] += time.process_time() - start
            return result

        setattr(owner, name, timed)

    for label, (owner, name) in STAGES.items():
        wrap(owner, name, label)
    return spent


def cost(spent: dict[str, float]) -> str:
    """Time and memory of whole recordings: 180 frames at 320 × 320 with everything on."""
    rows = []
    for organ in ORGANS:
        with tempfile.TemporaryDirectory() as folder:
            start, before = time.process_time(), dict(spent)
            simulation = simulate(organ, "collision", 3, 60.0, 1)
            ready = time.process_time()
            marks: list[float] = []
            write_rendered(simulation, Path(folder) / "REC", progress=lambda *_, m=marks: m.append(time.process_time()))
            total = time.process_time() - start
        frame_ms = 1e3 * np.diff(marks)
        stages = [f"{1e3 * (spent[label] - before.get(label, 0)) / 180:.1f}" for label in STAGES]
        rows.append([organ, f"{total:.1f}", f"{ready - start:.1f}", f"{1e3 / frame_ms.mean():.1f}",
                     f"{1e3 / np.median(frame_ms):.1f}", *stages])
    header = ["organ", "180 frames, CPU s", "of it motion and IMU", "frames/s mean", "frames/s median",
              *(f"{label} ms" for label in STAGES)]
    return table(header, rows)


def memory() -> str:
    """Peak memory of this process after each stretch of one long recording."""
    simulation = simulate("colon", "none", 0, 400.0, 1, driving="operated")
    renderer, rows = Renderer(simulation), []
    for first in range(0, 1200, 240):
        for k in range(first, first + 240, 6):
            renderer.render(k / 3, k)
        rows.append([f"{first + 240}", f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f}"])
    return table(["frames passed", "peak MiB"], rows)


def scaling() -> str:
    """Wall time of four recordings of the paper's data set in one and in two processes."""
    plan = tuple(Sequence(f"{k}", "small-bowel", "gaussian", 2, "operated", k, 60.0, "mirocam", 320) for k in range(4))
    seconds = []
    for workers in (1, 2):
        folder = Path(tempfile.mkdtemp())
        start = time.perf_counter()
        write_dataset(plan, folder, workers)
        seconds.append(time.perf_counter() - start)
        shutil.rmtree(folder)
    return (f"Four recordings of 180 frames: {seconds[0]:.1f} s in one process, {seconds[1]:.1f} s in two "
            f"(×{seconds[0] / seconds[1]:.2f}).")


def geometry() -> str:
    """Depth against a ray march, and how much of the next frame true geometry explains."""
    rows = []
    for organ in ORGANS:
        error = np.concatenate([march_error_mm(organ, seed, t) for seed in SEEDS for t in (3.0, 11.0)])
        ratios = [warp_ratio(organ, camera, motion) for camera, motion in (
            (fisheye(140, 320), 0.0), (pinhole(110, 320), 0.0), (fisheye(140, 320), 2.0))]
        rows.append([organ, f"{np.median(error):.4f}", f"{np.percentile(error, 99):.4f}",
                     f"{100 * np.mean(error > 1):.3f}", *(f"{right:.3f} ({wrong:.2f})" for right, wrong in ratios)])
    return table(["organ", "depth − ray march, median mm", "p99 mm", "over 1 mm %", "static, fisheye",
                  "static, pinhole", "moving wall with flow, fisheye"], rows)


def clearance() -> str:
    """How deep the capsule is in the wall, over 10,000 frames shaken by collisions of level 5."""
    rows = []
    for organ in ORGANS:
        simulation = simulate(organ, "collision", 5, 1112.0, 21)
        wall, times = simulation.anatomy.wall, simulation.recording.frame_t_s
        poses, arcs = simulation.recording.truth.T_world_body, simulation.motion.nominal.arc_m(times)
        gap_mm = []
        for t, T, arc in zip(times, poses, arcs, strict=True):
            first, last = rows_between(wall, float(arc) - 0.022, float(arc) + 0.022)
            state = simulation.anatomy.motion.state(first, last, float(t), wall.radius_m(first, last).astype(float), T)
            (rear, front), points = capsule_axis(T), state.vertices()
            along = np.clip((points - rear) @ (front - rear) / ((front - rear) @ (front - rear)), 0, 1)
            nearest = np.linalg.norm(points - rear - along[..., None] * (front - rear), axis=-1).min()
            gap_mm.append(1e3 * (nearest - CAPSULE_RADIUS_M))
        rows.append([organ, f"{len(times)}", f"{min(gap_mm):.3f}", f"{100 * np.mean(np.array(gap_mm) < 0.3):.0f}"])
    return table(["organ", "frames", "smallest gap mm", "touching %"], rows)


def march_error_mm(organ: str, seed: int, t: float) -> np.ndarray:
    """Absolute difference per pixel."""
    simulation = simulate(organ, "none", 0, 20.0, seed, camera=fisheye(140, 96))
    renderer = Renderer(simulation, SHARP)
    frame, state = renderer.render(t, 0), renderer.wall_state(t)
    rays = renderer.lens.rays[frame.valid] @ frame.T_world_camera[:3, :3].T
    row = simulation.anatomy.wall.row_at(simulation.motion.nominal.arc_m(np.array([t])))[0]
    expected = march(state, frame.T_world_camera[:3, 3], rays, row)
    return 1e3 * np.abs(expected - frame.distance_m[frame.valid])[np.isfinite(expected)]


def warp_ratio(organ: str, camera: object, wall_motion: float) -> tuple[float, float]:
    """Albedo residual after the true warp over that of the identity, and the same with one depth everywhere."""
    renderer = Renderer(simulate(organ, "none", 0, 30.0, 3, camera=camera, wall_motion=wall_motion, driving="operated"),
                        SHARP)
    sums = np.zeros(3)
    for k in range(4, 84, 10):
        now, after = renderer.render(k / 3, k), renderer.render((k + 1) / 3, k + 1)
        T = se3.inverse(after.T_world_camera) @ now.T_world_camera
        flow = renderer.scene_flow(now, (k + 1) / 3)
        flat = np.full_like(now.distance_m, np.median(now.distance_m[now.valid]))
        points = [(d[..., None] * renderer.lens.rays + f) @ T[:3, :3].T + T[:3, 3]
                  for d, f in ((now.distance_m, flow), (flat, 0))]
        pixels = [np.nan_to_num(renderer.lens.camera.project(p)[0], nan=-1e3).astype(np.float32) for p in points]
        seen = cv2.remap(after.distance_m, pixels[0][..., 0], pixels[0][..., 1], cv2.INTER_LINEAR)
        distance = np.linalg.norm(points[0], axis=-1)
        visible = now.valid & (np.abs(seen - distance) < 0.05 * distance)
        warped = [cv2.remap(after.albedo, p[..., 0], p[..., 1], cv2.INTER_LINEAR) for p in pixels]
        sums += [np.abs(image - now.albedo)[visible].mean() for image in (after.albedo, *warped)]
    return float(sums[1] / sums[0]), float(sums[2] / sums[0])


if __name__ == "__main__":
    warm_up = Renderer(simulate("colon", "collision", 3, 5.0, 1, camera=preset_camera("mirocam")))
    warm_up.render(1.0, 3)  # compiles the kernels, once per installation
    parts = [
        "Recordings of 60 s at 3 frames/s, MiroCam lens, 320 × 320, collisions of level 3, everything on, colour and "
        "depth written as PNG. One process, kernels compiled before.",
        cost(timed_stages()), "Memory along one recording:", memory(), scaling(),
        "Geometry. Depth: six frames each of a 140° fisheye against the ray march of `tests/oracles/tube_march.py`. "
        "Warping: residual of the albedo of frame t + 1 warped to t with true depth, pose and scene flow, over that of "
        "no warp; in brackets the same with one depth for all pixels, which shows that the test can fail.",
        geometry(), "Gap between capsule and wall (a negative one would be an intersection):", clearance(),
    ]
    record("simulator", "The simulator's images: cost and exactness", "\n\n".join(parts))
