"""Relative motions: the contract between whoever measures motion and the estimators.

File: `motions.npz`, keys as the fields of `RelativeMotions` without unit suffixes (docs/conventions.md).
"""

from __future__ import annotations

import json
import zipfile
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vio import se3
from vio.atomic import atomic_write
from vio.errors import GeometryError, MotionsError
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

TIME_TOLERANCE_S = 1e-3
UNREADABLE = (TypeError, ValueError, EOFError, RuntimeError, zipfile.BadZipFile, zlib.error)
"""What reading a file that is no npz, or a damaged one, may raise."""
REQUIRED_KEYS = ("t_i", "t_j", "T_i_j", "cov", "scale_log_mean", "scale_log_sd")


@dataclass(frozen=True)
class RelativeMotions:
    """N motions of the CAMERA between pairs of frames, translations in motion units.

    One motion unit is `exp(s)` metres; `s` is unknown with a Gaussian prior.

    Raises:
        MotionsError: shapes disagree, `t_i >= t_j`, a value is not finite, or an impossible scale prior.
        GeometryError: a transform or a covariance that is not one.
    """

    t_i_s: Array
    """(N,) time of the first frame, seconds after the recording's first frame."""
    t_j_s: Array
    """(N,) time of the second frame, later than `t_i_s`."""
    T_i_j: Array
    """(N, 4, 4) pose of the camera at j in the camera at i, translation in motion units."""
    cov: Array
    """(N, 6, 6) right-perturbation covariance, rotation first, rad and motion units."""
    scale_log_mean: float
    """Mean of s = ln(metres per motion unit)."""
    scale_log_sd: float
    """Standard deviation of s."""
    snr: Array | None = None
    """(N,) vibration signal-to-noise ratio the network saw at frame i, when it has one."""
    meta: dict[str, Any] = field(default_factory=dict)
    """Where the motions come from: method, weights, version."""

    def __post_init__(self) -> None:
        t_i, t_j = np.asarray(self.t_i_s, float), np.asarray(self.t_j_s, float)
        n = len(t_i)
        if n == 0:
            raise MotionsError("motions: empty; give at least one relative motion")
        T, cov = np.asarray(self.T_i_j, float), np.asarray(self.cov, float)
        if t_j.shape != (n,) or T.shape != (n, 4, 4) or cov.shape != (n, 6, 6):
            raise MotionsError(
                f"motions: shapes t_i {t_i.shape}, t_j {t_j.shape}, T_i_j {T.shape}, cov {cov.shape}; "
                "expected (N,), (N,), (N, 4, 4), (N, 6, 6)"
            )
        if not (np.isfinite(t_i).all() and np.isfinite(t_j).all()):
            raise MotionsError("motions: a time is not finite; drop that row")
        if (t_i >= t_j).any():
            k = int(np.argmax(t_i >= t_j))
            raise MotionsError(f"motions[{k}]: t_i {t_i[k]:.6f} s is not before t_j {t_j[k]:.6f} s; swap and invert")
        if not (np.isfinite(self.scale_log_mean) and np.isfinite(self.scale_log_sd) and self.scale_log_sd >= 0):
            raise MotionsError(
                f"motions: scale prior ln-mean {self.scale_log_mean}, sd {self.scale_log_sd}; both finite, sd ≥ 0"
            )
        snr = None if self.snr is None else np.asarray(self.snr, float)
        if snr is not None and snr.shape != (n,):
            raise MotionsError(f"motions: snr has shape {snr.shape}, expected ({n},)")
        for name, value in (("t_i_s", t_i), ("t_j_s", t_j), ("snr", snr),
                            ("T_i_j", se3.check_transforms(T, "motions T_i_j")),
                            ("cov", se3.check_covariances(cov, "motions cov"))):
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.t_i_s)

    def arrays(self) -> dict[str, Any]:
        """What the file holds, by key."""
        arrays: dict[str, Any] = {
            "t_i": self.t_i_s, "t_j": self.t_j_s, "T_i_j": self.T_i_j, "cov": self.cov,
            "scale_log_mean": np.float64(self.scale_log_mean), "scale_log_sd": np.float64(self.scale_log_sd),
            "meta": np.array(json.dumps(self.meta, sort_keys=True)),
        }
        if self.snr is not None:
            arrays["snr"] = self.snr
        return arrays

    def save(self, path: str | Path) -> None:
        """Write `motions.npz` atomically."""
        with atomic_write(path) as file:
            np.savez_compressed(file, **self.arrays())


def load_motions(path: str | Path) -> RelativeMotions:
    """Read `motions.npz`.

    Raises:
        MotionsError: the file is missing, is no npz, or lacks a key; or its contents break the contract.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:  # np.load leaves the file open when it fails
            arrays = dict(np.load(file, allow_pickle=False))
    except FileNotFoundError:
        raise MotionsError(f"{path.name}: no such file; write it with `capsule-vio predict`") from None
    except OSError as error:
        raise MotionsError(f"{path.name}: cannot be read ({error.strerror or error}); give a file that can") from None
    except UNREADABLE as error:
        reason = (str(error).split(". ")[0] or type(error).__name__)[:120]
        raise MotionsError(f"{path.name}: not a readable npz without pickles ({reason}); write it with "
                           "`capsule-vio predict` or `RelativeMotions.save`") from None
    missing = [key for key in REQUIRED_KEYS if key not in arrays]
    if missing:
        raise MotionsError(f"{path.name}: missing key {missing[0]!r}; required are {', '.join(REQUIRED_KEYS)}")
    try:
        meta = json.loads(str(arrays["meta"])) if "meta" in arrays else {}
        return RelativeMotions(
            arrays["t_i"], arrays["t_j"], arrays["T_i_j"], arrays["cov"], float(arrays["scale_log_mean"]),
            float(arrays["scale_log_sd"]), arrays.get("snr"), meta,
        )
    except (TypeError, ValueError) as error:
        raise MotionsError(f"{path.name}: {error}") from None
    except GeometryError as error:
        raise MotionsError(f"{path.name}: {error}") from None


def match_frames(motions: RelativeMotions, frame_t_s: ArrayLike) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frame indices (N,), (N,) of every motion's two ends.

    Raises:
        MotionsError: an end lies further than 1 ms from every frame.
    """
    frames = np.asarray(frame_t_s, float)
    return _nearest(motions.t_i_s, frames, "t_i"), _nearest(motions.t_j_s, frames, "t_j")


def _nearest(t: Array, frames: Array, name: str) -> NDArray[np.int64]:
    right = np.clip(np.searchsorted(frames, t), 1, max(len(frames) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(frames) - 1)
    index = np.where(np.abs(frames[right] - t) < np.abs(frames[left] - t), right, left)
    off = np.abs(frames[index] - t)
    if (off > TIME_TOLERANCE_S).any():
        k = int(np.argmax(off > TIME_TOLERANCE_S))
        raise MotionsError(
            f"motions[{k}]: {name} = {t[k]:.6f} s matches no frame (nearest {frames[index[k]]:.6f} s, limit "
            f"{TIME_TOLERANCE_S:g} s); times are seconds after the recording's first frame"
        )
    return index.astype(np.int64)


def chain_motions(motions: RelativeMotions, frame_t_s: ArrayLike, T_body_camera: ArrayLike,
                  T_world_first: ArrayLike | None = None) -> tuple[Trajectory, int]:
    """Chain motions at the prior scale: the trajectory of the motions alone.

    Neighbouring frames are joined by the most certain motion between them. Frames that only a wider motion spans lie
    on its screw, evenly spaced. A pair that no motion spans is bridged by standing still.

    Args:
        motions: measured motions of the camera.
        frame_t_s: (M,) times of the frames to place [s].
        T_body_camera: (4, 4) camera pose in the body.
        T_world_first: (4, 4) pose of the body at the first frame; identity when None.

    Returns:
        The body's trajectory at all frames, and how many pairs were bridged.
    """
    frames = np.asarray(frame_t_s, float)
    T_body_camera = np.asarray(T_body_camera, float)
    i, j = match_frames(motions, frames)
    metric = motions.T_i_j.copy()
    metric[:, :3, 3] *= np.exp(motions.scale_log_mean)
    body = T_body_camera @ metric @ se3.inverse(T_body_camera)
    steps = np.broadcast_to(np.eye(4), (len(frames) - 1, 4, 4)).copy()
    measured = np.zeros(len(frames) - 1, bool)
    certainty = np.trace(motions.cov, axis1=1, axis2=2)
    order = np.lexsort((certainty, j - i))  # short before wide, certain before uncertain
    neighbours = order[(j - i)[order] == 1][::-1]  # the last written is the most certain
    steps[i[neighbours]], measured[i[neighbours]] = body[neighbours], True
    for n in order[len(neighbours):]:
        span = slice(i[n], j[n])
        if not measured[span].any():
            steps[span] = se3.exp(se3.log(body[n]) / (j[n] - i[n]))
            measured[span] = True
    return Trajectory(frames, se3.chain(steps, T_world_first)), int((~measured).sum())
