"""Draw the best view of every kind of lesion and landmark: docs/images/lesions.jpg.

    python benchmarks/draw_lesions.py [OUT.jpg]

Examinations are driven through every organ without vibration until each kind has been seen well.
"""

import sys
from pathlib import Path

import cv2
import numpy as np

from vio.simulation import ORGANS, preset_camera, simulate
from vio.simulation.rendering.renderer import Renderer
from vio.simulation.sightings import find_sightings, known_marks

OUT = Path(sys.argv[1] if len(sys.argv) > 1 else Path(__file__).parents[1] / "docs" / "images" / "lesions.jpg")
SIZE, COLUMNS, SEEDS, FEWEST_PIXELS, MOST_SHARE = 220, 4, range(7, 13), 300, 0.25


def views(organ: str, seed: int) -> list[tuple[str, int, np.ndarray]]:
    """Kind, pixels and picture of everything that one examination sees."""
    simulation = simulate(organ, "none", 0, 80.0, seed, camera=preset_camera("fisheye-140", SIZE), driving="brisk")
    renderer, marks, wall = Renderer(simulation), known_marks(simulation.anatomy), simulation.anatomy.wall
    found = []
    for k, t in enumerate(simulation.recording.frame_t_s[::2]):
        frame = renderer.render(float(t), 2 * k)
        for seen in find_sightings(marks, k, float(t), frame.row, frame.column, frame.distance_m, renderer.lens.rays,
                                   frame.T_world_camera, simulation.anatomy.organ.radius_m, wall.length_m):
            found.append((f"{marks[seen.mark].label}, {organ}", seen.pixels, frame.rgb[..., ::-1].copy()))
    return found


best: dict[str, tuple[int, np.ndarray]] = {}
for organ in ORGANS:
    for seed in SEEDS:
        for name, pixels, picture in views(organ, seed):
            if best.get(name, (0, picture))[0] < pixels < MOST_SHARE * SIZE**2:
                best[name] = (pixels, picture)
tiles = []
for name, (pixels, picture) in sorted(best.items()):
    if pixels >= FEWEST_PIXELS:
        cv2.putText(picture, name, (6, SIZE - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)
        tiles.append(picture)
tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % COLUMNS)
sheet = np.vstack([np.hstack(tiles[k: k + COLUMNS]) for k in range(0, len(tiles), COLUMNS)])
cv2.imwrite(str(OUT), sheet, [cv2.IMWRITE_JPEG_QUALITY, 85])
print(f"{OUT.name}: {len(best)} kinds, {sheet.shape[1]} x {sheet.shape[0]} pixels")
