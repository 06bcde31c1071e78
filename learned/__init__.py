"""What is predicted: camera motions and depth maps from frames and vibration, by networks in torch.

    import vio, learned
    recording = vio.open_recording("examination/")
    motions = learned.predict(recording, predictor)
"""

from learned.depth_aligned import depth_aligned_motions
from learned.errors import PredictionError, WeightsError
from learned.loops import LoopSearch, find_loops
from learned.predict import Prediction, predict
from learned.predictor import PairPrediction, Predictor

__all__ = ["LoopSearch", "PairPrediction", "Prediction", "PredictionError", "Predictor", "WeightsError",
           "depth_aligned_motions", "find_loops", "predict"]
