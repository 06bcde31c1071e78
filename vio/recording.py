"""A recording: frames read when asked for, inertial samples, calibration, and truth when there is any."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vio.calibration import Calibration
from vio.depth import DepthEncoding, LinearDepth, RelativeInverseDepth
from vio.errors import RecordingError
from vio.image_files import decode_image, rgb
from vio.imu import ImuSamples, check_coverage
from vio.trajectory import Trajectory
from vio.video_frames import VideoFrames

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

NS = 1e-9


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
    """Depth image of every frame; None (or an empty tuple) where there is none."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """Where the recording comes from: simulator version, seed, organ, vibration; empty when unknown."""
    depth_unit_m: float = 1e-3
    """Metres per count of depth images that are plain 16-bit z-depth."""
    truth_state: TruthState | None = None
    """Velocity and biases at every pose of `truth`."""
    depth_encoding: DepthEncoding | None = None
    """How the depth images are stored where they are not plain 16-bit z-depth in `depth_unit_m`."""
    video: VideoFrames | None = None
    """Decodes the frames of a recording that is a film; `frame_paths` are None then."""

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
        if self.video is not None and len(self.video) != len(t):
            raise RecordingError(f"recording {self.name}: {len(t)} frames but a film of {len(self.video)}")
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
        """Whether every frame has its image: a file that exists, or a place in the film."""
        return self.video is not None or all(path is not None and path.is_file() for path in self.frame_paths)

    @property
    def has_any_image(self) -> bool:
        """Whether at least one frame has its image; the others' are named when they are read."""
        return self.video is not None or any(path is not None and path.is_file() for path in self.frame_paths)

    @property
    def has_depth(self) -> bool:
        """Whether z-depth in metres can be had for at least one frame."""
        return self.stored_depth.metric and self.has_depth_images

    @property
    def has_depth_images(self) -> bool:
        """Whether the depth image of at least one frame exists, metric or relative."""
        return any(path is not None and path.is_file() for path in self.depth_paths)

    @property
    def stored_depth(self) -> DepthEncoding:
        """How the depth images are stored."""
        return self.depth_encoding or LinearDepth(self.depth_unit_m)

    def frame(self, k: int) -> Image:
        """Image of frame k as stored: grey (H, W) or colour (H, W, 3) in R, G, B order.

        Raises:
            RecordingError: no such frame, its file is absent, cut off or undecodable, or its size is not the camera's.
        """
        path = self.frame_paths[self._index(k)]
        if self.video is not None:
            image: Image = self.video.read(k)
        elif path is None:
            raise RecordingError(f"frame {k}: this recording lists frame times but no images")
        else:
            image = rgb(decode_image(path, f"frame {k}"))
        camera = self.calibration.camera
        height, width = image.shape[:2]
        if camera is not None and (width, height) != (camera.width, camera.height):
            where = f"frame {k}" if path is None else f"frame {k} ({path.name})"
            problem = (f"has {width} x {height} pixels but the camera {camera.width} x {camera.height}; correct the "
                       "camera's `resolution` and `intrinsics`")
            raise RecordingError(f"{where} {problem}", f"frame {k} {problem}")
        return image

    def depth_m(self, k: int) -> NDArray[np.float32] | None:
        """z-depth (H, W) of frame k in metres, 0 where unknown; None when no depth was recorded for the frame.

        Raises:
            RecordingError: no such frame, its depth file is absent, cut off, undecodable or of another kind than
                `depth_encoding` says, or the images hold depth up to an unknown factor.
        """
        stored = self._depth_image(k)
        return None if stored is None else self.stored_depth.depth_m(*stored)

    def relative_inverse_depth(self, k: int) -> NDArray[np.float32] | None:
        """Inverse z-depth (H, W) of frame k up to one unknown factor, 0 where unknown; None as `depth_m`.

        Raises:
            RecordingError: as `depth_m`, except that the factor need not be known.
        """
        stored, encoding = self._depth_image(k), self.stored_depth
        if stored is None:
            return None
        if isinstance(encoding, RelativeInverseDepth):
            return encoding.inverse(*stored)
        depth = encoding.depth_m(*stored)
        return np.divide(1, depth, out=np.zeros_like(depth), where=depth > 0)

    def _depth_image(self, k: int) -> tuple[NDArray[Any], str] | None:
        """The decoded depth image of frame k, and what it is in messages."""
        path = self.depth_paths[self._index(k)]
        if path is None:
            return None
        return decode_image(path, f"depth of frame {k}", depth=True), f"depth of frame {k} ({path.name})"

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
        problem = f"{len(recording)} frame; motion needs at least 2"
        raise RecordingError(f"recording {recording.name}: {problem}", problem)
    if len(recording.imu) < 2:
        problem = (f"{len(recording.imu)} inertial samples; refinement needs a stream that covers all frames "
                   "(imu0/data.csv)")
        raise RecordingError(f"recording {recording.name}: {problem}", problem)
    check_coverage(recording.imu_t_s, recording.frame_t_s)
    return recording

