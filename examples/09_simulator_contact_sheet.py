"""Look at the simulator: colour and depth of every organ on one sheet.

    python examples/09_simulator_contact_sheet.py OUT [SIZE]
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from vio.simulation import ORGANS, preset_camera, simulate
from vio.simulation.rendering.renderer import Frame, Renderer

out = Path(sys.argv[1] if len(sys.argv) > 1 else "out/example_09")
size = int(sys.argv[2]) if len(sys.argv) > 2 else 96
COLUMNS, FARTHEST_M = 6, 0.09


def coloured_depth(frame: Frame) -> np.ndarray:
    """Distance on a logarithmic scale, near is red; black where nothing is seen."""
    share = np.log1p(1e3 * frame.distance_m) / np.log1p(1e3 * FARTHEST_M)
    colour = cv2.applyColorMap((255 * (1 - np.clip(share, 0, 1))).astype(np.uint8), cv2.COLORMAP_TURBO)
    return np.where(frame.valid[..., None], colour, 0)


def rows_of(organ: str, seed: int) -> np.ndarray:
    """One row of frames and one of their depth, in order of time."""
    simulation = simulate(organ, "collision", 3, 60.0, seed, camera=preset_camera("fisheye-140", size))
    renderer = Renderer(simulation)
    frames = [renderer.render(float(simulation.recording.frame_t_s[k]), k)
              for k in np.linspace(5, len(simulation.recording) - 5, COLUMNS).astype(int)]
    seen = [frame.valid[renderer.lens.sees].mean() for frame in frames]
    median_mm = 1e3 * np.median([np.median(frame.distance_m[frame.valid]) for frame in frames])
    print(f"{organ}: {len(simulation.anatomy.wall.lesions)} lesions on {simulation.anatomy.organ.length_m} m, "
          f"median distance {median_mm:.1f} mm, wall seen in {100 * min(seen):.1f} % of the view or more")
    return np.vstack([np.hstack([frame.rgb[..., ::-1] for frame in frames]),
                      np.hstack([coloured_depth(frame) for frame in frames])])


sheet = np.vstack([rows_of(organ, seed=7) for organ in ORGANS])
out.mkdir(parents=True, exist_ok=True)
cv2.imwrite(str(out / "contact_sheet.png"), sheet)
print(f"{out / 'contact_sheet.png'}: {sheet.shape[1]} x {sheet.shape[0]} pixels")
