"""Lesions with known places in simulated recordings: the lumen behind a simulated motion, and what a camera sees of it.

Only `true_lumen` knows how the simulator makes its path; everything else works on what it returns.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from vio.simulation import ORGANS, NetworkMotions, Simulation

Array = NDArray[np.float64]

FARTHEST_M = 60e-3


@dataclass(frozen=True)
class Lumen:
    """The course of the gut that a simulated capsule follows."""

    arc_m: Array
    """(L,) arc lengths along the centreline, every half millimetre."""
    points_m: Array
    """(L, 3) in the simulator's world."""
    first_arc_m: float
    """Where the capsule is in the first frame."""
    frame_arc_m: Array
    """(M,) where it is in every frame."""


@dataclass(frozen=True)
class SimulatedLesion:
    """A spot on the wall of the lumen, as one frame shows it."""

    frame: int
    pixel: tuple[float, float]
    depth_m: float
    """z-depth of the spot in that frame."""
    arc_m: float
    """True arc length from the first frame."""
    point_m: Array
    """(3,) in the simulator's world."""


def true_lumen(simulation: Simulation) -> Lumen:
    """The organ's centreline and the capsule's course along it."""
    nominal, centre = simulation.motion.nominal, simulation.anatomy.centreline
    frame_arc = nominal.arc_m(simulation.recording.frame_t_s)
    arc = np.arange(max(frame_arc.min() - 0.1, 0.0), min(frame_arc.max() + 0.1, centre.length_m), 5e-4)
    points = centre.position_m(arc)
    first = nearest_arc(arc, points, simulation.recording.truth.positions_m[0], float(frame_arc[0]), 0.03)
    return Lumen(arc, points, first, frame_arc)


def nearest_arc(arc: Array, points: Array, point: Array, near: float, reach_m: float = 0.08) -> float:
    """Arc length of the place on a line that is nearest to a point, looked for around an arc length."""
    window = np.flatnonzero(np.abs(arc - near) < reach_m)
    return float(arc[window[np.argmin(np.linalg.norm(points[window] - point, axis=1))]])


def draw_lesions(simulation: Simulation, lumen: Lumen, count: int, rng: np.random.Generator) -> list[SimulatedLesion]:
    """Spots on the wall of the travelled path that random frames see at random pixels, spread over the recording."""
    radius = ORGANS[simulation.recording.provenance["organ"]].radius_m
    camera, frames = simulation.recording.calibration.camera, len(simulation.recording)
    low, high = lumen.frame_arc_m.min() + 5e-3, lumen.frame_arc_m.max() - 5e-3
    found: list[SimulatedLesion] = []
    for k in range(200 * count):
        if len(found) == count:
            break
        edges = np.linspace(0, frames, count + 1)
        frame = int(rng.uniform(edges[len(found)], edges[len(found) + 1])) if k % 40 < 30 else int(rng.integers(frames))
        pixel = rng.uniform([60, 60], [camera.width - 60, camera.height - 60])
        spot = see_wall(simulation, lumen, radius, frame, pixel)
        if spot is not None and low < spot.arc_m + lumen.first_arc_m < high:
            found.append(spot)
    return found


def see_wall(simulation: Simulation, lumen: Lumen, radius_m: float, frame: int, pixel: Array) -> SimulatedLesion | None:
    """Follow the ray of a pixel to the wall of a tube around the centreline; None where it ends nowhere near."""
    calibration = simulation.recording.calibration
    T = simulation.recording.truth.T_world_body[frame] @ calibration.T_body_camera
    ray = calibration.camera.unproject(pixel)
    steps = np.arange(0.0, FARTHEST_M, 2.5e-4)
    points = T[:3, 3] + np.outer(steps, T[:3, :3] @ ray)
    window = np.abs(lumen.arc_m - lumen.frame_arc_m[frame]) < 0.1
    off = np.linalg.norm(points[:, None] - lumen.points_m[window][None, ::4], axis=2).min(axis=1)
    if off[0] >= radius_m or not (off >= radius_m).any():
        return None
    hit = int(np.argmax(off >= radius_m))
    arc = nearest_arc(lumen.arc_m, lumen.points_m, points[hit], float(lumen.frame_arc_m[frame]))
    return SimulatedLesion(frame, (float(pixel[0]), float(pixel[1])), float(steps[hit] * ray[2]),
                           arc - lumen.first_arc_m, points[hit])


def sightings_of(simulation: Simulation, lesion: SimulatedLesion, around: int) -> list[SimulatedLesion]:
    """The same spot in the frames around the one it was found in, wherever it lies in the picture."""
    calibration, seen = simulation.recording.calibration, []
    for frame in range(max(lesion.frame - around, 0), min(lesion.frame + around + 1, len(simulation.recording))):
        T = simulation.recording.truth.T_world_body[frame] @ calibration.T_body_camera
        point = T[:3, :3].T @ (lesion.point_m - T[:3, 3])
        pixel, valid = calibration.camera.project(point)
        inside = bool(valid) and 5e-3 < point[2] < FARTHEST_M and bool(calibration.camera.contains(pixel))
        if frame == lesion.frame or inside:
            seen.append(replace(lesion, frame=frame, pixel=(float(pixel[0]), float(pixel[1])), depth_m=float(point[2])))
    return seen


def network_depths(simulation: Simulation, network: NetworkMotions, groups: list[list[SimulatedLesion]],
                   relative_sd: float, rng: np.random.Generator) -> list[tuple[int, tuple[float, float], float]]:
    """(frame, pixel, depth [m] at the prior scale) as a network would report for every sighting of every lesion.

    Half of the variance is shared by all sightings of one lesion.
    """
    log_scale = np.r_[network.true_log_scale, network.true_log_scale[-1]]
    out = []
    for group in groups:
        shared = rng.standard_normal()
        for seen in group:
            error = relative_sd * np.sqrt(0.5) * (shared + rng.standard_normal())
            scale = network.motions.scale_log_mean - log_scale[seen.frame]
            out.append((seen.frame, seen.pixel, float(seen.depth_m * np.exp(scale + error))))
    return out


def write_depth(folder: Path, simulation: Simulation, depths: list[tuple[int, tuple[float, float], float]],
                unit_m: float = 1e-5) -> None:
    """A folder of predicted depth maps that know the depth around the given pixels alone."""
    import cv2
    import yaml

    (folder / "data").mkdir(parents=True)
    camera, stamps = simulation.recording.calibration.camera, simulation.recording.frame_t_ns
    maps = {0: np.zeros((camera.height, camera.width), np.uint16)}
    for frame, (u, v), depth_m in depths:
        counts = maps.setdefault(frame, np.zeros((camera.height, camera.width), np.uint16))
        row, column = round(v), round(u)
        counts[max(row - 2, 0):row + 3, max(column - 2, 0):column + 3] = round(depth_m / unit_m)
    rows = ["#timestamp [ns],filename"]
    for frame in sorted(maps):
        cv2.imwrite(str(folder / "data" / f"{stamps[frame]}.png"), maps[frame])
        rows.append(f"{stamps[frame]},{stamps[frame]}.png")
    (folder / "data.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    sensor = yaml.safe_dump({"sensor_type": "depth", "depth_unit_m": unit_m})
    (folder / "sensor.yaml").write_text(sensor, encoding="utf-8")
    (folder / "prediction.json").write_text(json.dumps({"source": "simulated"}) + "\n", encoding="utf-8")
