"""Every way an input can be unusable, as one small tree of exceptions.

Messages are one line: what is wrong, where (file, row, frame, time), the limit, the remedy.
The command line turns each `VioError` into that line on stderr and an exit code.
"""


class VioError(Exception):
    """Root of every error this project raises on purpose. `exit_code` follows the command-line contract.

    Args:
        message: the line for whoever typed the command; it may name their files.
        nameless: the same without names of files and folders, for results that others will read: a name may be a
            patient's. None where the message holds none.
    """

    exit_code = 3

    def __init__(self, message: str = "", nameless: str | None = None) -> None:
        super().__init__(message)
        self.nameless = message if nameless is None else nameless


class GeometryError(VioError):
    """A rotation, transform or covariance that is not one."""


class CameraError(VioError):
    """Intrinsics that cannot be a camera, or points a camera model cannot map."""


class CalibrationError(VioError):
    """A calibration file with a missing, unknown or impossible entry."""


class ImuError(VioError):
    """Inertial samples that cannot be integrated."""


class RecordingError(VioError):
    """A recording directory that is missing parts, or whose parts do not fit together."""


class FormatError(VioError):
    """A file that does not follow the format it claims."""


class TrajectoryError(VioError):
    """A trajectory that cannot be used or compared."""


class DegenerateAlignmentError(TrajectoryError):
    """The positions do not determine the alignment that was asked for (straight or motionless track)."""


class MotionsError(VioError):
    """Relative motions that break the contract between their source and the estimators."""


class TrackingError(VioError):
    """Images or tracks from which no motion can be measured."""


class LesionError(VioError):
    """A list of lesions that cannot be placed on a trajectory."""


class CorruptionError(VioError):
    """A corruption or sensor fault that does not exist, or that the data at hand cannot suffer."""


class SimulationError(VioError):
    """A simulation that was asked for the impossible."""


class ConfigError(VioError):
    """An unknown configuration key or a value outside its range."""


class OutputError(VioError):
    """A result that cannot be written."""


class UsageError(VioError):
    """A command line that makes no sense."""

    exit_code = 2


class EstimationError(VioError):
    """No estimator could produce a trajectory."""

    exit_code = 4
