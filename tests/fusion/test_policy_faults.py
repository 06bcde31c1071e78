"""What is refused, with exactly one line that says what, where and what to do; and what is done when a solver fails."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fusion import RefineConfig, refine
from fusion.estimate import motions_estimate
from fusion.graph_estimator import GraphEstimator
from fusion.problem import build_problem
from vio import se3
from vio.calibration import Calibration
from vio.errors import EstimationError, GeometryError, ImuError, MotionsError, RecordingError, VioError
from vio.imu import ImuSamples
from vio.metrics import ate
from vio.motions import RelativeMotions, load_motions
from vio.recording import Recording
from vio.simulation import SIMULATED_IMU, T_BODY_CAMERA


@dataclass
class Case:
    """A recording and motions as plain arrays that a fault may spoil."""

    frame_t_ns: np.ndarray
    imu_t_ns: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    calibration: Calibration
    t_i: np.ndarray
    t_j: np.ndarray
    T_i_j: np.ndarray
    cov: np.ndarray
    log_mean: float = -0.2
    log_sd: float = 0.1

    def refine(self):
        recording = Recording("case", self.frame_t_ns, ImuSamples(self.imu_t_ns, self.gyro, self.accel),
                              self.calibration)
        motions = RelativeMotions(self.t_i, self.t_j, self.T_i_j, self.cov, self.log_mean, self.log_sd)
        return refine(recording, motions)


@pytest.fixture
def case(short) -> Case:
    recording, motions = short.recording, short.motions
    arrays = (recording.frame_t_ns, recording.imu.t_ns, recording.imu.gyro_rad_s, recording.imu.accel_m_s2)
    return Case(*(x.copy() for x in arrays), recording.calibration,
                *(x.copy() for x in (motions.t_i_s, motions.t_j_s, motions.T_i_j, motions.cov)))


def set_at(array: str, index, value) -> Callable[[Case], None]:
    def spoil(case: Case) -> None:
        getattr(case, array)[index] = value

    return spoil


def change(**factors: float) -> Callable[[Case], None]:
    """Multiply whole arrays."""
    def spoil(case: Case) -> None:
        for name, factor in factors.items():
            setattr(case, name, getattr(case, name) * factor)

    return spoil


def keep(*names: str, where: slice | list) -> Callable[[Case], None]:
    def spoil(case: Case) -> None:
        for name in names:
            setattr(case, name, getattr(case, name)[where])

    return spoil


IMU = ("imu_t_ns", "gyro", "accel")
MOTIONS = ("t_i", "t_j", "T_i_j", "cov")


def swap_rows(case: Case) -> None:
    case.imu_t_ns[[100, 101]] = case.imu_t_ns[[101, 100]]


def stop_gravity(case: Case) -> None:
    case.accel = np.random.default_rng(0).normal(0, 0.05, case.accel.shape)


def mirror(case: Case) -> None:
    case.T_i_j[7, :3, :3] = np.diag([1, 1, -1.0])


def saturate(case: Case) -> None:
    case.gyro[200:300, 1] = case.calibration.imu_noise.gyro_range_rad_s


def transpose_all(case: Case) -> None:
    case.T_i_j = np.swapaxes(case.T_i_j, 1, 2).copy()


def late_clock(case: Case) -> None:
    case.calibration = replace(case.calibration, time_offset_s=5.0)


FAULTS = {
    "NaN gyro": (set_at("gyro", (50, 2), np.nan), ImuError, ["imu row 50", "gyro z", "not finite", "drop"]),
    "infinite accelerometer": (set_at("accel", (7, 0), np.inf), ImuError, ["imu row 7", "accelerometer x", "drop"]),
    "unsorted stamps": (swap_rows, ImuError, ["imu row 101", "is earlier than", "sort"]),
    "reversed stamps": (keep("imu_t_ns", where=slice(None, None, -1)), ImuError, ["imu row 1", "is earlier than"]),
    "duplicate stamp": (lambda c: set_at("imu_t_ns", 31, c.imu_t_ns[30])(c), ImuError,
                        ["imu row 31", "repeats", "drop duplicates"]),
    "gyro in deg/s": (change(gyro=180 / np.pi), ImuError, ["deg/s", "multiply", "pi/180"]),
    "accelerometer in g": (change(accel=1 / 9.80665), ImuError, ["looks like g", "multiply", "9.80665"]),
    "accelerometer in mg": (change(accel=1000 / 9.80665), ImuError, ["looks like mg", "multiply"]),
    "no gravity": (stop_gravity, ImuError, ["no gravity", "specific force", "limits 7.5 to 12.5"]),
    "saturated axis": (saturate, ImuError, ["gyro y", "full scale", "limit 5 %", "larger range"]),
    "IMU starts late": (keep(*IMU, where=slice(100, None)), ImuError, ["imu covers", "frames run", "whole IMU log"]),
    "IMU ends early": (keep(*IMU, where=slice(0, 300)), ImuError, ["imu covers", "frames run", "whole IMU log"]),
    "wrong time offset": (late_clock, ImuError, ["imu covers", "frames run"]),
    "no IMU": (keep(*IMU, where=slice(0, 0)), ImuError, ["imu: 0 samples", "covers all frames"]),
    "wrong IMU shape": (lambda c: setattr(c, "gyro", c.gyro[:-1]), ImuError, ["stamps but gyro_rad_s", "expected"]),
    "rotation not orthonormal": (set_at("T_i_j", (3, 0, 0), 2.0), GeometryError, ["T_i_j[3]", "not a rigid"]),
    "mirrored rotation": (mirror, GeometryError, ["T_i_j[7]", "handedness"]),
    "transposed transforms": (transpose_all, GeometryError, ["T_i_j[0]", "row/column order"]),
    "NaN motion": (set_at("T_i_j", (4, 1, 3), np.nan), GeometryError, ["T_i_j[4]", "not finite"]),
    "covariance not positive": (set_at("cov", (5, 2, 2), -1e-6), GeometryError, ["cov[5]", "positive definite"]),
    "covariance singular": (set_at("cov", 6, np.ones((6, 6))), GeometryError, ["cov[6]", "positive definite"]),
    "covariance not symmetric": (set_at("cov", (2, 0, 1), 1.0), GeometryError, ["cov[2]", "positive definite"]),
    "NaN covariance": (set_at("cov", (9, 3, 3), np.nan), GeometryError, ["cov[9]", "not finite"]),
    "motions on another clock": (lambda c: (change(t_i=1)(c), set_at("t_i", slice(None), c.t_i + 0.01)(c)),
                                 MotionsError, ["motions[0]", "matches no frame", "limit 0.001 s", "first frame"]),
    "motions in nanoseconds": (change(t_i=1e9, t_j=1e9), MotionsError, ["matches no frame", "seconds after"]),
    "motion backwards in time": (lambda c: set_at("t_j", 8, c.t_i[8])(c), MotionsError, ["motions[8]", "not before"]),
    "no motions": (keep(*MOTIONS, where=slice(0, 0)), MotionsError, ["motions: empty", "at least one"]),
    "shapes disagree": (keep("t_i", where=slice(1, None)), MotionsError, ["shapes", "expected (N,)"]),
    "scale prior negative": (lambda c: setattr(c, "log_sd", -0.1), MotionsError, ["scale prior", "sd ≥ 0"]),
    "scale prior NaN": (lambda c: setattr(c, "log_mean", np.nan), MotionsError, ["scale prior", "finite"]),
    "one frame": (keep("frame_t_ns", where=slice(0, 1)), RecordingError, ["1 frame", "at least 2"]),
    "no frame": (keep("frame_t_ns", where=slice(0, 0)), RecordingError, ["no frames"]),
    "frames out of order": (keep("frame_t_ns", where=slice(None, None, -1)), RecordingError, ["frame 1", "sort"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_cannot_be_used_is_refused_in_one_line(case, fault):
    spoil, kind, words = FAULTS[fault]
    spoil(case)
    with pytest.raises(VioError) as caught:
        case.refine()
    assert type(caught.value) is kind, repr(caught.value)
    assert caught.value.exit_code == 3
    message = str(caught.value)
    assert "\n" not in message and len(message) < 300
    for word in words:
        assert word in message, message


def test_what_was_spoiled_is_what_was_refused(case):
    """The faults start from a case that is fine."""
    refined = case.refine()
    assert refined.estimator == "graph" and len(refined.trajectory) == 36


def test_clipped_samples_widen_their_intervals_only(examine):
    """A gyro whose range the tumbles exceed in 1 % of the samples."""
    whole, clipped = (examine("stomach", "none", 0, 60.0, 16, noise=replace(SIMULATED_IMU, gyro_range_rad_s=full_scale))
                      for full_scale in (35.0, 0.9))
    at_limit = (np.abs(clipped.recording.imu.gyro_rad_s) >= 0.9).any(axis=1)
    assert 0.01 < at_limit.mean() < 0.02
    problems = [build_problem(case.recording, case.motions) for case in (whole, clipped)]
    ratio = problems[1].gyro_inflation / problems[0].gyro_inflation
    hit = np.unique(np.searchsorted(problems[0].t_s, clipped.recording.imu_t_s[at_limit]) - 1)
    hit = hit[(hit >= 0) & (hit < len(ratio))]
    assert len(hit) >= 2 and (ratio[hit] > 10).all()
    assert (np.delete(ratio, hit) < 2).all()
    np.testing.assert_array_equal(problems[1].accel_inflation, problems[0].accel_inflation)
    refined = refine(clipped.recording, clipped.motions)
    assert refined.estimator == "graph"
    assert ate(refined.trajectory, refined.truth).rmse_m < ate(refined.motions_only, refined.truth).rmse_m


@pytest.mark.parametrize("key", ["t_i", "cov", "scale_log_sd"])
def test_a_motions_file_without_a_key_names_it(short, tmp_path, key):
    short.motions.save(tmp_path / "motions.npz")
    arrays = dict(np.load(tmp_path / "motions.npz"))
    del arrays[key]
    np.savez(tmp_path / "less.npz", **arrays)
    with pytest.raises(MotionsError, match=rf"less\.npz: missing key '{key}'; required are t_i"):
        load_motions(tmp_path / "less.npz")


def test_motions_survive_their_file(short, tmp_path):
    short.motions.save(tmp_path / "motions.npz")
    again = load_motions(tmp_path / "motions.npz")
    a, b = (refine(short.recording, motions) for motions in (short.motions, again))
    np.testing.assert_allclose(a.trajectory.T_world_body, b.trajectory.T_world_body, atol=1e-9)


# ---- the policy ------------------------------------------------------------------------------

def refuse(message):
    def estimate(*_args, **_kwargs):
        raise EstimationError(message)

    return estimate


def test_forced_ekf_has_no_reason_to_explain(short, configured):
    refined = refine(short.recording, short.motions, configured(estimator="ekf"))
    assert refined.estimator == "ekf" and refined.fallback_reason is None
    assert refined.imu.chi2_per_dof is None


def test_auto_falls_to_the_filter_and_says_why(short, monkeypatch):
    monkeypatch.setattr(GraphEstimator, "estimate", refuse("graph: the cost is nan"))
    refined = refine(short.recording, short.motions)
    assert (refined.estimator, refined.fallback_reason) == ("ekf", "graph: the cost is nan")
    forced = refine(short.recording, short.motions, RefineConfig(estimator="ekf"))
    np.testing.assert_array_equal(refined.trajectory.T_world_body, forced.trajectory.T_world_body)


def test_auto_falls_to_the_motions_and_says_why(short, monkeypatch):
    monkeypatch.setattr(GraphEstimator, "estimate", refuse("graph: one"))
    monkeypatch.setattr(importlib.import_module("fusion.refine"), "ekf_estimate", refuse("ekf: two"))
    refined = refine(short.recording, short.motions)
    assert (refined.estimator, refined.fallback_reason) == ("motions", "graph: one; ekf: two")
    np.testing.assert_allclose(refined.trajectory.T_world_body, refined.motions_only.T_world_body, atol=1e-12)
    assert refined.scale.policy == "fixed" and len(refined.rejected) == 0


def test_covariance_of_the_chain_is_that_of_samples(short):
    """Every motion, the scale and the first tilt drawn from what is claimed about them."""
    rng, motions, tilt_sd = np.random.default_rng(1), short.motions, 0.02
    vague = replace(motions, T_i_j=motions.T_i_j @ se3.exp([0, 0, 0.1, 0, 0, 0.01]), cov=9 * motions.cov)
    twice = RelativeMotions(*(np.concatenate([getattr(m, name) for m in (motions, vague)])
                              for name in ("t_i_s", "t_j_s", "T_i_j", "cov")), motions.scale_log_mean,
                            motions.scale_log_sd)  # the surer of two motions of a pair counts, whatever their order
    first = short.recording.truth.T_world_body[0]
    estimate = motions_estimate(build_problem(short.recording, twice), twice, first, tilt_sd)
    lower = np.linalg.cholesky(motions.cov)
    xi = []
    for _ in range(1500):
        T = motions.T_i_j @ se3.exp((lower @ rng.standard_normal((len(motions), 6, 1)))[:, :, 0])
        T[:, :3, 3] *= np.exp(motions.scale_log_mean + motions.scale_log_sd * rng.standard_normal())
        body = T_BODY_CAMERA @ T @ se3.inverse(T_BODY_CAMERA)
        start = se3.transform(se3.so3_exp([*(tilt_sd * rng.standard_normal(2)), 0.0]), np.zeros(3)) @ first
        start[:3, 3] = first[:3, 3]
        xi.append(se3.log(se3.inverse(estimate.T_world_body) @ se3.chain(body, start)))
    sampled = np.einsum("sni,snj->nij", np.array(xi), np.array(xi)) / len(xi)
    for k in (1, 5, 20, 35):
        root = np.linalg.inv(np.linalg.cholesky(estimate.cov[k]))
        np.testing.assert_allclose(np.linalg.eigvalsh(root @ sampled[k] @ root.T), 1.0, atol=0.25)


def test_a_forced_graph_that_fails_is_an_error(short, configured, monkeypatch):
    monkeypatch.setattr(GraphEstimator, "estimate", refuse("graph: the cost is nan"))
    with pytest.raises(EstimationError, match=r"^graph: the cost is nan$") as caught:
        refine(short.recording, short.motions, configured(estimator="graph"))
    assert caught.value.exit_code == 4


def test_a_forced_filter_that_fails_is_an_error(examination, configured):
    with pytest.raises(EstimationError, match=r"^ekf: .* looked like outliers"):
        refine(examination.shaken_unseen(0.02, 1.7), examination.motions, configured(estimator="ekf"))


@pytest.mark.parametrize(("spoil", "words"), [
    (lambda e: replace(e, T_world_body=e.T_world_body * np.nan), "not finite"),
    (lambda e: replace(e, cov=-e.cov), "variance is"),
    (lambda e: replace(e, cov=np.full_like(e.cov, np.inf)), "not finite"),
])
def test_numbers_that_are_no_answer_are_stepped_over(short, monkeypatch, spoil, words):
    estimate = GraphEstimator.estimate
    monkeypatch.setattr(GraphEstimator, "estimate", lambda self: spoil(estimate(self)))
    refined = refine(short.recording, short.motions)
    assert refined.estimator == "ekf"
    assert refined.fallback_reason.startswith("graph: ") and words in refined.fallback_reason


def test_without_any_usable_imu_the_motions_still_lead(examination):
    """A sample every 1.1 s leaves a gap in every frame interval: the graph says so, the filter coasts on motions."""
    every = np.arange(0, len(examination.recording.imu), 45)
    sparse = examination.with_samples(every)
    assert not build_problem(sparse, examination.motions).imu_usable.any()
    refined = refine(sparse, examination.motions)
    assert refined.estimator in ("ekf", "motions")
    assert refined.fallback_reason.startswith("graph: no frame interval has usable IMU data")
    assert ate(refined.trajectory, refined.truth).rmse_m < 1.5 * ate(refined.motions_only, refined.truth).rmse_m


def test_a_source_that_scales_quick_motion_otherwise_is_believed_less(examination, refined):
    """It widens scale, path and pose; it changes no estimate."""
    motions = replace(examination.motions, meta={"scale_gain_sd": 0.2})
    wide = refine(examination.recording, motions)
    assert wide.scale.policy == refined.scale.policy and "quick motion" in wide.scale.reason
    assert wide.scale.log_sd == pytest.approx(np.hypot(refined.scale.log_sd, 0.2))
    np.testing.assert_allclose(wide.trajectory.T_world_body, refined.trajectory.T_world_body, atol=1e-12)
    assert wide.trajectory.cov[-1, 3:, 3:].trace() > 2 * refined.trajectory.cov[-1, 3:, 3:].trace()
    assert wide.joint.log_scale[:, 5].std() == pytest.approx(wide.log_scale_sd[5], rel=0.1)
    for wrong in (-0.1, "0.2", float("nan")):
        with pytest.raises(MotionsError, match="scale_gain_sd"):
            refine(examination.recording, replace(examination.motions, meta={"scale_gain_sd": wrong}))
