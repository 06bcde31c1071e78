"""Do camera and gyro tell of the same turns at the same times? A check of clocks and of the axes of `T_body_camera`.

The camera's rotation between neighbouring frames, from tracked corners, is laid beside the integral of the gyro over
the same intervals, shifted by a range of time offsets and turned by the 24 rotations that swap axes. Both are small
angles, so rotation vectors are compared as they are. Whoever agrees best, by correlation over the three axes, wins.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from vio import se3
from vio.camera import Camera
from vio.errors import TrackingError
from vio.rays import rays_from_pixels
from vio.recording import Recording

Array = NDArray[np.float64]

MOST_FRAMES, FEWEST_INTERVALS = 200, 20
CORNERS = 200
FEWEST_RAYS = 12
ROUNDS = 6
SEEN = 10.8
"""Chi² of one degree of freedom at 99.9 %."""
OFFSET_STEP_S = 0.005
SMALLEST_REACH_S, REACH_FRAMES = 0.3, 2.0
"""Offsets are sought up to so many seconds or frame intervals, whatever is more."""


@dataclass(frozen=True)
class SyncQuality:
    """How well K frame intervals agree."""

    t_s: Array
    """(K,) their middles."""
    visual_rad: Array
    """(K, 3) rotation vectors by the images, in body axes, less their mean."""
    gyro_rad: Array
    """(K, 3) by the gyro, at the declared time offset, less their mean."""
    offset_s: Array
    """(D,) time offsets that were tried, beyond the declared one; positive = the IMU's stamps are late."""
    correlation: Array
    """(D,) at each of them, in the declared axes."""
    best_offset_s: float
    best_correlation: float
    declared_correlation: float
    """As the calibration says."""
    swapped: str | None
    """Axes that would agree clearly better, as body axes written in those declared; None where none would."""
    turn_rms_rad: float
    """Root mean square of the gyro's turns per interval."""

    @property
    def offset_is_seen(self) -> bool:
        """Whether the best offset explains the turns better than the declared one by more than chance.

        Twice the gain in log likelihood of a Gaussian residual, 3 K ln((1 - c0²) / (1 - c²)), against 3.3 sigma.
        """
        declared, best = (max(1 - c**2, 1e-12) for c in (self.declared_correlation, self.best_correlation))
        return self.best_correlation > 0 and 3 * len(self.t_s) * np.log(declared / best) > SEEN


def sync_quality(recording: Recording) -> SyncQuality | None:
    """Compare camera and gyro where the recording turns most; None where it cannot be done.

    It takes images, a calibrated camera and inertial samples over the same frames.

    Raises:
        RecordingError: an image is cut off or undecodable.
    """
    camera = recording.calibration.camera
    if camera is None or not recording.has_images or len(recording) <= FEWEST_INTERVALS or len(recording.imu) < 2:
        return None
    total = _integral(recording)
    first = _liveliest(recording, total)
    frames = range(first, min(first + MOST_FRAMES, len(recording)))
    visual, good = _visual_turns(recording, camera, frames)
    t = recording.frame_t_s[frames.start:frames.stop]
    inside = (t[:-1] >= recording.imu_t_s[0]) & (t[1:] <= recording.imu_t_s[-1]) & good
    if inside.sum() < FEWEST_INTERVALS:
        return None
    start, end = t[:-1][inside], t[1:][inside]
    return _compare(recording, total, start, end, visual[inside])


def _compare(recording: Recording, total: Array, start: Array, end: Array, visual: Array) -> SyncQuality:
    visual = visual @ recording.calibration.T_body_camera[:3, :3].T
    reach = max(SMALLEST_REACH_S, REACH_FRAMES * float(np.median(end - start)))
    steps = round(reach / OFFSET_STEP_S)
    offsets = np.asarray(OFFSET_STEP_S * np.arange(-steps, steps + 1), float)
    turns = np.array([_turns(recording, total, start + offset, end + offset) for offset in offsets])
    visual, turns = visual - visual.mean(axis=0), turns - turns.mean(axis=1, keepdims=True)
    agreement = {name: _correlations(visual @ axes.T, turns) for name, axes in axis_rotations().items()}
    here = agreement.pop("x y z")
    best = int(np.argmax(here))
    other, elsewhere = max(agreement.items(), key=lambda item: float(item[1].max()))
    clearly = float(elsewhere.max()) > 0.7 and float(elsewhere.max()) > float(here.max()) + 0.2
    gyro = turns[steps]
    return SyncQuality(0.5 * (start + end), visual, gyro, offsets, here, float(offsets[best]), float(here[best]),
                       float(here[steps]), other if clearly else None,
                       float(np.sqrt(np.mean(np.einsum("kc,kc->k", gyro, gyro)))))


def axis_rotations() -> dict[str, Array]:
    """The 24 rotations that map axes to axes, by what x, y and z become: `"x y z"` is none, `"y -x z"` a turn."""
    found = {}
    for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
        axes = np.zeros((3, 3))
        axes[range(3), order] = signs
        if np.linalg.det(axes) > 0:
            names = ["-" * (sign < 0) + "xyz"[axis] for axis, sign in zip(order, signs, strict=True)]
            found[" ".join(names)] = axes
    return found


def _correlations(visual: Array, turns: Array) -> Array:
    """(D,) of rotation vectors (K, 3) with those of every offset (D, K, 3)."""
    norms = np.linalg.norm(visual) * np.linalg.norm(turns, axis=(1, 2))
    return np.asarray(np.einsum("kc,dkc->d", visual, turns) / np.maximum(norms, 1e-300))


def _integral(recording: Recording) -> Array:
    """(N, 3) angle turned since the first sample [rad]."""
    rate, dt = recording.imu.gyro_rad_s, np.diff(recording.imu_t_s)[:, None]
    return np.concatenate([np.zeros((1, 3)), np.cumsum(0.5 * (rate[1:] + rate[:-1]) * dt, axis=0)])


def _turns(recording: Recording, total: Array, start: Array, end: Array) -> Array:
    """(K, 3) angle turned in each interval."""
    t = recording.imu_t_s
    return np.column_stack([np.interp(end, t, total[:, k]) - np.interp(start, t, total[:, k]) for k in range(3)])


def _liveliest(recording: Recording, total: Array) -> int:
    """First frame of the stretch of `MOST_FRAMES` that turns most."""
    t = recording.frame_t_s
    angle = np.linalg.norm(_turns(recording, total, t[:-1], t[1:]), axis=1)
    if len(angle) <= MOST_FRAMES:
        return 0
    sums = np.concatenate([[0.0], np.cumsum(angle)])
    return int(np.argmax(sums[MOST_FRAMES:] - sums[:-MOST_FRAMES]))


def _visual_turns(recording: Recording, camera: Camera, frames: range) -> tuple[Array, NDArray[np.bool_]]:
    """(K, 3) rotation vectors in camera axes between neighbouring frames, and which (K,) were measured."""
    from vio.tracking import TrackerSettings, track_images  # OpenCV, and only for whoever looks at pixels

    turns, good = np.zeros((len(frames) - 1, 3)), np.zeros(len(frames) - 1, bool)
    try:
        tracks = track_images((recording.frame(k) for k in frames), TrackerSettings(corners=CORNERS))
    except TrackingError:  # no texture anywhere: nothing was measured
        return turns, good
    rays, seen = rays_from_pixels(camera, tracks.pixel)
    rays = rays.select(seen)
    frame, track = tracks.frame[seen], tracks.track[seen]
    for k in range(len(frames) - 1):
        now, then = np.flatnonzero(frame == k), np.flatnonzero(frame == k + 1)
        _, a, b = np.intersect1d(track[now], track[then], assume_unique=True, return_indices=True)
        if len(a) >= FEWEST_RAYS:
            turns[k], good[k] = turn_between(rays.bearing[now[a]], rays.bearing[then[b]]), True
    return turns, good


def turn_between(before: Array, after: Array) -> Array:
    """Rotation vector (3,) R with before = R after for most of N rays (N, 3).

    Wahba's problem by singular values (Markley, 1988), reweighted so that rays which also move by parallax or are
    wrong count little (Geman-McClure).
    """
    weight = np.ones(len(before))
    R = np.eye(3)
    for _ in range(ROUNDS):
        U, _, Vt = np.linalg.svd((before * weight[:, None]).T @ after)
        R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
        miss = np.linalg.norm(before - after @ R.T, axis=1)
        size = max(1.5 * float(np.median(miss)), 1e-6)
        weight = 1 / (1 + (miss / size) ** 2) ** 2
    return np.asarray(se3.so3_log(R))
