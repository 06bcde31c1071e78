"""What refinement concludes: one typed value that every estimator fills and the run folder writes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fusion.camera_imu import UNKNOWN, CameraImu
from fusion.joint import JointSamples
from vio.camera import Camera
from vio.errors import RecordingError
from vio.imu import Gap
from vio.inertial_levels import InertialLevels
from vio.recording import Recording
from vio.trajectory import Trajectory

Array = NDArray[np.float64]
Estimator = Literal["graph", "ekf", "motions"]
ScalePolicy = Literal["free", "prior", "fixed"]

SAME_FRAME_S = 1e-3
PLAIN = 5.0
"""Size over sd of a bias's step along one axis at which its sensor is named."""


@dataclass(frozen=True)
class ScaleConclusion:
    """How metric scale was obtained: ln(metres per motion unit), and why."""

    policy: ScalePolicy
    log_mean: float
    """Mean over the recording of the estimated (or assumed) log scale."""
    log_sd: float
    """Standard deviation of that mean as claimed; the prior's where scale was not estimated."""
    reason: str
    assumed_sd: float = field(default=0.0, compare=False)
    """Part of `log_sd` that no equation holds: assumed, common to the whole recording."""


@dataclass(frozen=True)
class BiasStep:
    """A step of the IMU's biases, and that they were let go there."""

    first_frame: int
    """Node of the trajectory before it …"""
    last_frame: int
    """… and after it: in between, the biases are free."""
    start_s: float
    """Of the time in which it lies …"""
    end_s: float
    """… and the end of it."""
    gyro_rad_s: tuple[float, ...]
    """(3,) body axes."""
    gyro_sd_rad_s: tuple[float, ...]
    accel_m_s2: tuple[float, ...]
    """(3,)"""
    accel_sd_m_s2: tuple[float, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `summary.json`, and in words."""
        return asdict(self) | {"words": self.in_words()}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> BiasStep:
        """What `to_dict` wrote."""
        sizes = [tuple(map(float, values[key])) for key in ("gyro_rad_s", "gyro_sd_rad_s", "accel_m_s2",
                                                            "accel_sd_m_s2")]
        return BiasStep(int(values["first_frame"]), int(values["last_frame"]), float(values["start_s"]),
                        float(values["end_s"]), *sizes)

    def in_words(self) -> str:
        """Which sensors plainly stepped, how far and when."""
        sizes = (("gyro", np.rad2deg(self.gyro_rad_s), np.rad2deg(self.gyro_sd_rad_s), "deg/s"),
                 ("accelerometer", np.array(self.accel_m_s2), np.array(self.accel_sd_m_s2), "m/s²"))
        parts = [f"the {sensor}'s bias steps by {_length(size, sd)} {unit}" for sensor, size, sd, unit in sizes
                 if (np.abs(size) > PLAIN * sd).any()]
        return f"{' and '.join(parts) or 'the biases step'} between {self.start_s:.1f} and {self.end_s:.1f} s"


def _length(size: Array, sd: Array) -> str:
    """Length of a vector with its sd, to the sd's second digit."""
    length = float(np.linalg.norm(size))
    along = float(np.linalg.norm(size / length * sd))
    digits = max(0, 1 - int(np.floor(np.log10(along))))
    return f"{length:.{digits}f} ± {along:.{digits}f}"


@dataclass(frozen=True)
class BiasWander:
    """A stretch in which the IMU's biases wander more than its noise card says, and may do so."""

    first_frame: int
    """Node of the trajectory it begins at …"""
    last_frame: int
    """… and ends at."""
    start_s: float
    """Their times."""
    end_s: float
    accel_times: float
    """How many times as much the accelerometer's bias wanders; 1 = as the noise card says."""
    gyro_times: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values for `summary.json`, and in words."""
        return asdict(self) | {"words": self.in_words()}

    @staticmethod
    def from_dict(values: Mapping[str, Any]) -> BiasWander:
        """What `to_dict` wrote."""
        return BiasWander(int(values["first_frame"]), int(values["last_frame"]), float(values["start_s"]),
                          float(values["end_s"]), float(values["accel_times"]), float(values["gyro_times"]))

    def in_words(self) -> str:
        """Which sensors' biases wander, how much and when."""
        sensors = [(name, times) for name, times in (("accelerometer", self.accel_times), ("gyro", self.gyro_times))
                   if times > 1]
        whose = " and ".join(f"the {name}'s" for name, _ in sensors)
        what = f"{whose} bias wanders" if len(sensors) == 1 else f"{whose} biases wander"
        times = " and ".join(f"{times:.0f}" for _, times in sensors)
        return (f"{what} up to {times} times as much as the noise card says between {self.start_s:.1f} and "
                f"{self.end_s:.1f} s (a sensor that warms up, or another one's card)")


@dataclass(frozen=True)
class ImuConclusion:
    """How well the inertial data agree with the rest."""

    chi2_per_dof: float | None
    """Of the inertial factors in the fixed-scale pass; None where no graph was solved."""
    inflation: float
    """Factor on the accelerometer density that the scale policy asked for; 1 = as calibrated."""
    gaps: tuple[Gap, ...]
    """Holes over 0.5 s; their frame intervals carry no inertial factor."""
    bias_steps: tuple[BiasStep, ...] = ()
    """Where the biases stepped, and were let go."""
    bias_wanders: tuple[BiasWander, ...] = ()
    """Where they wander more than the noise card says."""


@dataclass(frozen=True)
class LoopConclusion:
    """What became of the loops that were proposed."""

    proposed: int = 0
    """Pairs of frames that looked alike."""
    refused: Mapping[str, int] = field(default_factory=dict)
    """How many of them were not used, by reason."""
    frames: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """(L, 2) nodes of the verified loops that the motions span."""
    distance2: Array = field(default_factory=lambda: np.zeros(0))
    """(L,) squared whitened distance from the final trajectory (6 degrees of freedom)."""
    accepted: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, bool))
    """(L,) whether the trajectory was built with it."""


NO_LOOPS = LoopConclusion()


@dataclass(frozen=True)
class RestConclusion:
    """Where the capsule lay still."""

    span: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    """(R, 2) first and last node of every stretch, in order."""
    displacement_sd_m: Array = field(default_factory=lambda: np.zeros(0))
    """(R,) how surely the displacement over it was taken to be zero, beside what the motions say."""


NO_REST = RestConclusion()


@dataclass(frozen=True)
class View:
    """What it takes to lay a pixel of a frame into the world."""

    first_frame: int
    """Number in the recording of the trajectory's first frame."""
    T_body_camera: Array
    """(4, 4) pose of the camera in the body."""
    camera: Camera | None
    """None when the recording has no calibrated camera."""
    prior_log_scale: float
    """ln(metres per motion unit) that the source of the motions declared; predicted depth is metric at it."""


@dataclass(frozen=True)
class OnlineConclusion:
    """How a recording fared that was estimated frame by frame."""

    lag_s: float
    """How long a frame stayed open to correction."""
    latency_ms: dict[str, float]
    """`p50`, `p99` and `max` over the frames, from arrival to answer."""
    resets: int
    """How often the smoother had to begin anew."""
    filtered: Trajectory
    """M poses as they were known when their frame arrived."""


@dataclass(frozen=True)
class Refinement:
    """One refined recording of M frames."""

    name: str
    """Name of the recording."""
    estimator: Estimator
    fallback_reason: str | None
    """Why an earlier estimator was not used; None when the first choice held."""
    trajectory: Trajectory
    """M poses of the body in the world with covariances; position and yaw are relative to the first pose."""
    velocity_m_s: Array
    """(M, 3) in the world."""
    gyro_bias_rad_s: Array
    """(M, 3)"""
    accel_bias_m_s2: Array
    """(M, 3)"""
    log_scale: Array
    """(M,) ln(metres per motion unit) at every frame."""
    log_scale_sd: Array
    """(M,)"""
    motions_only: Trajectory
    """The same M frames chained from the motions alone at the prior scale, from the refined first pose."""
    scale: ScaleConclusion
    imu: ImuConclusion
    motions_used: int
    rejected: NDArray[np.int64]
    """Indices of the motions that were gated as outliers."""
    bridged: int
    """Frame pairs that no motion measures; `motions_only` stands still there."""
    time_offset_s: float
    """Camera-IMU time offset applied (from calibration)."""
    truth: Trajectory | None
    """Truth at the frames it covers, when the recording has any."""
    timing_s: dict[str, float] = field(default_factory=dict)
    peak_rss_bytes: int = 0
    joint: JointSamples | None = None
    """How the errors of all poses hang together; None where that could not be sampled."""
    camera_imu: CameraImu = UNKNOWN
    """How camera and IMU sit to each other, as measured, and what was done about it."""
    motion_noise: tuple[float, float] = (1.0, 1.0)
    """Factors by which the motions' claimed noise of rotation and translation was corrected; 1 where it was kept."""
    view: View | None = None
    """How the frames looked at the world; None when unknown."""
    inertial: InertialLevels | None = None
    """What the IMU felt along time; None when unknown."""
    loops: LoopConclusion = NO_LOOPS
    """What became of the loops that were proposed; nothing where none was looked for."""
    rest: RestConclusion = NO_REST
    """Where the capsule lay still; nothing where that was not looked for."""
    online: OnlineConclusion | None = None
    """Where the recording was estimated frame by frame; the trajectory then holds poses as they left the lag."""


def check_same_recording(refinement: Refinement, recording: Recording) -> None:
    """Make sure that a recording is the one that was refined, by the times of its frames.

    Raises:
        RecordingError: its frames are not those of the trajectory.
    """
    t, first = refinement.trajectory.t_s, 0 if refinement.view is None else refinement.view.first_frame
    frames = recording.frame_t_s[first:first + len(t)]
    if len(frames) != len(t) or np.abs(frames - t).max() > SAME_FRAME_S:
        raise another_recording(refinement, recording)


def another_recording(refinement: Refinement, recording: Recording) -> RecordingError:
    """That a recording is not the one that was refined."""
    return RecordingError(f"recording {recording.name} does not have the frames of the trajectory of "
                          f"{refinement.name}; give the recording that was refined")
