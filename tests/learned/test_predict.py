"""The streaming driver, with a predictor of a few lines in place of a network."""

import gc
import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import learned
from learned.windows import ImuWindows
from vio.calibration import Calibration
from vio.camera import Camera
from vio.errors import ConfigError, ImuError, OutputError, RecordingError
from vio.imu import ImuNoise, ImuSamples
from vio.motions import RelativeMotions, load_motions
from vio.recording import Recording

HEIGHT, WIDTH, FRAMES = 23, 37, 13
SHIFT_PX = np.cumsum([0, 1, 1, 2, 0, -1, 2, 1, 1, 1, -2, 1, 2]) + 6  # column of the bright bar in every frame


@dataclass
class BarShift:
    """Translation x = how far the bright bar moved between the frames, in pixels; depth = 1 + red channel."""

    baselines: tuple[int, ...] = (1,)
    image_size: tuple[int, int] | None = None
    imu_samples_per_item: int = 4
    imu_rate_hz: float = 40.0
    scale_log_mean: float = float(np.log(1e-3))
    scale_log_sd: float = 0.2
    card: dict[str, str] = field(default_factory=lambda: {"method": "bar shift"})
    with_depth: bool = True
    break_at: int | None = None
    """Number of the pair whose covariance comes out as NaN."""
    calls: list[int] = field(default_factory=list)
    live: list[int] = field(default_factory=list)
    """Frames in memory at every call."""

    def predict(self, frames_i, frames_j, imu_windows):
        assert frames_i.shape == frames_j.shape and frames_i.dtype == torch.float32
        assert frames_i.min() >= 0 and frames_i.max() <= 1
        assert imu_windows.shape == (len(frames_i), self.imu_samples_per_item, 6)
        self.live.append(sum(type(o) is torch.Tensor and o.shape == frames_i.shape[1:] for o in gc.get_objects()))
        column = torch.arange(frames_i.shape[3]) * (WIDTH / frames_i.shape[3])
        bar_i, bar_j = ((f[:, 0].mean(1) * column).sum(1) / f[:, 0].mean(1).sum(1) for f in (frames_i, frames_j))
        T = torch.eye(4).repeat(len(frames_i), 1, 1)
        T[:, 0, 3] = bar_j - bar_i
        cov = torch.eye(6).repeat(len(frames_i), 1, 1) * 1e-4
        if self.break_at is not None and sum(self.calls) <= self.break_at < sum(self.calls) + len(cov):
            cov[self.break_at - sum(self.calls), 2, 2] = torch.nan
        self.calls.append(len(frames_i))
        snr = imu_windows[..., 5].mean(1) if self.imu_samples_per_item else None
        return learned.PairPrediction(T, cov, snr, 1 + frames_i[:, 0] if self.with_depth else None)


class CountedRecording(Recording):
    """Counts how often every frame is read."""

    def frame(self, k):
        self.provenance.setdefault("reads", []).append(k)
        return super().frame(k)


@pytest.fixture
def recording(tmp_path: Path) -> Recording:
    rng = np.random.default_rng(5)
    t_ns = 1_700_000_000_000_000_000 + np.cumsum(rng.integers(200, 400, FRAMES)) * 1_000_000
    paths = []
    for k, shift in enumerate(SHIFT_PX):
        image = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        image[:, shift : shift + 2, 2] = 200  # red in OpenCV's order
        paths.append(tmp_path / f"{k:02d}.png")
        cv2.imwrite(str(paths[-1]), image)
    imu_t_ns = np.arange(t_ns[0] - 10_000_000, t_ns[-1] + 30_000_000, 25_000_000)
    accel = np.zeros((len(imu_t_ns), 3))
    accel[:, 2] = np.arange(len(imu_t_ns))  # every sample can be told from the others
    imu = ImuSamples(imu_t_ns, np.zeros((len(imu_t_ns), 3)), accel)
    camera = Camera("pinhole", WIDTH, HEIGHT, 30.0, 30.0, 18.0, 11.0, (0.0,) * 4)
    return CountedRecording("bars", t_ns, imu, Calibration(camera, np.eye(4), ImuNoise()), frame_paths=tuple(paths))


def test_motions_are_right_in_order_and_at_their_frames(recording: Recording) -> None:
    motions = learned.predict(recording, BarShift())
    assert isinstance(motions, RelativeMotions)
    np.testing.assert_allclose(motions.T_i_j[:, 0, 3], np.diff(SHIFT_PX), atol=1e-4)
    np.testing.assert_array_equal(motions.t_i_s, recording.frame_t_s[:-1])
    np.testing.assert_array_equal(motions.t_j_s, recording.frame_t_s[1:])
    assert (motions.scale_log_mean, motions.scale_log_sd, motions.depth) == (BarShift().scale_log_mean, 0.2, None)
    # The window's centre is frame i: sample number = time over period, off by less than one sample's cell.
    expected = (recording.frame_t_ns[:-1] - recording.imu.t_ns[0]) / 25e6
    np.testing.assert_allclose(motions.snr[1:-1], expected[1:-1], atol=0.51)
    assert motions.meta["predictor"] == {"method": "bar shift"} and motions.meta["imu_windows_over_gaps"] == 0


@pytest.mark.parametrize("batch_size", [1, 5, 12, 100])
def test_batch_size_changes_nothing(recording: Recording, tmp_path: Path, batch_size: int) -> None:
    results = [learned.predict(recording, BarShift(baselines=(3, 1)), batch_size=size, depth_dir=tmp_path / f"d{size}")
               for size in (4, batch_size)]
    for name in ("t_i_s", "t_j_s", "T_i_j", "cov", "snr"):
        np.testing.assert_array_equal(getattr(results[0], name), getattr(results[1], name))
    assert [f.name for f in results[0].depth] == [f.name for f in results[1].depth]
    assert all(a.read_bytes() == b.read_bytes() for a, b in zip(results[0].depth, results[1].depth, strict=True))


def test_wider_baselines(recording: Recording) -> None:
    motions = learned.predict(recording, BarShift(baselines=(3, 1)), batch_size=4)
    i, j = (np.searchsorted(recording.frame_t_s, t - 1e-6) for t in (motions.t_i_s, motions.t_j_s))
    expected = [(k - b, k) for k in range(FRAMES) for b in (1, 3) if k >= b]
    assert list(zip(i.tolist(), j.tolist(), strict=True)) == expected
    np.testing.assert_allclose(motions.T_i_j[:, 0, 3], SHIFT_PX[j] - SHIFT_PX[i], atol=1e-4)


def test_every_frame_is_read_once_and_few_are_held(recording: Recording, tmp_path: Path) -> None:
    predictor, seen = BarShift(baselines=(1, 3)), []
    def progress(done: int, total: int) -> None:
        seen.append((done, total, len(recording.provenance["reads"])))
    learned.predict(recording, predictor, batch_size=2, depth_dir=tmp_path / "depth", progress=progress)
    assert recording.provenance["reads"] == list(range(FRAMES))
    total = (FRAMES - 1) + (FRAMES - 3) + 1  # the last frame's depth
    assert seen[-1][:2] == (total, total) and [done for done, _, _ in seen] == sorted(done for done, _, _ in seen)
    assert all(reads <= done // 2 + 4 for done, _, reads in seen[:-1])  # never reads ahead of the batch at work
    assert max(predictor.live) <= 2 * 2 + 3 + 1  # the batch's pairs, the widest baseline, the newest frame


def test_frames_are_resized_for_the_predictor(recording: Recording) -> None:
    motions = learned.predict(recording, BarShift(image_size=(46, 111)))
    np.testing.assert_allclose(motions.T_i_j[:, 0, 3], np.diff(SHIFT_PX), atol=0.05)


def test_depth_maps_read_back_metric_for_every_frame(recording: Recording, tmp_path: Path) -> None:
    depth = learned.predict(recording, BarShift(baselines=(2,)), depth_dir=tmp_path / "depth", depth_unit_m=1e-7).depth
    assert depth is not None and len(depth) == FRAMES
    again = replace(recording, depth_paths=depth, depth_unit_m=1e-7)
    for k, shift in enumerate(SHIFT_PX):
        expected = np.full((HEIGHT, WIDTH), 1e-3)
        expected[:, shift : shift + 2] *= 1 + 200 / 255
        np.testing.assert_allclose(again.depth_m(k), expected, atol=0.6e-7)
    rows = (tmp_path / "depth" / "data.csv").read_text().splitlines()
    assert rows[1:] == [f"{t},{t}.png" for t in recording.frame_t_ns]
    assert json.loads((tmp_path / "depth" / "prediction.json").read_text())["predictor"] == {"method": "bar shift"}


def test_depth_out_of_reach_is_unknown_not_wrapped(recording: Recording, tmp_path: Path) -> None:
    depth = learned.predict(recording, BarShift(), depth_dir=tmp_path / "depth", depth_unit_m=1.3e-3 / 65535).depth
    values = cv2.imread(str(depth[0]), cv2.IMREAD_UNCHANGED)
    assert values[0, 0] == round(65535 / 1.3) and (values[:, SHIFT_PX[0] : SHIFT_PX[0] + 2] == 0).all()


def test_a_fault_midway_leaves_nothing(recording: Recording, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(learned.PredictionError, match="cov of frames 7 to 8 is not finite"):
        learned.predict(recording, BarShift(break_at=7), batch_size=3, depth_dir=out / "depth")
    assert list(out.iterdir()) == []
    with pytest.raises(learned.PredictionError, match="predicts no depth"):
        learned.predict(recording, BarShift(with_depth=False), depth_dir=out / "depth")
    for path in recording.frame_paths[::2]:
        path.write_bytes(b"")
    with pytest.raises(RecordingError, match=r"no two frames to compare can be read; frame 0: its file is"):
        learned.predict(recording, BarShift(), depth_dir=out / "depth")
    assert list(out.iterdir()) == []


@pytest.mark.parametrize(("damage", "says"), [
    (lambda path: path.write_bytes(path.read_bytes()[:path.stat().st_size // 2]), "frame 6: its file is cut off"),
    (Path.unlink, "frame 6: its file cannot be read"),
])
def test_a_damaged_frame_loses_its_motions_and_nothing_stands_in_for_it(recording: Recording, tmp_path: Path, damage,
                                                                        says) -> None:
    whole = learned.predict(recording, BarShift(baselines=(1, 2)), depth_dir=tmp_path / "whole")
    damage(recording.frame_paths[6])
    motions = learned.predict(recording, BarShift(baselines=(1, 2)), depth_dir=tmp_path / "depth")
    t = recording.frame_t_s
    kept = (whole.t_i_s != t[6]) & (whole.t_j_s != t[6])
    np.testing.assert_array_equal(motions.t_i_s, whole.t_i_s[kept])
    np.testing.assert_array_equal(motions.T_i_j, whole.T_i_j[kept])
    assert list(motions.meta["unreadable_frames"]) == ["6"]
    assert says in motions.meta["unreadable_frames"]["6"]
    for k, (ours, theirs) in enumerate(zip(motions.depth, whole.depth, strict=True)):
        image = cv2.imread(str(ours), cv2.IMREAD_UNCHANGED)
        assert ours.name == theirs.name and image.shape == (HEIGHT, WIDTH)
        assert (image == 0).all() if k == 6 else (ours.read_bytes() == theirs.read_bytes())


def test_a_batch_too_large_for_the_accelerator_is_halved_and_said(recording: Recording, tmp_path: Path) -> None:
    class Small(BarShift):
        most: int = 2

        def predict(self, frames_i, frames_j, imu_windows):
            if len(frames_i) > self.most:
                raise torch.OutOfMemoryError("CUDA out of memory")
            return super().predict(frames_i, frames_j, imu_windows)

    whole = learned.predict(recording, BarShift(), batch_size=8)
    halved = learned.predict(recording, Small(), batch_size=8, depth_dir=tmp_path / "depth")
    np.testing.assert_array_equal(halved.T_i_j, whole.T_i_j)
    assert halved.meta["batch_size_that_fitted"] in (1, 2) and len(halved.depth) == FRAMES
    hopeless = Small()
    hopeless.most = 0
    with pytest.raises(learned.PredictionError, match="one pair of frames does not fit"):
        learned.predict(recording, hopeless)


@pytest.mark.parametrize("stopped_at", [0, 5, 9])
def test_a_stopped_prediction_goes_on_to_the_same_bytes(recording: Recording, tmp_path: Path, monkeypatch,
                                                        stopped_at: int) -> None:
    monkeypatch.setattr(sys.modules["learned.prediction_run"], "PAIRS_KEPT", 4)
    recording.frame_paths[3].write_bytes(b"")

    def predicted(name: str, predictor: BarShift) -> learned.Prediction:
        return learned.predict(recording, predictor, batch_size=2, depth_dir=tmp_path / name,
                               unfinished=tmp_path / "unfinished")

    whole = predicted("whole", BarShift())
    assert not (tmp_path / "unfinished").exists()
    with pytest.raises(learned.PredictionError, match="not finite"):
        predicted("depth", BarShift(break_at=stopped_at))
    recording.provenance.clear()
    second = BarShift()
    again = predicted("depth", second)
    assert sum(second.calls) <= FRAMES - 1 - max(0, stopped_at - 4)  # what was kept is not measured again
    for name in ("T_i_j", "cov", "t_i_s", "snr"):
        np.testing.assert_array_equal(getattr(again, name), getattr(whole, name))
    assert again.meta == whole.meta
    assert [f.read_bytes() for f in again.depth] == [f.read_bytes() for f in whole.depth]
    assert (tmp_path / "depth" / "data.csv").read_text() == (tmp_path / "whole" / "data.csv").read_text()
    assert not (tmp_path / "unfinished").exists()


def test_another_question_is_not_answered_from_what_was_kept(recording: Recording, tmp_path: Path,
                                                             monkeypatch) -> None:
    monkeypatch.setattr(sys.modules["learned.prediction_run"], "PAIRS_KEPT", 2)
    unfinished = tmp_path / "unfinished"
    with pytest.raises(learned.PredictionError):
        learned.predict(recording, BarShift(break_at=7), batch_size=2, unfinished=unfinished)
    assert len(list(unfinished.glob("*.npz"))) == 3
    other = BarShift(card={"method": "another"})
    assert len(learned.predict(recording, other, batch_size=2, unfinished=unfinished)) == sum(other.calls)
    stranger = tmp_path / "stranger"
    stranger.mkdir()
    (stranger / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="move it"):
        learned.predict(recording, BarShift(), unfinished=stranger)
    assert (stranger / "thesis.txt").read_text() == "mine"



def test_depth_of_the_recording_itself_is_never_replaced(recording: Recording, tmp_path: Path) -> None:
    original = tmp_path / "depth0"
    original.mkdir()
    (original / "sensor.yaml").write_text("depth_unit_m: 0.001\n")
    with pytest.raises(OutputError, match="choose another"):
        learned.predict(recording, BarShift(), depth_dir=original)
    assert [f.name for f in original.iterdir()] == ["sensor.yaml"]


def test_motions_file_round_trip(recording: Recording, tmp_path: Path) -> None:
    prediction = learned.predict(recording, BarShift())
    prediction.motions.save(tmp_path / "motions.npz")
    again = load_motions(tmp_path / "motions.npz")
    np.testing.assert_array_equal(again.T_i_j, prediction.T_i_j)
    assert again.meta == prediction.meta


@pytest.mark.parametrize("weights", ["somewhere/best.safetensors", Path("best.pt")])
def test_weights_that_are_not_there_are_named(recording: Recording, weights: str | Path) -> None:
    with pytest.raises(learned.WeightsError, match=f"weights {Path(weights).name}: No such file") as caught:
        learned.predict(recording, weights)
    assert "somewhere" not in str(caught.value) and caught.value.exit_code == 3
    with pytest.raises(ConfigError, match="rotation 'imu' is unknown"):
        learned.predict(recording, BarShift(), rotation="imu")


def test_unusable_input_is_refused(recording: Recording) -> None:
    def shapes(frames_i, frames_j, imu_windows):
        return learned.PairPrediction(torch.eye(4), torch.eye(6))
    wrong = BarShift()
    wrong.predict = shapes
    with pytest.raises(learned.PredictionError, match=r"T_i_j has shape \(4, 4\)"):
        learned.predict(recording, wrong)
    with pytest.raises(learned.PredictionError, match="baselines"):
        learned.predict(recording, BarShift(baselines=(0, 1)))
    with pytest.raises(RecordingError, match="too few"):
        learned.predict(recording, BarShift(baselines=(FRAMES,)))
    with pytest.raises(ConfigError, match="batch_size"):
        learned.predict(recording, BarShift(), batch_size=0)
    with pytest.raises(RecordingError, match="images are missing"):
        learned.predict(replace(recording, frame_paths=()), BarShift())
    nothing = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    with pytest.raises(ImuError, match="0 samples"):
        learned.predict(replace(recording, imu=nothing), BarShift())
    assert learned.predict(replace(recording, imu=nothing), BarShift(imu_samples_per_item=0)).snr is None


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 9), rate=st.floats(5, 200), n=st.integers(2, 30))
def test_windows_are_means_of_the_held_signal(seed: int, count: int, rate: float, n: int) -> None:
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.01, 0.08, n))
    imu = ImuSamples((t * 1e9).astype(np.int64), rng.normal(size=(n, 3)), rng.normal(size=(n, 3)))
    centre = rng.uniform(t[0] - 0.2, t[-1] + 0.2, 4)  # windows may hang over both ends
    got = ImuWindows(imu, t, [t[0], t[-1]], count, rate).at(centre)
    fine = 4000
    inside = (np.arange(count * fine) + 0.5) / fine - count / 2
    times = centre[:, None] + inside / rate
    held = np.abs(times[..., None] - t).argmin(-1)  # every instant belongs to the nearest stamp
    expected = np.hstack([imu.gyro_rad_s, imu.accel_m_s2])[held].reshape(4, count, fine, 6).mean(2)
    np.testing.assert_allclose(got, expected, atol=5 * n / fine)


def test_windows_at_the_samples_rate_are_the_samples() -> None:
    t = np.arange(100) / 40
    imu = ImuSamples((t * 1e9).astype(np.int64), np.random.default_rng(0).normal(size=(100, 3)), np.ones((100, 3)))
    window = ImuWindows(imu, t, t, 40, 40.0).at([t[49] + 0.5 / 40])[0]  # an even window is centred between samples
    np.testing.assert_allclose(window[:, :3], imu.gyro_rad_s[30:70], atol=1e-12)


def test_windows_over_gaps_are_told() -> None:
    t = np.concatenate([np.arange(0, 3, 0.025), np.arange(4, 7, 0.025)])
    imu = ImuSamples((t * 1e9).astype(np.int64), np.zeros((len(t), 3)), np.zeros((len(t), 3)))
    windows = ImuWindows(imu, t, [0, 6.9], 40, 40.0)
    np.testing.assert_array_equal(windows.over_gap([1.0, 2.6, 3.5, 4.4, 5.0]), [False, True, True, True, False])
