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

    def _repr_pretty_(self, printer, _cycle):
        printer.text("setup")  # or hypothesis prints all arrays with every failure

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


def test_the_loss_is_quadratic_then_straight_then_logarithmic(setup):
    term = replace(setup.term, huber=2.8, weight=np.ones(1))
    norm = np.concatenate([np.linspace(1e-3, 10, 400), np.geomspace(10.1, 1e5, 400)])
    cost, weight = (np.array(x).ravel() for x in zip(*(term.losses(np.array([n * n])) for n in norm), strict=True))
    assert (np.diff(cost) > 0).all() and (np.diff(weight) <= 1e-12).all()
    h = 1e-6
    slope = np.array([(term.losses(np.array([(n * (1 + h)) ** 2]))[0] - term.losses(np.array([(n * (1 - h)) ** 2]))[0])
                      / (2 * h * n) for n in norm])
    assert slope == pytest.approx(weight * norm, rel=1e-4)  # iteratively reweighted least squares solves this very loss
    assert slope[norm < 2.7] == pytest.approx(norm[norm < 2.7], rel=1e-6)
    assert slope[(norm > 3) & (norm < 29)] == pytest.approx(2.8, rel=1e-6)
    assert slope[norm > 31] == pytest.approx(2.8 * 30 / norm[norm > 31], rel=1e-6)


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
        assert costs[-1] < costs[0]


@pytest.mark.parametrize("loss", ["gaussian", "huber", "gated"])
def test_every_start_ends_at_the_minimum_that_gtsams_optimiser_finds(setup, loss):
    """The motions handed to gtsam as numeric callbacks: slow, and nothing of ours in residual or linearisation."""
    motions = setup.problem.motions
    t = motions.t.copy()
    for n in (5, 17, 30):  # outliers of 15 sigmas, or no loss would differ from another
        t[n] += 15 / np.linalg.norm(motions.whiten[n, :, 3:] @ np.ones(3))
    weight = np.ones(len(t))
    if loss == "gated":
        weight[[5, 17, 30]] = 1e-4
    term = replace(setup.term, motions=replace(motions, t=t), huber=2.8 if loss == "huber" else None, weight=weight)
    ours = gauss_newton(setup.native, setup.start, term, 60, 1e-14).values
    elsewhere = gauss_newton(setup.native, perturbed(setup, 4, 0.1, 0.01), term, 60, 1e-14).values
    assert setup.cost(elsewhere, term) == pytest.approx(setup.cost(ours, term), rel=1e-8)

    graph = gtsam.NonlinearFactorGraph(setup.native)
    for n in range(len(t)):
        noise = gtsam.noiseModel.Isotropic.Sigma(6, 1 / np.sqrt(weight[n]))
        if loss == "huber":
            noise = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(2.8), noise)
        graph.add(_callback_factor(term.motions, n, int(term.segment[n]), noise))
    assert graph.error(ours) == pytest.approx(setup.cost(ours, term), rel=1e-9)
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-12)
    params.setAbsoluteErrorTol(1e-12)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, setup.start, params).optimize()
    assert setup.cost(ours, term) == pytest.approx(graph.error(theirs), rel=1e-6)
    assert setup.cost(ours, term) < setup.cost(setup.start, term)
    a, b = (read_states(values, 0, len(setup.problem)) for values in (ours, theirs))
    np.testing.assert_allclose(a.p, b.p, atol=3e-5)
    np.testing.assert_allclose(a.R, b.R, atol=3e-5)
    np.testing.assert_allclose(read_log_scales(ours, 2), read_log_scales(theirs, 2), atol=2e-3)


def _callback_factor(motions, n, segment, noise):
    """Motion n in gtsam's own types, with numeric derivatives."""
    T_bc = gtsam.Pose3(motions.T_body_camera)
    measured, h = gtsam.Rot3(motions.R[n]), 1e-6

    def residual(first, second, log_scale):
        camera = T_bc.inverse() * first.between(second) * T_bc
        e_t = measured.unrotate(np.exp(-log_scale) * camera.translation() - motions.t[n])
        return motions.whiten[n] @ np.r_[gtsam.Rot3.Logmap(measured.between(camera.rotation())), e_t]

    def slope(moved):
        return (moved(h) - moved(-h)) / (2 * h)

    def error(factor, values, jacobians):
        i, j, s = factor.keys()
        first, second, log_scale = values.atPose3(i), values.atPose3(j), values.atDouble(s)
        if jacobians is not None:
            axes = np.eye(6)
            jacobians[0] = np.array([slope(lambda d, e=e: residual(first.retract(d * e), second, log_scale))
                                     for e in axes]).T.copy(order="F")
            jacobians[1] = np.array([slope(lambda d, e=e: residual(first, second.retract(d * e), log_scale))
                                     for e in axes]).T.copy(order="F")
            jacobians[2] = slope(lambda d: residual(first, second, log_scale + d))[:, None]
        return residual(first, second, log_scale)

    return gtsam.CustomFactor(noise, [X(int(motions.i[n])), X(int(motions.j[n])), S(segment)], error)


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
    begun = read_states(chunked.values, 0, len(problem))
    a, b = (read_states(gauss_newton(native, start.values, term, 25, 1e-13).values, 0, len(problem))
            for start in (chunked, whole))
    assert not np.array_equal(a.p, b.p)  # or it was no test
    np.testing.assert_allclose(begun.p, b.p, atol=5e-3)  # chunk continues where the one before it was cut
    np.testing.assert_allclose(begun.R, b.R, atol=0.02)
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
