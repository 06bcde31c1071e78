"""A recording: frames read when asked for, inertial samples, calibration, and truth when there is any."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio.calibration import Calibration, short_name
from vio.errors import RecordingError
from vio.imu import ImuSamples, check_coverage
from vio.trajectory import Trajectory

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

NS = 1e-9
IMAGE_ENDS = {b"\x89PNG": b"IEND\xaeB`\x82", b"\xff\xd8": b"\xff\xd9"}  # how a whole PNG and JPEG start and end


@dataclass(frozen=True)
class TruthState:
    """What truth knows beyond the poses, one row per pose of `Recording.truth`."""

    velocity_m_s: Array
    """(N, 3) of the body in the world."""
    gyro_bias_rad_s: Array
    """(N, 3) in body axes."""
    accel_bias_m_s2: Array
    """(N, 3) in body axes."""

    def __post_init__(self) -> None:
        for name in ("velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2"):
            value = np.asarray(getattr(self, name), float)
            if value.ndim != 2 or value.shape[1] != 3 or not np.isfinite(value).all():
                raise RecordingError(f"truth: {name} must be finite numbers of shape (N, 3), found {value.shape}")
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class Recording:
    """N frames with their inertial samples.

    Raises:
        RecordingError: no frame, frame times that do not increase, or parts of different lengths.
    """

    name: str
    frame_t_ns: NDArray[np.int64]
    """(N,) frame times on the camera's clock."""
    imu: ImuSamples
    calibration: Calibration
    truth: Trajectory | None = None
    """Body in the world; times are seconds after the first frame."""
    frame_paths: tuple[Path | None, ...] = ()
    """Image file of every frame, whether it exists or not; None (or an empty tuple) where none was recorded."""
    depth_paths: tuple[Path | None, ...] = ()
    """16-bit z-depth image of every frame; None (or an empty tuple) where there is none."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where the recording comes from: simulator version, seed, organ, vibration; empty when unknown."""
    depth_unit_m: float = 1e-3
    """Metres per count of the depth images."""
    truth_state: TruthState | None = None
    """Velocity and biases at every pose of `truth`."""

    def __post_init__(self) -> None:
        t = np.asarray(self.frame_t_ns)
        if t.ndim != 1 or t.dtype != np.int64:
            raise RecordingError(f"recording {self.name}: frame_t_ns must be int64 (N,), is {t.dtype} {t.shape}")
        if len(t) == 0:
            raise RecordingError(f"recording {self.name}: no frames; cam0/data.csv must list at least one time")
        if (t[1:] <= t[:-1]).any():
            k = int(np.argmax(t[1:] <= t[:-1])) + 1
            raise RecordingError(f"recording {self.name}: frame {k} at {t[k]} ns does not follow {t[k - 1]} ns; "
                                 "sort the frames and drop duplicates")
        object.__setattr__(self, "frame_t_ns", t)
        for name in ("frame_paths", "depth_paths"):
            paths = tuple(getattr(self, name)) or (None,) * len(t)
            if len(paths) != len(t):
                raise RecordingError(f"recording {self.name}: {len(t)} frames but {len(paths)} {name}")
            object.__setattr__(self, name, paths)
        if not (np.isfinite(self.depth_unit_m) and self.depth_unit_m > 0):
            raise RecordingError(f"recording {self.name}: depth_unit_m is {self.depth_unit_m}, must be positive metres")
        if self.truth_state is not None:
            poses = 0 if self.truth is None else len(self.truth)
            if len(self.truth_state.velocity_m_s) != poses:
                raise RecordingError(f"recording {self.name}: truth has {poses} poses but "
                                     f"{len(self.truth_state.velocity_m_s)} velocities")

    def __len__(self) -> int:
        return len(self.frame_t_ns)

    @property
    def frame_t_s(self) -> Array:
        """(N,) seconds after the first frame."""
        return np.asarray((self.frame_t_ns - self.frame_t_ns[0]) * NS)

    @property
    def imu_t_s(self) -> Array:
        """(N_imu,) stamps of the inertial samples on the frames' clock, seconds after the first frame."""
        return np.asarray((self.imu.t_ns - self.frame_t_ns[0]) * NS - self.calibration.time_offset_s)

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return float(self.frame_t_s[-1])

    @property
    def has_images(self) -> bool:
        """Whether the image file of every frame exists."""
        return all(path is not None and path.is_file() for path in self.frame_paths)

    @property
    def has_depth(self) -> bool:
        """Whether the depth image of at least one frame exists."""
        return any(path is not None and path.is_file() for path in self.depth_paths)

    def frame(self, k: int) -> Image:
        """Image of frame k as stored: grey (H, W) or colour (H, W, 3) in R, G, B order.

        Raises:
            RecordingError: no such frame, its file is absent, cut off or undecodable, or its size is not the camera's.
        """
        path = self.frame_paths[self._index(k)]
        if path is None:
            raise RecordingError(f"frame {k}: this recording lists frame times but no images")
        image = _decode(path, f"frame {k}", depth=False)
        camera = self.calibration.camera
        height, width = image.shape[:2]
        if camera is not None and (width, height) != (camera.width, camera.height):
            raise RecordingError(f"frame {k} ({path.name}) has {width} x {height} pixels but the camera {camera.width} "
                                 f"x {camera.height}; correct `resolution` and `intrinsics` in cam0/sensor.yaml")
        return image[..., ::-1].copy() if image.ndim == 3 else image

    def depth_m(self, k: int) -> NDArray[np.float32] | None:
        """z-depth (H, W) of frame k in metres, 0 where unknown; None when no depth was recorded for the frame.

        Raises:
            RecordingError: no such frame, or its depth file is absent, cut off, undecodable or not 16-bit.
        """
        path = self.depth_paths[self._index(k)]
        if path is None:
            return None
        return read_depth_image(path, f"depth of frame {k}", self.depth_unit_m)

    def truth_at_frames(self) -> Trajectory:
        """Truth interpolated at the times of the frames that it covers.

        Raises:
            RecordingError: there is no truth, or it covers no frame.
        """
        if self.truth is None:
            raise RecordingError(f"recording {self.name} has no truth; add state_groundtruth_estimate0/data.csv")
        t = self.frame_t_s
        start, end = self.truth.t_s[0], self.truth.t_s[-1]
        covered = t[(t >= start - NS) & (t <= end + NS)]
        if len(covered) == 0:
            raise RecordingError(f"recording {self.name}: truth spans {start:.3f} to {end:.3f} s and covers none of "
                                 f"the frames (0 to {t[-1]:.3f} s); check that both use one clock")
        return self.truth.interpolate(covered)

    def _index(self, k: int) -> int:
        if not 0 <= k < len(self):
            raise RecordingError(f"frame {k}: the recording has frames 0 to {len(self) - 1}")
        return k


def check_refinable(recording: Recording) -> Recording:
    """Return the recording if a trajectory can be estimated from it.

    Raises:
        RecordingError: fewer than two frames, or fewer than two inertial samples.
        ImuError: the inertial samples do not reach over all frames.
    """
    if len(recording) < 2:
        raise RecordingError(f"recording {recording.name}: {len(recording)} frame; motion needs at least 2")
    if len(recording.imu) < 2:
        raise RecordingError(f"recording {recording.name}: {len(recording.imu)} inertial samples; refinement needs a "
                             "stream that covers all frames (imu0/data.csv)")
    check_coverage(recording.imu_t_s, recording.frame_t_s)
    return recording


def read_depth_image(path: Path, what: str, unit_m: float) -> NDArray[np.float32]:
    """z-depth (H, W) of a 16-bit image in metres, 0 where unknown; `what` names it in messages.

    Raises:
        RecordingError: the file is absent, cut off, undecodable or not 16-bit.
    """
    counts = _decode(path, what, depth=True)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise RecordingError(f"{what} ({path.name}) is {counts.dtype} with shape {counts.shape}; "
                             "give a 16-bit image with one channel")
    return (counts * np.float32(unit_m)).astype(np.float32)


def _decode(path: Path, what: str, depth: bool) -> NDArray[Any]:
    """Decode an image file; one that is cut off is refused, for decoders may fill it up with another image's pixels."""
    import cv2  # heavy, and needed only once somebody looks at an image

    try:
        content = path.read_bytes()
    except OSError as error:
        reason = error.strerror or "input error"
        raise RecordingError(f"{what}: {short_name(path)} cannot be read ({reason}); restore the file") from None
    for start, end in IMAGE_ENDS.items():
        if content.startswith(start) and end not in content[-64:]:
            raise RecordingError(f"{what}: {short_name(path)} is cut off; copy the file again")
    flags = cv2.IMREAD_UNCHANGED if depth else cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION
    image = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if content else None
    if image is None:
        raise RecordingError(f"{what}: {short_name(path)} is not an image that can be decoded; restore the file")
    return np.asarray(image)
