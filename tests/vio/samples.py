"""Small recordings in other people's formats, written from their own conventions by code the readers do not share."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from vio.calibration import Calibration
from vio.camera import Camera
from vio.formats.declared import Declared

WIDTH, HEIGHT, FRAMES = 32, 24, 6
PATIENT = "Erika_Mustermann_1964"
SECONDS = (0.0, 0.25, 0.5, 1.0, 1.25, 1.75)
T_BODY_CAMERA = np.eye(4)
T_BODY_CAMERA[:3] = [[0, 0, 1, 0.004], [-1, 0, 0, -0.001], [0, -1, 0, 0.002]]
CAMERA = Camera("pinhole", WIDTH, HEIGHT, 20.0, 21.0, 15.5, 11.5, (0.01, -0.02, 0.001, 0.0))
IMU_S = np.arange(-10, 90) * 0.025


@dataclass
class Sample:
    """What was written, in our conventions."""

    root: Path
    declared: Declared
    T_world_camera: np.ndarray | None = None
    depth_m: np.ndarray | None = None
    depth_tolerance_m: float = 0.0
    images: np.ndarray | None = None
    seconds: tuple[float, ...] = SECONDS


def poses() -> np.ndarray:
    """Camera in the world, metres: turns about all axes, moves by millimetres."""
    T = np.tile(np.eye(4), (FRAMES, 1, 1))
    rng = np.random.default_rng(3)
    T[:, :3, :3] = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.2, (FRAMES, 3)), axis=0)).as_matrix()
    T[:, :3, 3] = np.cumsum(rng.normal(0, 0.003, (FRAMES, 3)), axis=0)
    return T


def pictures(dtype=np.uint8) -> np.ndarray:
    """Colour images, R, G, B, every one different."""
    return np.random.default_rng(4).integers(0, 255, (FRAMES, HEIGHT, WIDTH, 3)).astype(dtype)


def depths() -> np.ndarray:
    """z-depth in metres, 0 = unknown."""
    z = np.random.default_rng(5).uniform(0.005, 0.09, (FRAMES, HEIGHT, WIDTH))
    z[:, :2] = 0
    return z


def write(path: Path, image: np.ndarray) -> None:
    """An image whose channels are R, G, B and perhaps alpha."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image if image.ndim == 2 else image[..., [2, 1, 0, *range(3, image.shape[2])]])


def rows(values: np.ndarray, delimiter: str = ",") -> str:
    return "".join(delimiter.join(f"{v:.12g}" for v in row) + "\n" for row in values)


def unity(T: np.ndarray, unit_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Left-handed position and quaternion x, y, z, w, by the rule for components (not by matrices)."""
    x, y, z, w = Rotation.from_matrix(T[:, :3, :3]).as_quat().T
    return T[:, :3, 3] * [1, -1, 1] / unit_m, np.stack([-x, y, -z, w], axis=1)


def endoslam(folder: Path) -> Sample:
    root, images = folder / PATIENT, pictures()
    for k in range(FRAMES):
        write(root / "Frames" / f"image_{k:04d}.png", images[k])
        grey = np.full((HEIGHT, WIDTH, 4), 10 * k + 5, np.uint8)
        write(root / "Pixelwise Depths" / f"aov_image_{k:04d}.png", grey)
    unity_poses(root / "Poses" / "stomach_position_rotation.csv", poses(), 0.1)
    return Sample(root, Declared(), images=images)


def unity_poses(path: Path, T: np.ndarray, unit_m: float) -> None:
    """With a last line that the simulator never finished."""
    path.parent.mkdir(parents=True, exist_ok=True)
    position, quaternion = unity(T, unit_m)
    table = np.hstack([position, quaternion, np.array(SECONDS)[:, None]])
    path.write_text("tX,tY,tZ,rX,rY,rZ,rW,time(s)\n" + rows(table) + "0.86,9.27,-1.89,0.62,0.1,0.1,0.7,51.4")


def vrcaps(folder: Path) -> Sample:
    """Metres are declared, so that depth and truth can be had."""
    root, images, z = folder / PATIENT, pictures(), depths()
    near, far, unit_m = 0.01, 2.0, 0.1
    with np.errstate(divide="ignore"):
        v = np.where(z > 0, near * (far * unit_m - z) / (z * (far - near)), 0)  # solved for v, n and f in metres
    counts = np.round(255 * v).astype(np.uint8)
    for k in range(FRAMES):
        write(root / f"image_{k:04d}.png", images[k])
        write(root / f"aov_image_{k:04d}.png", np.dstack([counts[k]] * 3 + [np.full((HEIGHT, WIDTH), k + 1, np.uint8)]))
    T_world_camera = poses()
    unity_poses(root / "position_rotation.csv", T_world_camera @ np.linalg.inv(T_BODY_CAMERA), unit_m)
    declared = Declared(Calibration(CAMERA, T_BODY_CAMERA), unit_m=unit_m, depth_planes=(near, far))
    return Sample(root, declared, T_world_camera, z, depth_tolerance_m=0.5 * 0.09**2 / (255 * near * unit_m) * 1.1,
                  images=images)


def c3vd(folder: Path, version: int) -> Sample:
    root, images, z, T = folder / PATIENT, pictures(), depths(), poses()
    counts = np.round(z / 0.1 * 65535).astype(np.uint16)
    counts[:, 2] = 65535
    z[:, 2] = 0
    for k in range(FRAMES):
        write(root / (f"{k:04d}_color.png" if version == 1 else f"rgb/{k:04d}.png"), images[k])
        write(root / (f"{k:04d}_depth.tiff" if version == 1 else f"depth/{k:04d}_depth.tiff"), counts[k])
        write(root / f"{k:04d}_occlusion.png", images[k, ..., 0])
    in_mm = T.copy()
    in_mm[:, :3, 3] *= 1000
    order = in_mm.transpose(0, 2, 1) if version == 1 else in_mm
    (root / "pose.txt").write_text(rows(order.reshape(-1, 16)))
    declared = Declared(Calibration(CAMERA))
    seconds = tuple(k * 1001 / 30000 for k in range(FRAMES))
    return Sample(root, declared, T, z, 0.5 * 0.1 / 65535 * 1.01, images, seconds)


def simcol3d(folder: Path) -> Sample:
    root, images, z, T = folder / PATIENT / "Frames_S1", pictures(), depths(), poses()
    steps = np.round(z * 100 / 20 * 255).astype(np.uint16)
    steps[:, 3] = 255
    z[:, 3] = 0
    for k in range(FRAMES):
        with_alpha = np.dstack([images[k], np.full((HEIGHT, WIDTH), 255)]).astype(np.uint16) * 256
        write(root / f"FrameBuffer_{k:04d}.png", with_alpha)
        write(root / f"Depth_{k:04d}.png", steps[k] * 256)
    position, quaternion = unity(T, 0.01)
    (root.parent / "SavedPosition_S1.txt").write_text(rows(position, " "))
    (root.parent / "SavedRotationQuaternion_S1.txt").write_text(rows(quaternion, " "))
    (root.parent / "cam.txt").write_text("20 0 15.5\n0 21 11.5\n0 0 1\n")
    seconds = tuple(k / 10 for k in range(FRAMES))
    return Sample(root, Declared(rate_hz=10), T, z, 0.5 * 0.2 / 255 * 1.01, images, seconds)


def scared(folder: Path) -> Sample:
    root, images, z, T = folder / PATIENT, pictures(), depths(), poses()
    for k in range(FRAMES):
        write(root / "data" / "left" / f"frame_data{k:06d}.png", images[k])
        points = np.zeros((2 * HEIGHT, WIDTH, 3), np.float32)
        points[:HEIGHT, :, 2] = np.where(z[k] > 0, 1000 * z[k], 0 if k % 2 else np.nan)  # x, y, z in file order
        points[HEIGHT:, :, 2] = 7
        write(root / "data" / "scene_points" / f"scene_points{k:06d}.tiff", points)
        T_camera_world = np.linalg.inv(T[k])
        T_camera_world[:3, 3] *= 1000
        note = {"camera-pose": T_camera_world.tolist(), "timestamp": 0, "camera-calibration": {
            "KL": [[20, 0, 15.5], [0, 21, 11.5], [0, 0, 1]], "DL": [[0.01, -0.02, 0.001, 0.0, 0.003]]}}
        (root / "data" / "frame_data").mkdir(exist_ok=True)
        (root / "data" / "frame_data" / f"frame_data{k:06d}.json").write_text(json.dumps(note))
    return Sample(root, Declared(rate_hz=25), T, z, 1e-8, images, tuple(k / 25 for k in range(FRAMES)))


def tum_rgbd(folder: Path) -> Sample:
    root, images, z, T = folder / PATIENT, pictures(), depths(), poses()
    first = 1_305_031_102
    colour, depth = ["# timestamp filename"], ["# timestamp filename"]
    for k, s in enumerate(SECONDS):
        write(root / "rgb" / f"{k}.png", images[k])
        colour.append(f"{first + s:.6f} rgb/{k}.png")
        write(root / "depth" / f"{k}.png", np.round(z[k] * 5000).astype(np.uint16))
        depth.append(f"{first + s + (0.015 if k != 4 else 0.03):.6f} depth/{k}.png")
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    truth = [f"{first + s:.6f} {' '.join(f'{v:.12g}' for v in (*T[k, :3, 3], *quaternion[k]))}"
             for k, s in enumerate(SECONDS)]
    for name, lines in (("rgb", colour), ("depth", depth), ("groundtruth", ["# t", *truth, truth[-1]])):
        (root / f"{name}.txt").write_text("\n".join(lines) + "\n")
    return Sample(root, Declared(Calibration(CAMERA)), T, z, 0.5 / 5000 * 1.01, images)


def jhu_sinus(folder: Path) -> Sample:
    root, T = folder / PATIENT, poses()
    numbers = [4584, 4585, 4586, 4588, 4589, 4591]
    images = []
    for k, number in enumerate(numbers):
        write(root / f"{number:08d}.jpg", pictures()[k])
        images.append(cv2.imread(str(root / f"{number:08d}.jpg"))[..., ::-1])
    write(root / "undistorted_mask.jpg", pictures()[0])
    quaternion = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    motion = {f"poses[{k}]": {"position": dict(zip("xyz", (T[k, :3, 3] / 0.02).tolist(), strict=True)),
                              "orientation": dict(zip("xyzw", quaternion[k].tolist(), strict=True))}
              for k in range(FRAMES)}
    (root / "motion.yaml").write_text(yaml.safe_dump({"header": None, "poses[]": motion}, sort_keys=False))
    (root / "visible_view_indexes").write_text("\n".join(map(str, numbers)) + "\n")
    (root / "camera_intrinsics_per_view").write_text("20\n21\n15.5\n11.5\n")
    return Sample(root, Declared(rate_hz=20, unit_m=0.02), T, images=np.array(images),
                  seconds=tuple((n - numbers[0]) / 20 for n in numbers))


def kitti(folder: Path) -> Sample:
    root, images, T = folder / PATIENT / "sequences" / "00", pictures(), poses()
    for k in range(FRAMES):
        write(root / "image_2" / f"{k:06d}.png", images[k])
    P2 = np.array([[20, 0, 15.5, 20 * 0.06], [0, 21, 11.5, 0], [0, 0, 1, 0.0]])  # 6 cm beside camera 0
    P0 = np.where(np.arange(4) < 3, P2, 0)
    lines = [f"{name}: " + " ".join(f"{v:.6e}" for v in P.ravel()) for name, P in (("P0", P0), ("P2", P2), ("Tr", P0))]
    (root / "calib.txt").write_text("\n".join(lines) + "\n")
    (root / "times.txt").write_text("".join(f"{s:.6e}\n" for s in SECONDS))
    T_camera_cam0 = np.eye(4)
    T_camera_cam0[0, 3] = 0.06
    (root.parent.parent / "poses").mkdir()
    cam0 = T @ T_camera_cam0
    (root.parent.parent / "poses" / "00.txt").write_text(rows(cam0[:, :3].reshape(-1, 12), " "))
    return Sample(root, Declared(), T, images=images)


def own_images(folder: Path) -> Sample:
    root, images = folder / PATIENT, pictures()
    lines = ["t_ms;filename"]
    for k, s in enumerate(SECONDS):
        write(root / "shots" / f"{k}.png", images[k])
        lines.append(f"{1000 * s:.2f};shots/{k}.png")
    (root / "frames.csv").write_text("\n".join(lines))
    imu_and_kalibr(root)
    return Sample(root, Declared(), images=images)


def imu_and_kalibr(root: Path) -> None:
    """An IMU in degrees and g, and where the camera sits on it."""
    gyro, accel = imu_values()
    table = np.hstack([IMU_S[:, None], np.degrees(gyro), accel / 9.80665])
    title = "t_s,gyro_x_deg_s,gyro_y_deg_s,gyro_z_deg_s,accel_x_g,accel_y_g,accel_z_g\n"
    (root / "imu.csv").write_text(title + rows(table))
    chain = {"cam0": {
        "camera_model": "pinhole", "intrinsics": [20.0, 21.0, 15.5, 11.5], "distortion_model": "radtan",
        "distortion_coeffs": [0.01, -0.02, 0.001, 0.0], "resolution": [WIDTH, HEIGHT], "rostopic": "/cam0",
        "T_cam_imu": np.linalg.inv(T_BODY_CAMERA).tolist(), "timeshift_cam_imu": 0.0125}}
    (root / "camchain.yaml").write_text(yaml.safe_dump(chain))
    noise = {"accelerometer_noise_density": 2e-3, "accelerometer_random_walk": 3e-4, "gyroscope_noise_density": 1.5e-4,
             "gyroscope_random_walk": 2e-6, "update_rate": 40.0, "rostopic": "/imu0"}
    (root / "imu.yaml").write_text(yaml.safe_dump(noise))


def imu_values() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(6)
    return rng.normal(0, 0.2, (len(IMU_S), 3)), rng.normal([0, 0, 9.81], 0.1, (len(IMU_S), 3))


def own_video(folder: Path) -> Sample:
    """Lossless, and its container claims 30 frames per second."""
    root, images = folder / PATIENT, pictures()
    root.mkdir(parents=True)
    film(root / "film.avi", images)
    (root / "frames.csv").write_text("t_s\n" + "".join(f"{s}\n" for s in SECONDS))
    imu_and_kalibr(root)
    return Sample(root, Declared(), images=images)


def film(path: Path, images: np.ndarray, codec: str = "FFV1") -> None:
    size = images.shape[2], images.shape[1]
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*codec), 30, size)
    assert writer.isOpened()
    for image in images:
        writer.write(np.ascontiguousarray(image[..., ::-1]))
    writer.release()


SAMPLES: dict[str, Callable[[Path], Sample]] = {
    "endoslam": endoslam, "vrcaps": vrcaps, "c3vd": lambda folder: c3vd(folder, 1),
    "c3vd v2": lambda folder: c3vd(folder, 2), "simcol3d": simcol3d, "scared": scared, "tum-rgbd": tum_rgbd,
    "jhu-sinus": jhu_sinus, "kitti": kitti, "images": own_images, "video": own_video,
}
