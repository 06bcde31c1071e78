"""How the vibration's features change the vision's: seven strategies behind one interface.

    fusion = EncoderFusion(FusionConfig("fourier"), channels=(64, 64, 128, 256, 512), vibration_features=136)
    bound = fusion.bind(features)            # (N, 136)
    maps = encoder(images, bound)            # bound(block, map) after every block
    bound.snr                                # (N, blocks), or None for strategies without one
"""

from learned.vibration_fusion.blocks import STRATEGIES, BoundFusion, EncoderFusion
from learned.vibration_fusion.interface import FusedMap, FusionConfig, VibrationFusion

__all__ = ["STRATEGIES", "BoundFusion", "EncoderFusion", "FusedMap", "FusionConfig", "VibrationFusion"]
