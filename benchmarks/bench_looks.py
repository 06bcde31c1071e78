"""How far simulated frames are from real and other simulated endoscopy in simple image statistics.

    python benchmarks/bench_looks.py      # needs ../shared/data

Every image is reduced to its lit part at about 320 pixels across. Distances are between distributions pooled over
frames: earth mover's distance of brightness (0 to 1), and of log gradient magnitude; shares are of pixels.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from results import record, table
from scipy.stats import wasserstein_distance

from vio.simulation import ORGANS, preset_camera, simulate
from vio.simulation.rendering.renderer import Renderer

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
SIZE = 320


def real() -> Iterator[tuple[str, list[np.ndarray]]]:
    """Name and colour images (H, W, 3), 0 to 1, of every set of frames there is."""
    sinus = sorted(DATA.glob("sinus_endoscopy_jhu/*/0*.jpg"))[::3]
    yield "sinus endoscopy (real)", [read(file) for file in sinus]
    unity = sorted((DATA / "endoslam_unitycam_stomach" / "frames").glob("*.png"))[::12]
    yield "UnityCam stomach (VR-Caps)", [read(file) for file in unity]
    yield "SimCol3D colon (simulated)", [read(file) for file in sorted(DATA.glob("simcol3d_sample/Frame*.png"))]


def ours() -> Iterator[tuple[str, list[np.ndarray]]]:
    """The same of simulated organs, several patients each."""
    for organ in ORGANS:
        images = []
        for seed in (11, 12, 13):
            simulation = simulate(organ, "gaussian", 2, 60.0, seed, camera=preset_camera("fisheye-140", SIZE))
            renderer = Renderer(simulation)
            images += [renderer.render(k / 3, k).rgb / 255.0 for k in range(10, 180, 24)]
        yield organ, images


def read(file: Path) -> np.ndarray:
    """RGB at about 320 pixels across."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., :3]
    image = image.astype(np.float64) / (65535 if image.dtype == np.uint16 else 255)
    scale = SIZE / min(image.shape[:2])
    return cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[..., ::-1]


def statistics(images: list[np.ndarray]) -> dict[str, np.ndarray | float]:
    """Distributions and shares over the lit parts of all images."""
    brightness, gradient, colour, bright, dark = [], [], [], [], []
    for image in images:
        grey = image.mean(axis=-1)
        lit = cv2.erode((cv2.GaussianBlur(grey, (0, 0), 6) > 0.02).astype(np.uint8), np.ones((9, 9))) > 0
        slope = np.hypot(*(cv2.Sobel(grey, cv2.CV_64F, *order, ksize=3) / 8 for order in ((1, 0), (0, 1))))
        brightness.append(grey[lit])
        gradient.append(np.log10(slope[lit] + 1e-4))
        colour.append((image / (image.sum(axis=-1, keepdims=True) + 1e-6))[lit].mean(axis=0))
        bright.append(np.mean(grey[lit] > 0.95))
        dark.append(np.mean(grey[lit] < 0.1))
    return {"brightness": np.concatenate(brightness), "gradient": np.concatenate(gradient),
            "colour": np.mean(colour, axis=0), "saturated": 100 * float(np.mean(bright)),
            "dark": 100 * float(np.mean(dark))}


def describe(name: str, found: dict, references: dict[str, dict]) -> list[str]:
    """One row: own figures, then distances to every reference."""
    red, green, blue = found["colour"]
    distances = [f"{wasserstein_distance(found['brightness'][::7], other['brightness'][::7]):.3f} / "
                 f"{wasserstein_distance(found['gradient'][::7], other['gradient'][::7]):.2f}"
                 for other in references.values()]
    return [name, f"{found['brightness'].mean():.2f} ± {found['brightness'].std():.2f}",
            f"{10 ** np.median(found['gradient']):.4f}", f"{found['saturated']:.2f}", f"{found['dark']:.1f}",
            f"{red:.2f} {green:.2f} {blue:.2f}", *distances]


if __name__ == "__main__":
    references = {name: statistics(images) for name, images in real()}
    simulated = {name: statistics(images) for name, images in ours()}
    header = ["frames", "brightness", "median gradient", "saturated %", "dark %", "R G B share",
              *(f"to {name}: brightness / gradient" for name in references)]
    rows = [describe(name, found, references) for name, found in (references | simulated).items()]
    record("looks", "Looks: image statistics beside other endoscopy",
           "Earth mover's distances of brightness (0 to 1) and of log10 gradient magnitude (per pixel at 320 pixels "
           "across). None of the references is a capsule in a living gut: the only real one is a sinus under a strong "
           "lamp, the others are simulators. So the distance between references is the yardstick.\n\n"
           + table(header, rows))
