"""Whole networks: the four published methods and our own, each with and without vibration.

    method = build_method("gyro-correlation", vibration=True, fusion="fourier", seed=1)
    out = method(frames, vibration)          # (B, 3, 3, H, W) in 0..1 and (B, 6, 40)
    out.depth[1].depth[0], out.T_i_j[1, 2], out.snr_depth[1]
"""

from learned.methods.config import MethodConfig, config_from_dict, config_to_dict
from learned.methods.method import Method
from learned.methods.output import DepthPyramid, MethodOutput, snr_summary
from learned.methods.registry import CONFIGS, assemble, build_method, method_config
from learned.vibration_fusion import FusionConfig

__all__ = ["CONFIGS", "DepthPyramid", "FusionConfig", "Method", "MethodConfig", "MethodOutput", "assemble",
           "build_method", "config_from_dict", "config_to_dict", "method_config", "snr_summary"]
