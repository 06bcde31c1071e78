"""Large and lying images: 4K frames work, headers that claim the impossible are refused before memory is asked for."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from vio.calibration import Calibration
from vio.camera import Camera
from vio.errors import RecordingError
from vio.image_files import MAX_PIXELS
from vio.imu import ImuSamples
from vio.recording import Recording
from vio.tracking import track_images

WIDTH, HEIGHT = 3840, 2160


def recording_of(paths: list[Path], camera: Camera | None = None) -> Recording:
    t_ns = np.arange(len(paths), dtype=np.int64) * 333_000_000
    return Recording("r", t_ns, ImuSamples.none(), Calibration(camera), frame_paths=tuple(paths))


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> list[Path]:
    """Two 4K frames, the second moved by 12 pixels."""
    folder = tmp_path_factory.mktemp("large")
    coarse = np.random.default_rng(0).integers(0, 200, (135, 240, 3), dtype=np.uint8)
    image, paths = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC), []
    for k in range(2):
        paths.append(folder / f"{k}.jpg")
        cv2.imwrite(str(paths[-1]), np.roll(image, 12 * k, axis=1))
    return paths


def test_4k_frames_are_read_and_tracked(frames):
    camera = Camera("pinhole", WIDTH, HEIGHT, 2000.0, 2000.0, 1919.5, 1079.5)
    recording = recording_of(frames, camera)
    assert recording.frame(1).shape == (HEIGHT, WIDTH, 3)
    tracks = track_images(recording.frame(k) for k in range(2))
    before, after = (tracks.pixel[tracks.frame == k] for k in range(2))
    _, a, b = np.intersect1d(tracks.track[tracks.frame == 0], tracks.track[tracks.frame == 1], return_indices=True)
    assert len(a) > 100
    np.testing.assert_allclose(np.median(after[b] - before[a], axis=0), [12, 0], atol=0.2)


def test_frames_that_are_not_the_cameras_size_say_so(frames):
    with pytest.raises(RecordingError, match=r"has 3840 x 2160 pixels but the camera 320 x 320; correct"):
        recording_of(frames, Camera("pinhole", 320, 320, 160.0, 160.0, 159.5, 159.5)).frame(0)


def test_a_header_that_claims_the_impossible_is_refused_unread(tmp_path):
    """A hundred bytes that would ask for 30 GB."""
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0)
    bomb = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(bomb)
    with pytest.raises(RecordingError, match=rf"100000 x 100000 pixels \(limit {MAX_PIXELS}\); scale the images down"):
        recording_of([tmp_path / "bomb.png"]).frame(0)


@pytest.mark.parametrize("keep", [0.02, 0.5, 0.99])
@pytest.mark.parametrize("ending", [".png", ".jpg"])
def test_a_file_that_was_cut_off_is_refused_wherever_it_ends(tmp_path, ending, keep):
    path = tmp_path / f"0{ending}"
    cv2.imwrite(str(path), np.random.default_rng(1).integers(0, 255, (80, 80, 3), dtype=np.uint8))
    path.write_bytes(path.read_bytes()[:int(keep * path.stat().st_size)])
    with pytest.raises(RecordingError, match=r"frame 0: .* is cut off; copy the file again"):
        recording_of([path]).frame(0)
