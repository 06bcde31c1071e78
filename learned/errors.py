"""What can go wrong between a recording and the motions a network predicts for it."""

from vio.errors import VioError


class WeightsError(VioError):
    """Weights that are missing or that no network of this version can load."""


class PredictionError(VioError):
    """A predictor whose output breaks its contract: wrong shape, or a value that is not finite."""


class NetworkInputError(VioError):
    """Frames or vibration that a network cannot take: wrong shape, wrong size, missing."""


class CheckpointError(VioError):
    """A checkpoint that is damaged, or of another run."""


class TrainingError(VioError):
    """Training that cannot go on: losses that are not finite, nothing to validate with."""


class BenchmarkError(VioError):
    """A table of the paper that cannot be measured: data that are missing or changed, or runs of another plan."""
