"""One frame of a simulated examination: what the camera sees at an instant, with exact geometry.

`Renderer.render` reads as the table of contents: wall as it is → which wall point each pixel sees → shading → motion
blur → sensor. Geometry (depth, normals, scene flow) always comes from one ray through every pixel's centre; colour may
be averaged over several.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.camera import Camera
from vio.errors import SimulationError
from vio.simulation.rendering.lens import Lens, make_lens
from vio.simulation.rendering.motion_blur import MOST_POSES, blur
from vio.simulation.rendering.rasteriser import CELL_COLUMNS, MISS, project_vertices, rasterise, wall_vertices
from vio.simulation.rendering.sensor import Sensor, SensorSwitches
from vio.simulation.rendering.shading import Switches, shade
from vio.simulation.rendering.textures import MARGIN_M, Textures
from vio.simulation.scenario import Simulation
from vio.simulation.wall import ROW_M
from vio.simulation.wall_motion import WallState, rows_between

Array = NDArray[np.float64]
Field = NDArray[np.float32]
Bools = NDArray[np.bool_]
Supersampling = Literal["none", "edges", "full"]

LEDS_M = np.array([[3.5, 0, -0.5], [-3.5, 0, -0.5], [0, 3.5, -0.5], [0, -3.5, -0.5]]) * 1e-3
"""Positions of the light sources in camera axes."""
FIXED_GAIN = 160.0
"""Exposure when auto-exposure is off: right for a wall about 12 mm away."""

SMALLEST, LARGEST = 16, 4096
_BEHIND_RADII = 1.5  # rows whose centre is this many radii behind the lens cannot be seen by it
_TURN_HIDES_RAD = 2.3  # a lumen that has bent this far is hidden by its own wall
_EDGE_STEP = 0.04  # relative depth step between neighbours that makes an edge
_MARGIN_ROWS = 3


@dataclass(frozen=True)
class RenderOptions:
    """Switches of the image formation; everything on is how a real capsule sees."""

    specular: bool = True
    subsurface: bool = True
    relief: bool = True
    """Slopes of tissue and film that tilt the normals."""
    second_bounce: bool = True
    motion_blur: bool = True
    exposure_s: float = 0.020
    sensor: SensorSwitches = field(default_factory=SensorSwitches)
    supersampling: Supersampling = "edges"
    """Colour from four rays per pixel: nowhere, where depth jumps, or everywhere."""
    view_circle: bool | None = None
    """Whether only the largest circle of the image is lit; None = for a fisheye."""

    def __post_init__(self) -> None:
        if self.supersampling not in ("none", "edges", "full"):
            raise SimulationError(f"render: supersampling {self.supersampling!r} is unknown; use none, edges or full")
        if not 0 <= self.exposure_s <= 1:
            raise SimulationError(f"render: exposure_s is {self.exposure_s}; give seconds from 0 to 1")


@dataclass(frozen=True)
class Frame:
    """One rendered frame; arrays are (H, W, ...), lengths in metres, directions in camera axes."""

    t_s: float
    rgb: NDArray[np.uint8]
    radiance: Field
    """Linear R, G, B before exposure."""
    gain: float
    """Exposure that was applied to the radiance."""
    z_depth_m: Field
    """Along the optical axis; 0 where nothing is known."""
    distance_m: Field
    """Along the ray; 0 where nothing is known."""
    normal: Field
    albedo: Field
    valid: Bools
    """Where the wall is seen through the lens."""
    row: Field
    column: Field
    """Material address of the wall point that is seen, in rows and columns of the wall."""
    T_world_camera: Array


@dataclass(frozen=True)
class _Scene:
    """The wall around the camera at one instant, ready for the kernels."""

    state: WallState
    maps: Field
    vertices: Array
    pixel: Field
    """(k, m, 2) where the vertices are seen."""
    seen: Bools
    centre_step: Array
    across: Array
    across_step: Array


class Renderer:
    """Renders the frames of one simulated examination.

    Args:
        simulation: anatomy, motion, camera and where it sits.
        options: switches.

    Raises:
        SimulationError: the recording has no camera, or its image is smaller than 16 or larger than 4096 pixels.
    """

    def __init__(self, simulation: Simulation, options: RenderOptions | None = None) -> None:
        self.options = options or RenderOptions()
        self._anatomy, self._motion = simulation.anatomy, simulation.motion
        self._seed = int(simulation.recording.provenance["seed"])
        self._T_body_camera = simulation.recording.calibration.T_body_camera
        camera = check_renderable(simulation.recording.calibration.camera)
        circle = camera.model == "equidistant" if self.options.view_circle is None else self.options.view_circle
        self.lens = make_lens(camera, circle)
        self._hits = _Hits(self.lens, 1)
        self._fine_hits = _Hits(make_lens(camera.resized(2 * camera.width, 2 * camera.height), circle), 2)
        self._sensor = Sensor(camera, self.options.sensor, self.lens.sees)
        self._textures = Textures(self._anatomy)
        self._switches = Switches(self.options.specular, self.options.subsurface, self.options.relief,
                                  self.options.second_bounce)

    def render(self, t_s: float, frame: int, gain: float | None = None) -> Frame:
        """The frame exposed around an instant.

        Args:
            t_s: middle of the exposure, seconds after the first frame.
            frame: its number, which seeds the noise: a frame does not depend on which others were rendered.
            gain: fixed exposure; None = as the options say.
        """
        T_world_body = self._motion.evaluate(np.array([t_s])).T_world_body[0]
        T_world_camera = T_world_body @ self._T_body_camera
        scene = self._scene(t_s, T_world_body, T_world_camera)
        distance, row, column = self._hits.look(scene, self.lens.sees, _all_cells(scene))
        valid = distance < MISS
        radiance, normal, albedo = (part.reshape(*valid.shape, 3) for part in self._shaded(
            scene, self.lens, distance.ravel(), row.ravel(), column.ravel(), self.lens.rays.reshape(-1, 3)))
        distance_m = np.where(valid, distance, 0.0).astype(np.float32)
        radiance = self._supersampled(scene, radiance, distance_m)
        if self.options.motion_blur and self.options.exposure_s > 0:
            radiance = blur(radiance, distance_m, self.lens, self._sub_poses(t_s, T_world_camera))
        if gain is None:
            gain = self._sensor.gain(radiance) if self.options.sensor.auto_exposure else FIXED_GAIN
        rgb = self._sensor.expose(radiance, gain, np.random.default_rng([self._seed, 31, frame]))
        z_depth = np.maximum(distance_m * self.lens.rays[..., 2], 0).astype(np.float32)
        wall_row, wall_column = (np.where(valid, part, 0).astype(np.float32)
                                 for part in (row + scene.state.first_row, column))
        return Frame(t_s, rgb, radiance, gain, z_depth, distance_m, normal, albedo, valid, wall_row, wall_column,
                     T_world_camera)

    def scene_flow(self, frame: Frame, t_next_s: float) -> Field:
        """Motion (H, W, 3) [m] of every visible wall point until another instant, in the frame's camera axes.

        Zero on a wall that does not move, whatever the camera does; zero where nothing is seen.
        """
        row, column = frame.row[frame.valid].astype(float), frame.column[frame.valid].astype(float)
        low, high = int(row.min()) - _MARGIN_ROWS, int(row.max()) + 2 + _MARGIN_ROWS
        low, high = max(low, 0), min(high, self._anatomy.wall.rows)
        points = []
        for t in (frame.t_s, t_next_s):
            pose = self._motion.evaluate(np.array([t])).T_world_body[0]
            radius = self._anatomy.wall.radius_m(low, high).astype(float)
            points.append(self._anatomy.motion.state(low, high, t, radius, pose).points(row, column))
        flow = np.zeros((*frame.valid.shape, 3), np.float32)
        flow[frame.valid] = (points[1] - points[0]) @ frame.T_world_camera[:3, :3]
        return flow

    def wall_state(self, t_s: float) -> WallState:
        """The wall around the capsule at an instant, as the renderer sees it."""
        T_world_body = self._motion.evaluate(np.array([t_s])).T_world_body[0]
        return self._scene(t_s, T_world_body, T_world_body @ self._T_body_camera).state

    def _scene(self, t_s: float, T_world_body: Array, T_world_camera: Array) -> _Scene:
        first, last = self._visible_rows(t_s, T_world_camera)
        maps = self._anatomy.wall.maps(first, last)
        state = self._anatomy.motion.state(first, last, t_s, maps[..., 0].astype(float), T_world_body)
        R, p = np.ascontiguousarray(T_world_camera[:3, :3]), T_world_camera[:3, 3].copy()
        vertices = np.empty((*state.radius_m.shape, 3))
        wall_vertices(state.centre_m, state.across, state.radius_m, R, p, vertices)
        pixel, seen = np.empty((*state.radius_m.shape, 2), np.float32), np.empty(state.radius_m.shape, bool)
        project_vertices(vertices, self.lens.numbers, pixel, seen)
        across = np.ascontiguousarray(state.across @ R)
        return _Scene(state, maps, vertices, pixel, seen, np.gradient(state.centre_m @ R, axis=0), across,
                      np.gradient(across, axis=0))

    def _visible_rows(self, t_s: float, T_world_camera: Array) -> tuple[int, int]:
        """Rows that may be seen: near along the lumen, not behind the lens, not beyond a bend that hides them."""
        arc = float(self._motion.nominal.arc_m(np.array([t_s]))[0])
        view = self._anatomy.organ.view_m
        first, last = rows_between(self._anatomy.wall, arc - view, arc + view)
        arcs = self._anatomy.wall.arc_m[first:last]
        centre = self._anatomy.centreline.position_m(arcs)
        along = self._anatomy.centreline.frame(arcs).as_matrix()[..., 0]
        here = int(np.argmin(np.abs(arcs - arc)))
        ahead = (centre - T_world_camera[:3, 3]) @ T_world_camera[:3, 2]
        shown = ahead > -_BEHIND_RADII * self._anatomy.organ.radius_m
        shown &= along @ along[here] > np.cos(_TURN_HIDES_RAD)
        low, high = here, here
        while low > 0 and (shown[low - 1] or here - low < 60):
            low -= 1
        while high < len(arcs) - 1 and (shown[high + 1] or high - here < 60):
            high += 1
        return first + low, first + max(high + 1, low + 8)

    def _shaded(self, scene: _Scene, lens: Lens, distance: Array, row: Array, column: Array,
                rays: Array) -> tuple[Field, Field, Field]:
        """Radiance, normals and albedo (n, 3) of hits (n,)."""
        organ, first = self._anatomy.organ, scene.state.first_row
        last = first + len(scene.maps)
        window = self._textures.window(first * ROW_M - MARGIN_M, last * ROW_M + MARGIN_M)
        return shade(distance, row, column, rays, float(lens.numbers[12]), first, scene.centre_step, scene.across,
                     scene.across_step, scene.state.radius_m, scene.maps, window.levels, window.slots, window.first_m,
                     organ.radius_m, np.array(organ.look.albedo), LEDS_M, self._switches)

    def _supersampled(self, scene: _Scene, radiance: Field, distance_m: Field) -> Field:
        """Radiance with four rays per pixel where the options ask for it; linear light is averaged."""
        if self.options.supersampling == "none":
            return radiance
        wanted = self.lens.sees if self.options.supersampling == "full" else _depth_edges(distance_m, self.lens.sees)
        fine = cv2.resize(wanted.astype(np.uint8), None, fx=2, fy=2, interpolation=cv2.INTER_NEAREST).astype(bool)
        distance, row, column = self._fine_hits.look(scene, fine, self._hits.cells_around(scene, wanted))
        y, x = np.nonzero(wanted)
        place = (2 * y[:, None] + np.array([0, 0, 1, 1]), 2 * x[:, None] + np.array([0, 1, 0, 1]))
        lens = self._fine_hits.lens
        colour = self._shaded(scene, lens, distance[place].ravel(), row[place].ravel(), column[place].ravel(),
                              lens.rays[place].reshape(-1, 3))[0]
        radiance[wanted] = colour.reshape(-1, 4, 3).mean(axis=1)
        return radiance

    def _sub_poses(self, t_s: float, T_world_camera: Array) -> Array:
        """Camera (n, 4, 4) during the exposure, in the camera at its middle."""
        t = t_s + self.options.exposure_s * (np.arange(MOST_POSES) / (MOST_POSES - 1) - 0.5)
        poses: Array = se3.inverse(T_world_camera) @ self._motion.evaluate(t).T_world_body @ self._T_body_camera
        return poses


def check_renderable(camera: Camera | None) -> Camera:
    """Return the camera if images can be rendered for it.

    Raises:
        SimulationError: there is none, or its image is too small or too large.
    """
    if camera is None:
        raise SimulationError("render: the recording has no camera; give one to simulate")
    if not (SMALLEST <= camera.width <= LARGEST and SMALLEST <= camera.height <= LARGEST):
        raise SimulationError(f"render: the image has {camera.width} x {camera.height} pixels; "
                              f"give {SMALLEST} to {LARGEST} each way")
    return camera


class _Hits:
    """Buffers of what every pixel of one lens sees; they are used again for every frame."""

    def __init__(self, lens: Lens, fine: int) -> None:
        self.lens, self._fine = lens, fine
        self._distance, self._row, self._column = np.full(lens.sees.shape, MISS), *np.zeros((2, *lens.sees.shape))

    def look(self, scene: _Scene, wanted: Bools, cells: Bools) -> tuple[Array, Array, Array]:
        """Distance along the ray (`MISS` where none), row and column (H, W) of what each wanted pixel sees."""
        rasterise(scene.vertices, scene.pixel, scene.seen, cells, self._fine, self.lens.rays, wanted & self.lens.sees,
                  self._distance, self._row, self._column)
        return self._distance, self._row, self._column

    def cells_around(self, scene: _Scene, wanted: Bools) -> Bools:
        """Cells that the wanted pixels and their neighbours saw in the last look, and the cells around those."""
        near = cv2.dilate(wanted.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & (self._distance < MISS)
        cells = np.zeros_like(_all_cells(scene), np.uint8)
        cells[self._row[near].astype(int), self._column[near].astype(int) // CELL_COLUMNS % cells.shape[1]] = 1
        around = cv2.dilate(np.pad(cells, ((0, 0), (1, 1)), mode="wrap"), np.ones((2 * _MARGIN_ROWS + 1, 3), np.uint8))
        return np.ascontiguousarray(around[:, 1:-1] > 0)


def _all_cells(scene: _Scene) -> Bools:
    rows, columns = scene.state.radius_m.shape
    return np.ones((rows, -(-columns // CELL_COLUMNS)), bool)


def _depth_edges(distance_m: Field, sees: Bools) -> Bools:
    """Pixels (H, W) whose depth differs from a neighbour's by more than a smooth wall's would."""
    near = cv2.erode(np.where(distance_m > 0, distance_m, np.float32(1.0)), np.ones((3, 3), np.uint8))
    far = cv2.dilate(distance_m, np.ones((3, 3), np.uint8))
    spread = (far - near) > _EDGE_STEP * 4 * near
    return np.asarray(spread & sees)
