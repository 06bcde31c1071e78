"""Writes a simulated examination with its images: the ASL folder of docs/conventions.md, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from vio.atomic import atomic_folder
from vio.errors import SimulationError
from vio.formats.asl import MARKER, write_asl_files, write_image_stream
from vio.formats.asl_images import write_png
from vio.simulation.scenario import Simulation
from vio.simulation.sightings import Sighting, find_sightings, known_marks, write_marks

if TYPE_CHECKING:
    from vio.simulation.rendering.renderer import Frame, Renderer, RenderOptions

DEPTH_UNIT_M = 1e-5
"""One count of a depth image; 65,535 counts reach 0.65 m."""

PRODUCTS = {
    "normals": {"sensor_type": "normals", "encoding": "16-bit RGB: (x, y, z in camera axes + 1) / 2 * 65535"},
    "albedo": {"sensor_type": "albedo", "encoding": "16-bit RGB: linear reflectance * 65535"},
    "mask": {"sensor_type": "mask", "encoding": "8-bit: 255 where the wall is seen"},
    "flow": {"sensor_type": "scene_flow", "encoding": "float32 (H, W, 3): motion of the wall point until the next "
                                                      "frame [m], in this frame's camera axes"},
}
"""What can be written besides colour and depth, and how."""


def write_rendered(simulation: Simulation, out: str | Path, options: RenderOptions | None = None,
                   products: Sequence[str] = (), progress: Callable[[int, int], None] | None = None) -> None:
    """Render every frame of a simulation and write it all as one recording.

    Beside the recording's files: `mav0/cam0/data`, `mav0/depth0`, `mav0/cam0/exposure.csv` (gain of every frame),
    `lesions.csv`, `lesion_sightings.csv`, and one stream `mav0/<product>0` per product. Memory does not grow with the
    number of frames.

    Args:
        simulation: what to render.
        out: the folder; one that exists is replaced only if it is ours.
        options: switches of the image formation.
        products: keys of `PRODUCTS`.
        progress: called with the number of frames done and the number of all.

    Raises:
        SimulationError: numba is missing, an unknown product, or a camera that cannot be rendered.
        OutputError: `out` exists and is not ours, or cannot be written.
    """
    check_can_render()
    unknown = [name for name in products if name not in PRODUCTS]
    if unknown:
        raise SimulationError(f"simulate: unknown product {unknown[0]!r}; choose from {', '.join(PRODUCTS)}")
    from vio.simulation.rendering.renderer import Renderer

    renderer = Renderer(simulation, options)
    recording = simulation.recording
    with atomic_folder(out, MARKER) as folder:
        write_asl_files(recording, folder)
        writer = _FrameWriter(folder, recording.frame_t_ns, products, renderer)
        sightings: list[Sighting] = []
        marks = known_marks(simulation.anatomy)
        t_s = recording.frame_t_s
        for k in range(len(recording)):
            frame = renderer.render(float(t_s[k]), k)
            writer.write(k, frame, float(t_s[min(k + 1, len(t_s) - 1)]))
            sightings += find_sightings(marks, k, float(t_s[k]), frame.row, frame.column, frame.distance_m,
                                        renderer.lens.rays, frame.T_world_camera, simulation.anatomy.organ.radius_m,
                                        simulation.anatomy.wall.length_m)
            if progress is not None:
                progress(k + 1, len(recording))
        writer.finish()
        write_marks(folder, simulation.anatomy, sightings)


def check_can_render() -> None:
    """Raise a SimulationError that names the extra when the renderer's compiler is not installed."""
    if find_spec("numba") is None:
        raise SimulationError("simulate: images need numba, which is not installed; "
                              "pip install 'capsule-vio[sim]', or add --no-images")


class _FrameWriter:
    """Image files of one recording, frame by frame."""

    def __init__(self, folder: Path, t_ns: NDArray[np.int64], products: Sequence[str], renderer: Renderer) -> None:
        mav0 = folder / "mav0"
        self._t_ns, self._renderer, self._products = t_ns, renderer, products
        self._colour = mav0 / "cam0" / "data"
        depth = {"sensor_type": "depth", "depth_unit_m": DEPTH_UNIT_M}
        self._depth = write_image_stream(mav0 / "depth0", t_ns, depth)
        self._extra = {name: write_image_stream(mav0 / f"{name}0", t_ns, PRODUCTS[name],
                                                ".npy" if name == "flow" else ".png") for name in products}
        self._exposure_csv, self._gains = mav0 / "cam0" / "exposure.csv", ["#timestamp [ns],gain"]

    def write(self, k: int, frame: Frame, t_next_s: float) -> None:
        """Write the files of frame k; scene flow leads to the frame at `t_next_s`."""
        stamp = int(self._t_ns[k])
        write_png(self._colour / f"{stamp}.png", frame.rgb[..., ::-1])
        counts = np.minimum(np.round(frame.z_depth_m / np.float32(DEPTH_UNIT_M)), 65535)
        write_png(self._depth / f"{stamp}.png", counts.astype(np.uint16))
        self._gains.append(f"{stamp},{frame.gain:.6g}")
        for name in self._products:
            if name == "flow":
                np.save(self._extra[name] / f"{stamp}.npy", self._renderer.scene_flow(frame, t_next_s))
            else:
                write_png(self._extra[name] / f"{stamp}.png", _encoded(name, frame))

    def finish(self) -> None:
        """Write what is known only at the end."""
        self._exposure_csv.write_text("\n".join(self._gains) + "\n", encoding="utf-8")


def _encoded(product: str, frame: Frame) -> NDArray[np.uint16] | NDArray[np.uint8]:
    """One product as an image, colours in B, G, R order."""
    if product == "normals":
        return np.round((frame.normal[..., ::-1] + 1) * np.float32(32767.5)).astype(np.uint16)
    if product == "albedo":
        return np.round(frame.albedo[..., ::-1] * np.float32(65535)).astype(np.uint16)
    return np.where(frame.valid, 255, 0).astype(np.uint8)
