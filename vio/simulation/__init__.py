"""Simulated examinations: capsule motion, vibration, IMU and network-like motions with exact truth."""

from vio.simulation.cameras import CAMERAS, MIROCAM, preset_camera
from vio.simulation.imu_synthesis import SIMULATED_IMU, ImuBiases, ideal_imu
from vio.simulation.motion import CapsuleMotion, MotionState
from vio.simulation.network_motions import NetworkMotions, network_like_motions
from vio.simulation.organs import ORGANS
from vio.simulation.path import DRIVING
from vio.simulation.scenario import MODES, T_BODY_CAMERA, Simulation, simulate, simulate_recording
from vio.simulation.vibration import KINDS

__all__ = [
    "CAMERAS", "DRIVING", "KINDS", "MIROCAM", "MODES", "ORGANS", "SIMULATED_IMU", "T_BODY_CAMERA",
    "CapsuleMotion", "ImuBiases", "MotionState", "NetworkMotions", "Simulation",
    "ideal_imu", "network_like_motions", "preset_camera", "simulate", "simulate_recording",
]
