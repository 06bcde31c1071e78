"""Small pictures: the right pixels, the right size, and nothing else that was in the file."""

import cv2
import numpy as np
import pytest

from vio.calibration import Calibration
from vio.errors import RecordingError
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.thumbnails import thumbnail


def recording_of(folder, image, name="0.png") -> Recording:
    cv2.imwrite(str(folder / name), image)
    times, calibration = np.zeros(1, np.int64), Calibration(None, np.eye(4))
    return Recording("r", times, ImuSamples.none(), calibration, None, (folder / name,))


def decoded(content: bytes) -> np.ndarray:
    return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize(("height", "width", "expected"), [(2160, 3840, (90, 160)), (64, 64, (64, 64)),
                                                           (900, 30, (160, 5))])
def test_pictures_are_small_and_keep_their_shape_and_colours(tmp_path, height, width, expected):
    image = np.zeros((height, width, 3), np.uint8)
    image[:, : (width + 1) // 2], image[height // 2:, :, 2] = (255, 0, 0), 255
    small = decoded(thumbnail(recording_of(tmp_path, image), 0))
    assert small.shape == (*expected, 3)
    corner = small[1, 0].astype(int)
    assert corner[0] > 200 and corner[2] < 60  # blue above, and red with it below: B and R are not swapped
    assert small[-2, 0, 2] > 200


def test_grey_frames_stay_grey(tmp_path):
    assert decoded(thumbnail(recording_of(tmp_path, np.full((200, 300), 90, np.uint8)), 0)).shape == (107, 160)


def test_what_a_file_says_beside_its_pixels_stays_behind(tmp_path):
    recording = recording_of(tmp_path, np.zeros((32, 32, 3), np.uint8), "0.jpg")
    path = tmp_path / "0.jpg"
    content = path.read_bytes()
    comment = b"\xff\xfe\x00\x0cJANE ROE42"
    path.write_bytes(content[:2] + comment + content[2:])
    assert b"JANE" in path.read_bytes() and b"JANE" not in thumbnail(recording, 0)


def test_a_cut_off_image_is_refused(tmp_path):
    recording = recording_of(tmp_path, np.random.default_rng(0).integers(0, 255, (64, 64, 3), dtype=np.uint8))
    path = tmp_path / "0.png"
    path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(RecordingError, match="frame 0"):
        thumbnail(recording, 0)
