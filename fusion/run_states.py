"""A run folder's states read back into a `Refinement`, and the optional keys of `trajectory.npz`."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion.camera_imu import UNKNOWN, CameraImu, read_camera_imu
from fusion.frame_blocks import FrameBlock
from fusion.joint import JointSamples
from fusion.result import BiasStep, BiasWander, ImuConclusion, OnlineConclusion, Refinement, ScaleConclusion, View
from vio import se3
from vio.camera import Camera
from vio.errors import FormatError, VioError
from vio.formats.tum import read_tum
from vio.imu import Gap
from vio.inertial_levels import InertialLevels
from vio.motions import UNREADABLE
from vio.trajectory import Trajectory

Array = NDArray[np.float64]

SHAPES = {"velocity": (3,), "gyro_bias": (3,), "accel_bias": (3,), "log_scale": (), "log_scale_sd": ()}
AGAIN = "refine the recording again"


def joint_arrays(joint: JointSamples | None) -> dict[str, Any]:
    """Joint samples as keys of `trajectory.npz`; single precision is far finer than what they speak of."""
    if joint is None:
        return {}
    return {"joint_node": joint.node, "joint_xi": joint.xi.astype(np.float32),
            "joint_log_scale": joint.log_scale.astype(np.float32)}


def view_arrays(view: View | None) -> dict[str, Any]:
    """How frames looked at the world, as keys of `trajectory.npz`."""
    if view is None:
        return {}
    camera = None if view.camera is None else dataclasses.asdict(view.camera)
    return {"first_frame": np.int64(view.first_frame), "T_body_camera": view.T_body_camera,
            "prior_log_scale": np.float64(view.prior_log_scale), "camera": np.array(json.dumps(camera))}


def inertial_arrays(levels: InertialLevels | None) -> dict[str, Any]:
    """What the IMU felt, as keys of `trajectory.npz`; single precision is enough for the eye."""
    if levels is None:
        return {}
    return {"inertial_t": levels.t_s, "inertial_rate": levels.rate_rad_s.astype(np.float32),
            "inertial_force": levels.force_m_s2.astype(np.float32),
            "inertial_vibration": levels.vibration_m_s2.astype(np.float32)}


def read_refinement(folder: str | Path) -> Refinement:
    """The refinement that a run folder holds. Runs of earlier versions come without joint samples and view.

    Raises:
        FormatError: a file is missing, damaged, or not what it claims.
    """
    from fusion.run_folder import read_run  # which imports this module

    folder = Path(folder)
    run = read_run(folder)
    name = f"{run.name}/trajectory.npz"
    arrays = _load(folder / "trajectory.npz", name)
    try:
        trajectory = Trajectory(arrays["t"], arrays["T_world_body"], arrays["cov"])
        m = len(trajectory)
        states = {key: _shaped(arrays[key], (m, *shape), key) for key, shape in SHAPES.items()}
        joint, view, inertial = _joint(arrays, m), _view(arrays), _inertial(arrays)
    except KeyError as error:
        raise FormatError(f"{name}: missing key {error}; {AGAIN}") from None
    except (VioError, *UNREADABLE) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FormatError(f"{name}: {reason}; {AGAIN}") from None
    truth = read_tum(folder / "truth.tum") if (folder / "truth.tum").is_file() else None
    filtered = read_tum(folder / "filtered.tum") if run.summary.get("online") else None
    return _refinement(run.name, run.summary, (trajectory, run.motions_only, truth, filtered), states,
                       arrays["rejected"], joint, view, inertial)


def name_of(folder: Path, summary: dict[str, Any]) -> str:
    """What a run is called: its folder as it was given, and what it was written as where that says nothing (`.`)."""
    return folder.name if folder.name.strip(".") else str(summary.get("name") or "run")


def read_header(folder: Path, summary: dict[str, Any], first: FrameBlock, m: int) -> Refinement:
    """The conclusions of a run folder of M frames, with the states of its first frame alone.

    Raises:
        FormatError: a file is missing, damaged, or not what it claims.
    """
    name = f"{folder.name}/trajectory.npz"
    try:
        with (folder / "trajectory.npz").open("rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = {key: archive[key] for key in archive.files if key not in {"t", "T_world_body", "cov", *SHAPES}}
        joint, view, inertial = _joint(arrays, m), _view(arrays), _inertial(arrays)
        rejected = arrays["rejected"]
    except KeyError as error:
        raise FormatError(f"{name}: missing key {error}; {AGAIN}") from None
    except (OSError, VioError, *UNREADABLE) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FormatError(f"{name}: {reason}; {AGAIN}") from None
    states = {"velocity": np.zeros((1, 3)), "gyro_bias": first.gyro_bias_rad_s, "accel_bias": first.accel_bias_m_s2,
              "log_scale": first.log_scale, "log_scale_sd": first.log_scale_sd}
    trajectories = first.refined, first.motions_only, first.truth, first.refined
    return _refinement(name_of(folder, summary), summary, trajectories, states, rejected, joint, view, inertial)


def _refinement(folder: str, summary: dict[str, Any],
                trajectories: tuple[Trajectory, Trajectory, Trajectory | None, Trajectory | None],
                states: dict[str, Array], rejected: Any, joint: JointSamples | None,
                view: View | None, inertial: InertialLevels | None) -> Refinement:
    """A refinement of what was read; trajectories are refined, motions alone, truth, and filtered where online."""
    trajectory, motions_only, truth, filtered = trajectories
    online = summary.get("online", {})
    try:
        imu, scale, motions = summary["imu"], summary["scale"], summary["motions"]
        gaps = tuple(Gap(float(gap["start_s"]), float(gap["end_s"])) for gap in imu["gaps"])
        steps = tuple(BiasStep.from_dict(step) for step in imu.get("bias_steps", []))
        wanders = tuple(BiasWander.from_dict(wander) for wander in imu.get("bias_wanders", []))
        return Refinement(
            name=str(summary["name"]), estimator=summary["estimator"], fallback_reason=summary["fallback_reason"],
            trajectory=trajectory, velocity_m_s=states["velocity"], gyro_bias_rad_s=states["gyro_bias"],
            accel_bias_m_s2=states["accel_bias"], log_scale=states["log_scale"], log_scale_sd=states["log_scale_sd"],
            motions_only=motions_only,
            scale=ScaleConclusion(scale["policy"], float(scale["log_mean"]), float(scale["log_sd"]), scale["reason"]),
            imu=ImuConclusion(imu["chi2_per_dof"], float(imu["inflation"]), gaps, steps, wanders),
            motions_used=int(motions["used"]),
            rejected=np.asarray(rejected, np.int64), bridged=int(motions.get("bridged", 0)),
            time_offset_s=float(summary["time_offset_s"]), truth=truth,
            camera_imu=_camera_imu(summary), motion_noise=(float(motions.get("rotation_noise", 1.0)),
                                                           float(motions.get("translation_noise", 1.0))),
            timing_s=dict(summary["timing_s"]), peak_rss_bytes=int(summary["peak_rss_bytes"]), joint=joint, view=view,
            inertial=inertial,
            online=None if filtered is None or not online else OnlineConclusion(
                float(online["lag_s"]), dict(online["latency_ms"]), int(online["resets"]), filtered),
        )
    except KeyError as error:
        raise FormatError(f"{folder}: summary.json or trajectory.npz lacks {error}; {AGAIN}") from None
    except (TypeError, ValueError) as error:
        raise FormatError(f"{folder}/summary.json: not as a run writes it ({error}); {AGAIN}") from None


def _camera_imu(summary: dict[str, Any]) -> CameraImu:
    """Folders of earlier versions hold none."""
    values = summary.get("camera_imu")
    return UNKNOWN if values is None else read_camera_imu(values, float(summary["motions"]["rotation_noise"]))


def _load(path: Path, name: str) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            return dict(np.load(file, allow_pickle=False))
    except FileNotFoundError:
        raise FormatError(f"{name}: no such file; give a folder written by `capsule-vio refine`") from None
    except (OSError, *UNREADABLE) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise FormatError(f"{name}: not a readable npz without pickles ({reason}); {AGAIN}") from None


def _joint(arrays: dict[str, Any], m: int) -> JointSamples | None:
    if "joint_xi" not in arrays:
        return None
    node = np.asarray(arrays["joint_node"], np.int64)
    xi, log_scale = np.asarray(arrays["joint_xi"], float), np.asarray(arrays["joint_log_scale"], float)
    k = len(node)
    if k == 0 or node[0] != 0 or node[-1] != m - 1 or (np.diff(node) <= 0).any():
        raise ValueError("joint_node does not run from the first pose to the last")
    _shaped(xi, (len(xi), k, 6), "joint_xi")
    return JointSamples(node, xi, _shaped(log_scale, (len(xi), k), "joint_log_scale"))


def _view(arrays: dict[str, Any]) -> View | None:
    if "T_body_camera" not in arrays:
        return None
    camera = json.loads(str(arrays["camera"]))
    return View(int(arrays["first_frame"]), se3.check_transforms(arrays["T_body_camera"], "T_body_camera"),
                None if camera is None else Camera(**camera), float(arrays["prior_log_scale"]))


def _inertial(arrays: dict[str, Any]) -> InertialLevels | None:
    if "inertial_t" not in arrays:
        return None
    rate, force, vibration = (np.asarray(arrays[f"inertial_{name}"], float) for name in ("rate", "force", "vibration"))
    return InertialLevels(np.asarray(arrays["inertial_t"], float), rate, force, vibration)


def _shaped(values: Any, shape: tuple[int, ...], key: str) -> Array:
    array = np.asarray(values, float)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{key} has shape {array.shape}, expected {shape} of finite numbers")
    return array
