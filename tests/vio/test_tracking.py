"""KLT tracks on images whose motion is known, on real tissue, and on images that hold nothing to track."""

import cv2
import numpy as np
import pytest
import yaml

from vio import se3
from vio.errors import TrackingError
from vio.tracking import TrackerSettings, track_images, usable_mask
from vio.tracks import tracks_from_table


def textured(rng, height=240, width=320):
    coarse = cv2.resize(rng.uniform(40, 200, (height // 8, width // 8)).astype(np.float32), (width, height),
                        interpolation=cv2.INTER_CUBIC)
    return np.clip(coarse, 0, 240).astype(np.uint8)


def shifted(image, dx, dy):
    return cv2.warpAffine(image, np.array([[1, 0, dx], [0, 1, dy]], np.float32), image.shape[::-1],
                          flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)


def steps_of(tracks):
    """Displacement (n, 2) of every observation from the one before it on its track."""
    order = np.lexsort((tracks.frame, tracks.track))
    track, frame, pixel = tracks.track[order], tracks.frame[order], tracks.pixel[order]
    follows = (np.diff(track) == 0) & (np.diff(frame) == 1)
    return np.diff(pixel, axis=0)[follows]


def test_a_shift_is_followed_to_a_fraction_of_a_pixel():
    image = textured(np.random.default_rng(3))
    step = np.array([1.3, -0.8])
    tracks = track_images([shifted(image, *(k * step)) for k in range(6)])
    found = steps_of(tracks)
    assert len(found) > 200
    assert np.abs(np.median(found, axis=0) - step).max() < 0.05
    assert (np.linalg.norm(found - step, axis=1) < 0.3).mean() > 0.95


def test_lost_corners_are_replaced_and_keep_their_distance():
    image = textured(np.random.default_rng(4))
    settings = TrackerSettings(corners=120)
    tracks = track_images([shifted(image, 12 * k, 0) for k in range(10)], settings)
    counts = np.bincount(tracks.frame)
    assert counts.max() <= 120 and counts.min() > 60
    assert tracks.track.max() > 120  # some left the image, others came
    first = tracks.pixel[tracks.frame == 0]
    distance = np.linalg.norm(first[:, None] - first[None], axis=2) + 1e9 * np.eye(len(first))
    assert distance.min() >= settings.spacing_px - 1e-3


def test_no_corner_lies_on_a_highlight_or_in_the_vignette():
    rng = np.random.default_rng(5)
    image = textured(rng)
    rows, columns = np.mgrid[:240, :320]
    image[(rows - 120) ** 2 + (columns - 160) ** 2 > 110**2] = 0
    image[100:120, 150:175] = 255
    tracks = track_images([image, shifted(image, 1, 0)])
    mask = usable_mask(image)
    x, y = np.round(tracks.pixel[tracks.frame == 0]).astype(int).T
    assert (mask[y, x] == 255).all()
    assert np.hypot(x - 160, y - 120).max() < 110 and len(x) > 30
    assert not ((x >= 150) & (x < 175) & (y >= 100) & (y < 120)).any()


def test_a_dark_spot_inside_the_image_is_no_vignette():
    image = np.full((100, 100), 120, np.uint8)
    image[40:60, 40:60] = 0
    assert usable_mask(image)[50, 50] == 255


@pytest.mark.parametrize(("images", "word"), [
    ([np.zeros((60, 80), np.uint8)] * 3, "no texture"), ([np.full((60, 80), 128, np.uint8)] * 3, "no texture"),
    ([np.zeros((60, 80), np.uint8)], "at least 2"), ([], "at least 2"),
    ([np.zeros((60, 80), np.uint8), np.zeros((60, 81), np.uint8)], "one size"),
])
def test_images_without_anything_to_track_are_refused(images, word):
    with pytest.raises(TrackingError, match=word) as error:
        track_images(images)
    assert "\n" not in str(error.value)


def test_a_table_of_tracks_is_checked_and_sorted():
    tracks = tracks_from_table([1, 0, 1], [7, 7, 3], [[1.0, 2], [3, 4], [5, 6]])
    assert tracks.frame.tolist() == [0, 1, 1] and tracks.track.tolist() == [7, 3, 7] and tracks.n_frames == 2
    with pytest.raises(TrackingError, match="seen twice"):
        tracks_from_table([0, 0], [1, 1], [[0.0, 0], [1, 1]])
    with pytest.raises(TrackingError, match="not finite"):
        tracks_from_table([0], [1], [[np.nan, 0]])


def test_real_tissue_agrees_with_its_epipolar_geometry(shared_data):
    """In vivo sinus endoscopy (JHU) with poses from structure from motion, stored as camera → world."""
    folder = next((shared_data / "sinus_endoscopy_jhu").glob("_start_*"))
    first, gap = 16, 4
    names = [f"{4584 + k:08d}.jpg" for k in range(first, first + gap + 1)]
    images = [cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE) for name in names]
    tracks = track_images(images)
    a, b = tracks.frame == 0, tracks.frame == gap
    _, i, j = np.intersect1d(tracks.track[a], tracks.track[b], return_indices=True)
    assert len(i) > 80
    T_a, T_b = (pose_of(folder / "motion.yaml", k) for k in (first, first + gap))
    right = epipolar_px(tracks.pixel[a][i], tracks.pixel[b][j], se3.inverse(T_a) @ T_b)
    wrong = epipolar_px(tracks.pixel[a][i], tracks.pixel[b][j], T_a @ se3.inverse(T_b))
    assert right < 2.0  # measured 1.5; the poses themselves are good to about 1 px
    assert wrong > 2 * right


def epipolar_px(first, second, T_1_2):
    """Median distance of the nearer point from its epipolar line."""
    K = np.array([[677.171, 0, 872.127], [0, 677.171, 471.918], [0, 0, 1]])
    E = se3.skew(T_1_2[:3, 3]) @ T_1_2[:3, :3]
    F = np.linalg.inv(K).T @ E @ np.linalg.inv(K)
    p, q = (np.column_stack([x, np.ones(len(x))]) for x in (first, second))
    line_p, line_q = q @ F.T, p @ F
    return np.median(np.minimum(np.abs((p * line_p).sum(1)) / np.hypot(*line_p[:, :2].T),
                                np.abs((q * line_q).sum(1)) / np.hypot(*line_q[:, :2].T)))


def pose_of(path, k):
    pose = yaml.safe_load(path.read_text())["poses[]"][f"poses[{k}]"]
    R = se3.matrix_from_quat_xyzw([pose["orientation"][axis] for axis in "xyzw"])
    return se3.transform(R, [pose["position"][axis] for axis in "xyz"])
