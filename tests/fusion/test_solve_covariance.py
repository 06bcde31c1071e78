"""Gauss-Newton and the marginals against dense algebra, other starts, and gtsam's own optimiser."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B, S, V, X
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import refine
from fusion.config import RefineConfig, SolverConfig
from fusion.covariance import marginal_covariances
from fusion.graph import add_anchor, add_imu, add_scale_walk, read_log_scales, read_states
from fusion.initialization import chunked_start
from fusion.problem import Problem, build_problem
from fusion.scale import make_segments
from fusion.solve import MotionTerm, gauss_newton, linear_graph
from vio import se3
from vio.errors import EstimationError

SEGMENT_S = 5.0


@dataclass(frozen=True)
class Setup:
    """A small graph with free scale, and the start that the chunks gave it."""

    problem: Problem
    native: gtsam.NonlinearFactorGraph
    term: MotionTerm
    start: gtsam.Values
    segments: int

    def cost(self, values, term=None):
        return self.native.error(values) + (term or self.term).cost(values)


@pytest.fixture(scope="module")
def setup(short):
    problem = build_problem(short.recording, short.motions)
    start = chunked_start(problem, RefineConfig(), problem.scale_log_mean)
    native = gtsam.NonlinearFactorGraph()
    add_anchor(native, 0, start.anchor)
    add_imu(native, start.measurements, problem)
    segments = make_segments(problem.t_s, SEGMENT_S)
    add_scale_walk(native, segments.t_s, problem.scale_log_mean, problem.scale_log_sd, 0.0055)
    values = gtsam.Values(start.values)
    for k in range(len(segments.t_s)):
        values.insert(S(k), problem.scale_log_mean)
    term = MotionTerm(problem.motions, segments.of_node[problem.motions.i], 0.0, None, np.ones(len(problem.motions)))
    assert len(segments.t_s) == 2
    return Setup(problem, native, term, values, 2)


def perturbed(setup, seed, rotation_rad, position_m):
    rng = np.random.default_rng(seed)
    values = gtsam.Values(setup.start)
    for k in range(len(setup.problem)):
        xi = np.r_[rng.normal(0, rotation_rad, 3), rng.normal(0, position_m, 3)]
        values.update(X(k), values.atPose3(X(k)).retract(xi))
    return values


@settings(max_examples=8)
@given(seed=st.integers(0, 1000), rotation_rad=st.sampled_from([0.0, 0.1, 1.0]), huber=st.sampled_from([None, 2.8]))
def test_no_iteration_raises_the_cost(setup, seed, rotation_rad, huber):
    term = replace(setup.term, huber=huber)
    values = perturbed(setup, seed, rotation_rad, 0.2 * rotation_rad)
    costs = [setup.cost(values, term)]
    for _ in range(6):
        values = gauss_newton(setup.native, values, term, 1, 0.0).values
        costs.append(setup.cost(values, term))
    assert (np.diff(costs) <= 0).all(), costs
    if rotation_rad > 0:
        assert costs[-1] < 0.9 * costs[0]


def test_every_start_ends_at_the_minimum_that_gtsams_optimiser_finds(setup):
    """The motions handed to gtsam as numeric callbacks: slow, and nothing of ours in the linearisation."""
    ours = gauss_newton(setup.native, setup.start, setup.term, 30, 1e-14).values
    elsewhere = gauss_newton(setup.native, perturbed(setup, 4, 0.1, 0.01), setup.term, 30, 1e-14).values
    assert setup.cost(elsewhere) == pytest.approx(setup.cost(ours), rel=1e-9)

    graph = gtsam.NonlinearFactorGraph(setup.native)
    for n, segment in enumerate(setup.term.segment):
        one = replace(setup.term, motions=setup.problem.motions.select(np.array([n])),
                      segment=np.zeros(1, np.int64), weight=np.ones(1))
        graph.add(_callback_factor(one, int(segment)))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, setup.start, params).optimize()
    assert setup.cost(ours) == pytest.approx(graph.error(theirs), rel=1e-7)
    assert setup.cost(ours) < setup.cost(setup.start)
    a, b = (read_states(values, 0, len(setup.problem)) for values in (ours, theirs))
    np.testing.assert_allclose(a.p, b.p, atol=1e-5)
    np.testing.assert_allclose(a.R, b.R, atol=1e-5)
    np.testing.assert_allclose(read_log_scales(ours, 2), read_log_scales(theirs, 2), atol=1e-3)


def _callback_factor(one, segment):
    i, j = int(one.motions.i[0]), int(one.motions.j[0])
    keys = [X(i), X(j), S(segment)]
    pair = replace(one, motions=replace(one.motions, i=np.array([0]), j=np.array([1])))

    def residual(poses, log_scale):
        values = gtsam.Values()
        values.insert(X(0), poses[0])
        values.insert(X(1), poses[1])
        values.insert(S(0), log_scale)
        R = np.array([pose.rotation().matrix() for pose in poses])
        p = np.array([pose.translation() for pose in poses])
        motions, s = pair.motions, log_scale
        T_bc = gtsam.Pose3(motions.T_body_camera)
        pred = T_bc.inverse() * gtsam.Pose3(gtsam.Rot3(R[0]), p[0]).between(gtsam.Pose3(gtsam.Rot3(R[1]), p[1])) * T_bc
        turn = gtsam.Rot3(motions.R[0]).between(pred.rotation())
        e_t = motions.R[0].T @ (np.exp(-s) * pred.translation() - motions.t[0])
        return motions.whiten[0] @ np.r_[gtsam.Rot3.Logmap(turn), e_t]

    def error(_, values, jacobians):
        poses, s = [values.atPose3(keys[0]), values.atPose3(keys[1])], values.atDouble(keys[2])
        r, h = residual(poses, s), 1e-6
        if jacobians is not None:
            for which in (0, 1):
                columns = []
                for axis in range(6):
                    moved = []
                    for sign in (h, -h):
                        xi = np.zeros(6)
                        xi[axis] = sign
                        moved.append(residual([pose.retract(xi) if k == which else pose
                                               for k, pose in enumerate(poses)], s))
                    columns.append((moved[0] - moved[1]) / (2 * h))
                jacobians[which] = np.array(columns, order="F").T
            jacobians[2] = ((residual(poses, s + h) - residual(poses, s - h)) / (2 * h))[:, None]
        return r

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, error)


def test_marginals_equal_the_dense_inverse_and_gtsams(setup):
    solved = gauss_newton(setup.native, setup.start, setup.term, 20, 1e-10).values
    gaussian = linear_graph(setup.native, solved, setup.term)
    m = len(setup.problem)
    cov, variance = marginal_covariances(gaussian, m, setup.segments)

    hessian = gaussian.hessian()[0]  # keys in alphabetical order: biases, scales, velocities, poses
    root = 1 / np.sqrt(np.diagonal(hessian))
    dense = root[:, None] * np.linalg.inv(root[:, None] * hessian * root) * root
    first = 6 * m + setup.segments + 3 * m
    assert len(dense) == first + 6 * m
    theirs = gtsam.Marginals(gaussian, solved)
    for k in range(m):
        block = dense[first + 6 * k:first + 6 * k + 6, first + 6 * k:first + 6 * k + 6]
        unit = np.sqrt(np.outer(np.diagonal(block), np.diagonal(block)))
        np.testing.assert_allclose(cov[k] / unit, block / unit, atol=1e-7)
        np.testing.assert_allclose(cov[k] / unit, theirs.marginalCovariance(X(k)) / unit, atol=1e-6)
    np.testing.assert_allclose(variance, np.diagonal(dense)[6 * m:6 * m + setup.segments], rtol=1e-7)
    np.testing.assert_array_equal(cov, np.swapaxes(cov, 1, 2))


def test_marginals_of_a_graph_too_stiff_for_cholesky():
    """Nodes known to 1 but tied together to 1e-9: squared, that leaves doubles nothing. Short recordings are such."""
    eye, unit = np.eye(6), gtsam.noiseModel.Unit.Create(6)
    sd = np.arange(1.0, 7.0)
    gaussian = gtsam.GaussianFactorGraph()
    gaussian.add(gtsam.JacobianFactor(X(0), np.diag(1 / sd), np.zeros(6), unit))
    for k in range(4):
        gaussian.add(gtsam.JacobianFactor(X(k), -1e9 * eye, X(k + 1), 1e9 * eye, np.zeros(6), unit))
    with pytest.raises(RuntimeError, match="Indeterminate"):
        gaussian.eliminateMultifrontal(gtsam.Ordering.MetisGaussianFactorGraph(gaussian))
    cov, _ = marginal_covariances(gaussian, 5, 0)
    np.testing.assert_allclose(cov, np.broadcast_to(np.diag(sd**2), (5, 6, 6)), rtol=1e-5, atol=1e-5)


def test_a_graph_without_a_gauge_has_no_covariance(setup):
    free = gtsam.NonlinearFactorGraph()
    for k in range(setup.native.size()):
        factor = setup.native.at(k)
        if not isinstance(factor, gtsam.PriorFactorPose3):
            free.add(factor)
    with pytest.raises(EstimationError, match="indeterminate") as caught:
        marginal_covariances(linear_graph(free, setup.start, setup.term), len(setup.problem), setup.segments)
    assert "\n" not in str(caught.value)


def test_what_is_not_finite_is_an_error_not_an_answer(setup):
    t = setup.problem.motions.t.copy()
    t[5, 1] = np.nan
    term = replace(setup.term, motions=replace(setup.problem.motions, t=t))
    with pytest.raises(EstimationError, match="cost is nan after 0 iterations"):
        gauss_newton(setup.native, setup.start, term, 5, 1e-6)
    values = gtsam.Values(setup.start)
    values.update(V(3), np.full(3, np.inf))
    with pytest.raises(EstimationError, match="cost is"):
        gauss_newton(setup.native, values, setup.term, 5, 1e-6)


@given(norm=st.floats(1e-6, 100.0), weight=st.floats(1e-6, 1.0))
def test_huber_weight_is_the_slope_of_its_loss(setup, norm, weight):
    term = replace(setup.term, huber=2.8, weight=np.full(1, weight))
    h = 1e-6 * norm
    slope = (term.losses(np.array([(norm + h)**2]))[0] - term.losses(np.array([(norm - h)**2]))[0]) / (2 * h)
    assert slope == pytest.approx(term.losses(np.array([norm**2]))[1][0] * norm, rel=1e-3)
    assert replace(term, huber=None).losses(np.array([norm**2]))[0] == pytest.approx(weight * norm**2 / 2)


@pytest.fixture(scope="module")
def long(examine):
    return examine("small-bowel", "gaussian", 2, 200.0, 202)


CHUNKS = SolverConfig(chunk_frames=150, overlap_frames=30), SolverConfig(chunk_frames=1500)


def test_chunks_lead_to_the_optimum_of_the_whole(long):
    """One problem, one linearisation of the IMU, two starts: three chunks, and none."""
    problem = build_problem(long.recording, long.motions)
    chunked, whole = (chunked_start(problem, RefineConfig(solver=solver), problem.scale_log_mean) for solver in CHUNKS)
    assert len(chunked.measurements) == len(whole.measurements) == len(problem) - 1
    native = gtsam.NonlinearFactorGraph()
    add_anchor(native, 0, whole.anchor)
    add_imu(native, whole.measurements, problem)
    term = MotionTerm(problem.motions, None, problem.scale_log_mean, 2.8, np.ones(len(problem.motions)))
    a, b = (read_states(gauss_newton(native, start.values, term, 25, 1e-13).values, 0, len(problem))
            for start in (chunked, whole))
    assert not np.array_equal(a.p, b.p)  # or it was no test
    np.testing.assert_allclose(a.p, b.p, atol=1e-6)
    np.testing.assert_allclose(a.R, b.R, atol=1e-6)
    biases = np.array([start.measurements[400].biasHat().vector() for start in (chunked, whole)])
    assert (biases[0] != biases[1]).any()


def test_chunk_size_changes_a_refinement_by_far_less_than_its_uncertainty(long, configured):
    """Not to the last digit: every chunk linearises its IMU at its own bias."""
    a, b = (refine(long.recording, long.motions, configured(solver=solver)).trajectory for solver in CHUNKS)
    off = se3.log(se3.inverse(a.T_world_body) @ b.T_world_body)
    sd = np.sqrt(np.diagonal(b.cov, axis1=1, axis2=2))
    assert 0 < np.abs(off[1:] / sd[1:]).max() < 0.02


def test_biases_are_carried_across_chunks(long, configured):
    """The start of the second chunk knows the bias that the first has found."""
    problem = build_problem(long.recording, long.motions)
    start = chunked_start(problem, configured(solver=CHUNKS[0]), problem.scale_log_mean)
    truth = long.recording.truth_state.accel_bias_m_s2
    first, later = (start.measurements[k].biasHat().accelerometer() for k in (0, 300))
    assert np.linalg.norm(first) == 0
    assert np.linalg.norm(later - truth[300]) < 0.2 * np.linalg.norm(truth[300])
    found = start.values.atConstantBias(B(450)).accelerometer()
    assert np.linalg.norm(found - truth[450]) < 0.2 * np.linalg.norm(truth[450])
