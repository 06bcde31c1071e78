"""The chain of frames against gtsam's factors and optimiser, dense algebra and numeric derivatives."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion import chain, joint
from fusion.chain import DIM, ChainSystem
from fusion.chain_engine import ChainEngine
from fusion.chain_far import FarFactors
from fusion.config import RefineConfig
from fusion.graph import read_log_scales, read_states
from fusion.inertial import preintegrate_steps
from fusion.native_engine import NativeEngine
from fusion.preintegration import preintegrate
from fusion.problem import build_problem
from fusion.scale import make_segments
from fusion.solve import MotionTerm
from vio import se3
from vio.errors import EstimationError
from vio.sensor_faults import with_gap

SEGMENT_S, HUBER = 5.0, 2.8
GTSAM_ORDER = [0, 1, 2, 6, 7, 8, 3, 4, 5]
"""gtsam has position before velocity."""


@pytest.fixture(scope="module")
def problem(short):
    """With plain noise: gtsam's side rounds inflations to a grid, the chain does not."""
    plain = build_problem(short.recording, short.motions)
    one = np.ones(len(plain) - 1)
    return replace(plain, accel_inflation=one, gyro_inflation=one)


def widened(problem, spans):
    """Beside the neighbours' motions also chained ones over more frames, and every third pair measured twice."""
    m, n = problem.motions, len(problem.motions)
    i, j, R, t, whiten = [m.i], [m.j], [m.R], [m.t], [m.whiten]
    T = se3.transform(m.R, m.t)
    for span in spans:
        wide = T[:n - span + 1]
        for k in range(1, span):
            wide = wide @ T[k:n - span + 1 + k]
        for part, value in zip((i, j, R, t, whiten), (m.i[:len(wide)], m.i[:len(wide)] + span, wide[:, :3, :3],
                                                      wide[:, :3, 3], m.whiten[:len(wide)] / span), strict=True):
            part.append(value)
    for part, value in zip((i, j, R, t, whiten), (m.i, m.j, m.R, m.t, 0.3 * m.whiten), strict=True):
        part.append(value[::3])
    i, j, R, t, whiten = (np.concatenate(part) for part in (i, j, R, t, whiten))
    return replace(problem, motions=replace(m, i=i, j=j, R=R, t=t, whiten=whiten))


def solved(problem, engine, huber=HUBER, free=True):
    """Both engines from the same kind of start to the same minimum, with scale free or held."""
    scale = problem.scale_log_mean
    segments = make_segments(problem.t_s, SEGMENT_S)
    begin = engine.begin(problem, RefineConfig(), scale, 1.0)
    segment = None
    if free:
        begin, segment = engine.free(begin, problem, segments, 0.0055, scale), segments.of_node[problem.motions.i]
    term = MotionTerm(problem.motions, segment, scale, huber, np.ones(len(problem.motions)))
    solution = engine.solve(begin, term, 60, 1e-13)
    return solution, engine.uncertainty(replace(begin, values=solution.values), term, segments if free else None,
                                        np.random.default_rng(1)), term


def test_steps_are_gtsams_preintegration(problem):
    steps = preintegrate_steps(problem.pieces, problem.noise, problem.gyro_bias_rad_s, problem.accel_inflation,
                               problem.gyro_inflation)
    measured = preintegrate(problem.pieces, problem.noise, np.zeros(3), problem.gyro_bias_rad_s,
                            problem.accel_inflation, problem.gyro_inflation, (0, len(steps)))
    for k, m in enumerate(measured):
        np.testing.assert_allclose(steps.R[k], m.deltaRij().matrix(), atol=2e-6)
        np.testing.assert_allclose(steps.v[k], m.deltaVij(), atol=1e-5)  # m/s; its noise is 1e-3
        np.testing.assert_allclose(steps.p[k], m.deltaPij(), atol=1e-6)
        cov = m.preintMeasCov()[np.ix_(GTSAM_ORDER, GTSAM_ORDER)]
        sd = np.sqrt(np.diag(cov))
        root = np.linalg.inv(steps.whiten[k])
        np.testing.assert_allclose(root @ root.T / np.outer(sd, sd), cov / np.outer(sd, sd), atol=0.01)


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_steps_follow_a_bias_as_if_integrated_with_it(problem, sensor):
    """First-order corrections against integrating the corrected samples."""
    bias = 2e-3 * np.array([1.0, -2.0, 1.5])
    accel, gyro = (bias, 0 * bias) if sensor == "accel" else (0 * bias, bias)
    pieces = replace(problem.pieces, accel_m_s2=problem.pieces.accel_m_s2 - accel,
                     gyro_rad_s=problem.pieces.gyro_rad_s - gyro)
    one = np.ones(len(problem) - 1)
    at_zero, exact = (preintegrate_steps(p, problem.noise, np.zeros(3), one, one) for p in (problem.pieces, pieces))
    change = np.abs(exact.v - at_zero.v).max(), np.abs(exact.p - at_zero.p).max()
    np.testing.assert_allclose(at_zero.v + at_zero.v_bg @ gyro + at_zero.v_ba @ accel, exact.v, atol=2e-3 * change[0])
    np.testing.assert_allclose(at_zero.p + at_zero.p_bg @ gyro + at_zero.p_ba @ accel, exact.p, atol=2e-3 * change[1])
    np.testing.assert_allclose(at_zero.rotations(gyro), exact.R, atol=2e-6)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), spans=st.sampled_from([(), (2,), (2, 3)]), huber=st.sampled_from([None, HUBER]))
def test_the_gradient_is_the_slope_of_the_cost(problem, seed, spans, huber):
    rng = np.random.default_rng(seed)
    wide = widened(problem, spans)
    segments = make_segments(problem.t_s, SEGMENT_S)
    engine = ChainEngine()
    begin = engine.free(engine.begin(wide, RefineConfig(), wide.scale_log_mean, 1.0), wide, segments, 0.0055, 0.1)
    m, n = len(problem), len(wide.motions)
    term = MotionTerm(wide.motions, segments.of_node[wide.motions.i], 0.0, huber, rng.uniform(0.1, 1, n))
    scatter = np.repeat([0.2, 0.01, 0.02, 0.05, 0.01], 3) * rng.standard_normal((m, 15))
    state = begin.values.moved(np.c_[np.zeros(m), scatter], None)
    direction = np.repeat([1e-3, 1e-4, 1e-4, 1e-3, 1e-4], 3) * rng.standard_normal((m, 15))
    direction = np.c_[1e-3 * rng.standard_normal(segments.of_node.max() + 1)[segments.of_node], direction]

    def cost(h):
        moved = state.moved(h * direction, segments.of_node)
        return begin.model.cost(moved) + term.cost(moved)

    h = 1e-3
    slope = (cost(h) - cost(-h)) / (2 * h)
    parts = begin.model.linearize(state, term).gradient[:m] * direction
    assert slope == pytest.approx(-float(parts.sum()), rel=1e-4, abs=1e-4 * np.abs(parts).sum())


@pytest.mark.parametrize("case", ["neighbours", "wide", "loops", "gap", "held"])
def test_a_chain_ends_where_gtsam_ends(short, problem, case):
    if case == "wide":
        problem = widened(problem, (2, 3))
    if case == "loops":
        problem = widened(problem, (2, 20, 31))
    if case == "gap":
        imu = with_gap(short.recording.imu, 4.0, 1.5)
        holed = build_problem(replace(short.recording, imu=imu), short.motions)
        one = np.ones(len(holed) - 1)
        problem = replace(holed, accel_inflation=one, gyro_inflation=one)
        assert not problem.imu_usable.all()
    ours, sure, term = solved(problem, ChainEngine(), free=case != "held")
    theirs, theirs_sure, _ = solved(problem, NativeEngine(), free=case != "held")
    assert ours.native_cost + term.losses(ours.squared_norm)[0] == pytest.approx(
        theirs.native_cost + term.losses(theirs.squared_norm)[0], rel=2e-3)
    a, b = (read_states(s.values, 0, len(problem)) for s in (ours, theirs))
    sd = np.sqrt(np.diagonal(theirs_sure.cov, axis1=1, axis2=2))
    off = se3.log(se3.inverse(a.T_world_body) @ b.T_world_body)
    assert np.abs(off[1:] / sd[1:]).max() < 0.05
    np.testing.assert_allclose(sure.cov[1:] / sd[1:, :, None] / sd[1:, None, :],
                               theirs_sure.cov[1:] / sd[1:, :, None] / sd[1:, None, :], atol=0.02)
    if case != "held":
        scale_sd = np.sqrt(theirs_sure.log_scale_variance)
        np.testing.assert_allclose(np.sqrt(sure.log_scale_variance), scale_sd, rtol=0.02)
        assert np.abs((ours.values.log_scale - read_log_scales(theirs.values, 2)) / scale_sd).max() < 0.05


@settings(max_examples=12)
@given(seed=st.integers(0, 1000), nodes=st.integers(2, 23), reach=st.integers(1, 4), stops=st.integers(2, 9),
       loops=st.integers(0, 13))
def test_solution_and_marginals_equal_dense_algebra(seed, nodes, reach, stops, loops):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chain, "CHAIN_NODES", 5)
        check_against_dense_algebra(seed, nodes, reach, stops, loops)


def check_against_dense_algebra(seed, nodes, reach, stops, loops):
    rng = np.random.default_rng(seed)
    system = ChainSystem(nodes, reach)
    dense, gradient = np.zeros(2 * [nodes * DIM]), np.zeros(nodes * DIM)
    for span in range(1, min(reach, nodes - 1) + 1):
        i = np.arange(nodes - span)
        A_i, A_j = rng.standard_normal((len(i), 9, DIM)), rng.standard_normal((len(i), 9, 10))
        b = rng.random((len(i), 9))
        rows = np.concatenate([A_i, A_j, b[:, :, None]], axis=2)
        if reach == 1:
            system.add_chain(0, rows)
        else:
            system.add(i, i + span, rows)
        for k in i:
            A = np.zeros((9, nodes * DIM))
            A[:, k * DIM:(k + 1) * DIM], A[:, (k + span) * DIM:(k + span) * DIM + 10] = A_i[k], A_j[k]
            dense += A.T @ A
            gradient += A.T @ b[k]
    information, wanted = rng.uniform(1, 2, (nodes - 1, 6)), rng.standard_normal((nodes - 1, 6))
    system.add_links(chain.BIAS, information, wanted)
    for k in range(nodes - 1):
        A = np.zeros((6, nodes * DIM))
        A[:, k * DIM + 10:k * DIM + 16], A[:, (k + 1) * DIM + 10:(k + 2) * DIM] = -np.eye(6), np.eye(6)
        dense += A.T @ (information[k, :, None] * A)
        gradient += A.T @ (information[k] * wanted[k])
    system.add_prior(0, 2 * np.eye(DIM), np.ones(DIM))
    dense[:DIM, :DIM] += 2 * np.eye(DIM)
    gradient[:DIM] += 1
    for c in range(DIM):
        system.add_everywhere(c, 0.5)
    dense += 0.5 * np.eye(len(dense))
    if loops:
        rows, b = add_far(system, loops, rng)
        dense += rows.T @ rows
        gradient += rows.T @ b
    factor = system.factor()
    np.testing.assert_allclose(factor.solve().ravel(), np.linalg.solve(dense, gradient), atol=1e-9)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint, "CHECKPOINTS", stops)
        patch.setattr(chain, "SAMPLES", 3)
        cov, samples = factor.marginals_and_samples(rng)
    inverse = np.linalg.inv(dense)
    for k in range(nodes):
        np.testing.assert_allclose(cov[k], inverse[k * DIM:(k + 1) * DIM, k * DIM:(k + 1) * DIM], atol=1e-10)
    assert len(samples.node) == min(stops, nodes) and samples.xi.shape == (3, len(samples.node), 6)


def add_far(system, count, rng):
    """Factors between any two frames; their rows (6 count, n) and right-hand side."""
    ends = np.sort([rng.choice(system.nodes, 2, replace=False) for _ in range(count)], axis=1)
    A_i, A_j, b = rng.standard_normal((count, 6, 7)), rng.standard_normal((count, 6, 7)), rng.random((count, 6))
    system.far = FarFactors(ends[:, 0], ends[:, 1], A_i, A_j, b)
    rows = np.zeros((count, 6, system.nodes, DIM))
    for k, (i, j) in enumerate(ends):
        rows[k, :, i, :7], rows[k, :, j, :7] = A_i[k], A_j[k]
    return rows.reshape(6 * count, -1), b.ravel()


def test_samples_hang_together_as_dense_algebra_has_it():
    rng, nodes = np.random.default_rng(5), 6
    system = ChainSystem(nodes, 1)
    i = np.arange(nodes - 1)
    A_i, A_j = rng.standard_normal((nodes - 1, 9, DIM)), rng.standard_normal((nodes - 1, 9, 10))
    system.add_chain(0, np.concatenate([A_i, A_j, rng.random((5, 9, 1))], axis=2))
    for c in range(DIM):
        system.add_everywhere(c, 0.5)
    dense = 0.5 * np.eye(nodes * DIM)
    for k in i:
        A = np.zeros((9, nodes * DIM))
        A[:, k * DIM:(k + 1) * DIM], A[:, (k + 1) * DIM:(k + 1) * DIM + 10] = A_i[k], A_j[k]
        dense += A.T @ A
    rows, _ = add_far(system, 3, rng)
    dense += rows.T @ rows
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chain, "SAMPLES", 20_000)
        samples = system.factor().marginals_and_samples(rng)[1]
    drawn = samples.xi.reshape(20_000, -1)
    poses = (np.arange(nodes)[:, None] * DIM + np.arange(1, 7)).ravel()
    want = np.linalg.inv(dense)[np.ix_(poses, poses)]
    sd = np.sqrt(np.diagonal(want))
    np.testing.assert_allclose(np.cov(drawn.T) / sd / sd[:, None], want / sd / sd[:, None], atol=0.05)


def test_what_nothing_holds_is_indeterminate():
    system = ChainSystem(4, 1)
    system.add_prior(0, np.eye(DIM), np.zeros(DIM))
    with pytest.raises(EstimationError, match=r"indeterminate \(frame 1\)"):
        system.factor()
