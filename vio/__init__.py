"""Visual-inertial recordings: reading, geometry, classical motion, metrics. Imports neither torch nor gtsam."""

from vio.calibration import Calibration as Calibration
from vio.camera import Camera as Camera
from vio.conversion import convert_to_asl as convert_to_asl
from vio.errors import VioError as VioError
from vio.formats import open_recording as open_recording
from vio.formats.asl import read_asl as read_asl
from vio.formats.asl import write_asl as write_asl
from vio.formats.declared import Declared as Declared
from vio.formats.kitti import read_kitti as read_kitti
from vio.formats.kitti import write_kitti as write_kitti
from vio.formats.tum import read_tum as read_tum
from vio.formats.tum import write_tum as write_tum
from vio.imu import ImuNoise as ImuNoise
from vio.imu import ImuSamples as ImuSamples
from vio.imu_checks import ImuReport as ImuReport
from vio.imu_checks import check_imu as check_imu
from vio.motions import RelativeMotions as RelativeMotions
from vio.motions import load_motions as load_motions
from vio.recording import Recording as Recording
from vio.recording import TruthState as TruthState
from vio.recording import check_refinable as check_refinable
from vio.trajectory import Trajectory as Trajectory
