"""Rendered geometry against an independent ray march, against itself through warping, and against the camera."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("numba", reason="images need the extra 'sim'")

from oracles.tube_march import march

from vio import se3
from vio.camera import Camera
from vio.errors import SimulationError
from vio.simulation import CAMERAS, ORGANS, preset_camera, simulate
from vio.simulation.cameras import fisheye, pinhole
from vio.simulation.rendering.lens import make_lens, project_point
from vio.simulation.rendering.motion_blur import blur
from vio.simulation.rendering.renderer import FIXED_GAIN, Renderer, RenderOptions
from vio.simulation.rendering.sensor import Sensor, SensorSwitches, tone
from vio.simulation.wall_motion import CAPSULE_RADIUS_M, capsule_axis

SHARP = RenderOptions(motion_blur=False, supersampling="none")


def scene(organ, seed=1, camera=None, vibration="none", level=0, duration_s=30.0, **options):
    return simulate(organ, vibration, level, duration_s, seed, camera=camera or fisheye(140, 96), **options)


# ---- geometry --------------------------------------------------------------------------------

@pytest.mark.parametrize(("organ", "limit_mm"), [("colon", 0.010), ("small-bowel", 0.040), ("stomach", 0.050)])
def test_depth_is_that_of_a_ray_march(organ, limit_mm):
    torch.set_num_threads(1)
    errors, lost = [], 0
    for seed, t in ((5, 3.0), (7, 11.0)):
        simulation = scene(organ, seed, fisheye(140, 80))
        renderer = Renderer(simulation, SHARP)
        frame, state = renderer.render(t, 0), renderer.wall_state(t)
        rays = renderer.lens.rays[frame.valid] @ frame.T_world_camera[:3, :3].T
        row = simulation.anatomy.wall.row_at(simulation.motion.nominal.arc_m(np.array([t])))[0]
        expected = march(state, frame.T_world_camera[:3, 3], rays, row)
        found = frame.distance_m[frame.valid].astype(float)
        known = np.isfinite(expected)
        lost += int((~known & (found < 0.11)).sum())
        errors.append(np.abs(expected - found)[known])
    error_mm = 1e3 * np.concatenate(errors)
    assert len(error_mm) > 8000 and lost <= 3
    assert np.median(error_mm) < 0.004
    assert np.percentile(error_mm, 99) <= limit_mm
    assert np.mean(error_mm > 1.0) < 1e-3  # silhouettes


def look_up(renderer, image, points):
    pixels, seen = renderer.lens.camera.project(points)
    u, v = np.moveaxis(np.nan_to_num(pixels, nan=-1e3).astype(np.float32), -1, 0)
    camera = renderer.lens.camera
    inside = seen & (u > 1) & (u < camera.width - 2) & (v > 1) & (v < camera.height - 2)
    return cv2.remap(image, u, v, cv2.INTER_LINEAR), inside


@pytest.mark.parametrize("organ", ORGANS)
@pytest.mark.parametrize(("camera", "wall_motion"), [(fisheye(140, 160), 0.0), (pinhole(110, 160), 0.0),
                                                     (fisheye(140, 160), 2.0)], ids=["fisheye", "pinhole", "moving"])
def test_true_depth_motion_and_flow_explain_the_next_frame(organ, camera, wall_motion):
    renderer = Renderer(scene(organ, 3, camera, wall_motion=wall_motion, driving="operated"), SHARP)
    identity, warped, wrong, apart_m = [], [], [], []
    for k in (4, 20, 52):
        now, after = renderer.render(k / 3, k), renderer.render((k + 1) / 3, k + 1)
        T_after_now = se3.inverse(after.T_world_camera) @ now.T_world_camera
        flow = renderer.scene_flow(now, (k + 1) / 3)
        middle = np.median(now.distance_m[now.valid])
        moved = [(depth[..., None] * renderer.lens.rays + extra) @ T_after_now[:3, :3].T + T_after_now[:3, 3]
                 for depth, extra in ((now.distance_m, flow), (np.full_like(now.distance_m, middle), 0))]
        distance = np.linalg.norm(moved[0], axis=-1)
        seen, inside = look_up(renderer, after.distance_m, moved[0])
        visible = inside & now.valid & (np.abs(seen - distance) < 0.05 * distance)
        assert visible[inside & now.valid].mean() > 0.6
        identity.append(np.abs(now.albedo - after.albedo)[visible].mean())
        warped.append(np.abs(look_up(renderer, after.albedo, moved[0])[0] - now.albedo)[visible].mean())
        wrong.append(np.abs(look_up(renderer, after.albedo, moved[1])[0] - now.albedo)[visible].mean())
        apart_m.append(np.median(np.abs(seen - distance)[visible]))
    assert np.mean(warped) <= 0.15 * np.mean(identity)
    assert np.mean(wrong) > 3 * np.mean(warped)  # a wrong depth is told from the right one
    assert max(apart_m) < 2e-5


def test_a_static_wall_does_not_flow_and_a_moving_one_does():
    still, moving = (Renderer(scene("small-bowel", 2, wall_motion=w), SHARP) for w in (0.0, 1.0))
    frames = [r.render(5.0, 0) for r in (still, moving)]
    far = [f.valid & (f.distance_m > 0.03) for f in frames]  # near the capsule the wall gives way
    assert np.abs(still.scene_flow(frames[0], 5.5)[far[0]]).max() < 1e-9
    assert np.linalg.norm(moving.scene_flow(frames[1], 5.5)[far[1]], axis=-1).max() > 2e-4


@pytest.mark.parametrize("organ", ORGANS)
def test_the_capsule_is_never_in_the_wall(organ):
    simulation = scene(organ, 4, vibration="collision", level=5, duration_s=600.0)
    renderer = Renderer(simulation, SHARP)
    deepest_m = np.inf
    for t in np.linspace(0.5, 599, 120):
        state = renderer.wall_state(float(t))
        rear, front = capsule_axis(simulation.motion.evaluate(np.array([t])).T_world_body[0])
        near = np.flatnonzero(np.linalg.norm(state.centre_m - 0.5 * (rear + front), axis=1) < 0.05)
        row, column = np.meshgrid(np.arange(near[0], near[-1] - 1, 0.5), np.arange(0, 320, 1.0), indexing="ij")
        points = state.points(row.ravel() + state.first_row, column.ravel())
        along = np.clip((points - rear) @ (front - rear) / ((front - rear) @ (front - rear)), 0, 1)
        gap = np.linalg.norm(points - rear - along[:, None] * (front - rear), axis=1) - CAPSULE_RADIUS_M
        deepest_m = min(deepest_m, gap.min())
    assert deepest_m > -0.1e-3


@pytest.mark.parametrize("camera", ["mirocam", "fisheye-156"])
def test_the_wall_has_no_holes(camera):
    for organ in ORGANS:
        renderer = Renderer(scene(organ, 1, preset_camera(camera, 120), "collision", 3, 60.0), SHARP)
        for k in (10, 74, 120):
            frame = renderer.render(k / 3, k)
            assert frame.valid[renderer.lens.sees].mean() > 0.98, (organ, k)
            normals = np.linalg.norm(frame.normal[frame.valid], axis=-1)
            np.testing.assert_allclose(normals, 1, atol=1e-5)
            facing = np.einsum("nc,nc->n", frame.normal[frame.valid], renderer.lens.rays[frame.valid])
            assert np.mean(facing < 0) > 0.97


LENSES = [(camera, make_lens(camera, view_circle=False).numbers) for camera in (
    *CAMERAS.values(), Camera("pinhole", 320, 240, 200, 210, 150, 130, (-0.2, 0.05, 1e-3, -2e-3, 0.01)),
    Camera("equidistant", 320, 240, 120, 125, 150, 130, (0.02, -0.01, 0.003, -0.001)))]


@given(angle=st.floats(0, 1.2), turn=st.floats(0, 6.28), distance=st.floats(1e-3, 0.2))
def test_the_kernels_project_as_the_camera_does(angle, turn, distance):
    point = distance * np.array([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)])
    for camera, numbers in LENSES:
        expected, seen = camera.project(point)
        u, v, known = project_point(*point, numbers)
        if seen:
            assert known
            np.testing.assert_allclose([u, v], expected, atol=1e-8)


# ---- image formation -------------------------------------------------------------------------

def digest(organ="colon"):
    frame = Renderer(scene(organ, 7, vibration="collision", level=4)).render(9.0, 27)
    return hashlib.sha256(frame.rgb.tobytes() + frame.z_depth_m.tobytes() + frame.normal.tobytes()).hexdigest()


def test_the_same_seed_gives_the_same_pixels_in_another_process():
    code = "import test_rendering as t; print(t.digest())"
    environment = os.environ | {"PYTHONHASHSEED": "5", "PYTHONPATH": os.pathsep.join(sys.path)}
    other = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True,
                           cwd=Path(__file__).parent, env=environment)
    assert other.stdout.strip() == digest()


def test_a_frame_does_not_depend_on_what_was_rendered_before():
    simulation = scene("colon", 2)
    first, second = Renderer(simulation), Renderer(simulation)
    for k in range(0, 60, 20):
        second.render(k / 3, k)
    a, b = first.render(20.0, 60), second.render(20.0, 60)
    np.testing.assert_array_equal(a.rgb, b.rgb)
    np.testing.assert_array_equal(a.z_depth_m, b.z_depth_m)


def test_switches_change_what_they_name_and_nothing_of_the_geometry():
    simulation = scene("colon", 7, vibration="collision", level=5)
    quiet = SensorSwitches(auto_exposure=False, vignette=False, glare=False, noise=False)
    base = Renderer(simulation, RenderOptions(motion_blur=False, supersampling="none", sensor=quiet)).render(9.0, 27)
    assert base.gain == FIXED_GAIN
    expected = tone(np.minimum(base.radiance * np.float32(FIXED_GAIN), 4))[base.valid]
    inner = base.valid & (cv2.erode(base.valid.astype(np.uint8), np.ones((7, 7))) > 0)
    np.testing.assert_allclose(base.rgb[inner], expected[inner[base.valid]], atol=0.8)
    for change in ({"specular": False}, {"subsurface": False}, {"relief": False}, {"second_bounce": False},
                   {"supersampling": "full"}, {"supersampling": "edges"}):
        options = {"motion_blur": False, "supersampling": "none", "sensor": quiet} | change
        other = Renderer(simulation, RenderOptions(**options)).render(9.0, 27)
        assert np.abs(other.radiance - base.radiance).max() > 0, change
        np.testing.assert_array_equal(other.z_depth_m, base.z_depth_m)
        np.testing.assert_array_equal(other.albedo, base.albedo)
    dark = Renderer(simulation, RenderOptions(specular=False, motion_blur=False, supersampling="none")).render(9.0, 27)
    assert (dark.radiance <= base.radiance + 1e-9).all()


def test_edges_alone_are_supersampled_as_everywhere():
    simulation = scene("colon", 7)
    none, edges, full = (Renderer(simulation, RenderOptions(motion_blur=False, supersampling=mode)).render(9.0, 27)
                         .radiance for mode in ("none", "edges", "full"))
    changed = (edges != none).any(axis=-1)
    assert 0.002 < changed.mean() < 0.3
    np.testing.assert_allclose(edges[changed], full[changed], rtol=1e-5, atol=1e-9)


def test_blur_follows_the_motion_during_the_exposure():
    lens = make_lens(pinhole(90, 64), view_circle=False)
    image, distance = np.zeros((64, 64, 3), np.float32), np.full((64, 64), 0.01, np.float32)
    image[32, 32] = 1.0
    sub = np.tile(np.eye(4), (15, 1, 1))
    np.testing.assert_array_equal(blur(image, distance, lens, sub), image)
    sub[:, 0, 3] = np.linspace(-1, 1, 15) * 1e-3  # the camera moves right, so the world moves left: along the row
    smeared = blur(image, distance, lens, sub)
    rows, columns = np.nonzero(smeared[..., 0] > 1e-4)
    assert set(rows) == {32} and columns.min() < 30 and columns.max() > 34
    assert smeared.sum() == pytest.approx(image.sum(), rel=0.1)


def test_exposure_reaches_its_target_whatever_the_light():
    camera = fisheye(140, 96)
    sensor = Sensor(camera, SensorSwitches(vignette=False, glare=False, noise=False), np.ones((96, 96), bool))
    light = np.random.default_rng(0).uniform(0.5, 1.5, (96, 96, 3)).astype(np.float32)
    for scale in (1e-6, 1.0, 1e4):
        gain = sensor.gain(light * np.float32(scale))
        assert gain * scale * light.mean() == pytest.approx(0.2, rel=0.05)
    assert sensor.gain(np.zeros((96, 96, 3), np.float32)) == 1.0


# ---- bad input -------------------------------------------------------------------------------

@pytest.mark.parametrize(("make", "words"), [
    (lambda: RenderOptions(supersampling="some"), "supersampling 'some' is unknown"),
    (lambda: RenderOptions(exposure_s=2.0), "exposure_s is 2.0"),
    (lambda: Renderer(scene("colon", camera=fisheye(140, 8))), "8 x 8 pixels; give 16 to 4096"),
    (lambda: preset_camera("eye"), "unknown camera 'eye'; choose one of mirocam"),
    (lambda: preset_camera("mirocam", 0), "image size is 0"),
])
def test_what_cannot_be_rendered_is_refused_in_one_line(make, words):
    with pytest.raises(SimulationError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)
