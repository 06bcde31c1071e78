"""The seven strategies: the Wiener filter against linear algebra, gradients, batch 1, and whether the SNR learns."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st

from learned.vibration_fusion import STRATEGIES, EncoderFusion, FusionConfig
from learned.vibration_fusion.attentional import AttentionalFusion
from learned.vibration_fusion.bottom_up import BottomUpTopDown
from learned.vibration_fusion.fourier import FourierFusion, wiener_filter
from learned.vibration_fusion.pointwise import Concatenation, Gated
from vio.errors import ConfigError

DIM = 5
DELTA = torch.zeros(1, 3, 3, dtype=torch.float64)
DELTA[:, 1, 1] = 1


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(3)


def circulant(kernel, height, width):
    """The matrix of a circular convolution, tap by tap."""
    A, reach = np.zeros((height * width,) * 2), kernel.shape[0] // 2
    for y in range(height):
        for x in range(width):
            for a in range(-reach, reach + 1):
                for b in range(-reach, reach + 1):
                    A[y * width + x, (y - a) % height * width + (x - b) % width] += kernel[a + reach, b + reach]
    return A


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 7), st.integers(1, 7), st.sampled_from([1, 3, 5]), st.floats(1e-6, 1e4))
def test_the_filter_solves_the_regularised_least_squares_it_stands_for(height, width, side, r):
    kernel, blurred = torch.randn(1, side, side).double(), torch.randn(1, 1, height, width).double()
    A = circulant(kernel[0].numpy(), height, width)
    wanted = np.linalg.solve(r * A.T @ A + np.eye(len(A)), r * A.T @ blurred.numpy().ravel())
    out = wiener_filter(blurred, kernel, torch.full((1, 1), r).double())
    np.testing.assert_allclose(out.ravel(), wanted, rtol=1e-6, atol=1e-8 * max(1.0, np.abs(wanted).max()))


@pytest.mark.parametrize("r", [0.0, 1e-12, 1.0, 1e4])
@pytest.mark.parametrize(("height", "width", "side"), [(4, 6, 3), (5, 7, 3), (3, 3, 1), (2, 1, 3), (1, 1, 3)])
def test_the_filter_has_exact_gradients_down_to_an_snr_of_zero(r, height, width, side):
    features = torch.randn(2, 2, height, width, dtype=torch.float64, requires_grad=True)
    kernel = torch.randn(2, side, side, dtype=torch.float64) + 2 * F.pad(torch.ones(2, 1, 1), (side // 2,) * 4)
    snr = torch.tensor([[r], [2 * r]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(wiener_filter, (features, kernel.requires_grad_(), snr), atol=1e-6)


@pytest.mark.parametrize("shape", [(8, 8), (7, 9), (2, 3), (1, 1)])
def test_a_delta_and_an_endless_snr_change_nothing_and_none_lets_nothing_through(shape):
    x = torch.randn(2, 3, *shape, dtype=torch.float64)
    torch.testing.assert_close(wiener_filter(x, DELTA, torch.full((2, 1), 1e12).double()), x)
    assert wiener_filter(x, DELTA, torch.zeros(2, 1).double()).abs().max() == 0
    r = torch.tensor([[3.0], [0.5]]).double()
    torch.testing.assert_close(wiener_filter(x, None, r), wiener_filter(x, DELTA, r))


@pytest.mark.parametrize("activation", ["softplus", "exp", "relu"])
def test_the_snr_starts_where_it_should_and_stays_in_its_limits(activation):
    block = FourierFusion(4, DIM, FusionConfig(snr_activation=activation, snr_per="channel"))
    torch.testing.assert_close(block.snr(torch.zeros(1, DIM)), torch.full((1, 4), 10.0))
    block.snr_head.weight.data.fill_(1.0)
    for extreme in (-1e6, 1e6):
        g = torch.full((1, DIM), extreme, requires_grad=True)
        snr = block.snr(g)
        block(torch.randn(1, 4, 5, 3), g).features.sum().backward()
        low = 0.0 if activation == "relu" else 1e-4
        assert snr.min() >= low * 0.999 and snr.max() <= 1e4 * 1.001 and torch.isfinite(g.grad).all()
        assert (activation == "relu" and extreme < 0) == bool((snr == 0).any())


@pytest.mark.parametrize("kernel", ["identity", "channel"])
def test_the_snr_learns_how_noisy_the_vibration_makes_the_maps(kernel):
    """White maps of variance 1 in white noise of variance v are restored best at SNR 1 / v, to an error of v / (1 + v).

    With a learned kernel the SNRs are known up to the kernel's gain.
    """
    block = FourierFusion(2, 2, FusionConfig(snr_start=8.0, kernel=kernel))
    levels, noise = torch.eye(2), torch.tensor([0.5, 1.0]).repeat(32)[:, None, None, None]
    adam = torch.optim.Adam(block.parameters(), 0.1)
    losses = []
    for _ in range(150):
        clean = torch.randn(64, 2, 8, 8)
        loss = (block(clean + noise * torch.randn_like(clean), levels.repeat(32, 1)).features - clean).square().mean()
        adam.zero_grad()
        loss.backward()
        adam.step()
        losses.append(loss.item())
    calm, rough = block(torch.randn(2, 2, 8, 8), levels).snr.tolist()
    if kernel == "identity":
        assert 3.2 < calm < 5.0 and 0.8 < rough < 1.25
    assert calm > 2 * rough and np.mean(losses[-20:]) < 1.05 * (0.2 + 0.5) / 2


def test_edge_padding_keeps_opposite_borders_apart():
    x = torch.zeros(1, 1, 6, 6)
    x[..., 0, :] = 1.0
    touching, apart = (FourierFusion(1, DIM, FusionConfig(edge_padding=p)) for p in (0, 2))
    for block in (touching, apart):
        block.kernel.data[:] = torch.tensor([[0.05, 0.1, 0.05], [0.1, 1.0, 0.1], [0.05, 0.1, 0.05]])
    far = [block(x, torch.zeros(1, DIM)).features[0, 0, -1].abs().max() for block in (touching, apart)]
    assert far[1] < 0.1 * far[0] and apart(x, torch.zeros(1, DIM)).features.shape == x.shape


@pytest.mark.parametrize("strategy", STRATEGIES)
@pytest.mark.parametrize("shape", [(6, 7, 5), (1, 1, 1)])
def test_every_strategy_keeps_the_shape_hears_the_vibration_and_trains_at_batch_one(strategy, shape):
    fusion = EncoderFusion(FusionConfig(strategy), [shape[0]], DIM).train()
    x, g = torch.randn(1, *shape, requires_grad=True), torch.randn(1, DIM, requires_grad=True)
    out = fusion.bind(g)(0, x)
    (out * torch.randn_like(out)).sum().backward()
    assert out.shape == x.shape and torch.isfinite(out).all()
    for gradient in (x.grad, g.grad, *(p.grad for p in fusion.parameters())):
        assert gradient is not None and torch.isfinite(gradient).all()
    if shape != (1, 1, 1):
        assert (g.grad != 0).all() and (x.grad != 0).any()


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_strategy_treats_the_samples_of_a_batch_alone(strategy):
    fusion = EncoderFusion(FusionConfig(strategy), [6], DIM).train()
    x, g = torch.randn(3, 6, 4, 5), torch.randn(3, DIM)
    together, alone = fusion.bind(g), [fusion.bind(g[k:k + 1]) for k in range(3)]
    torch.testing.assert_close(together(0, x), torch.cat([one(0, x[k:k + 1]) for k, one in enumerate(alone)]))
    assert (strategy == "fourier") == (together.snr is not None)
    if together.snr is not None:
        assert together.snr.shape == (3, 1) and together.snr.std() > 0


def test_formulas_are_the_articles():
    x, g = torch.randn(2, 4, 3, 5), torch.randn(2, DIM)
    block = Concatenation(4, DIM)
    y = block.project(g)[..., None, None].expand_as(x)
    torch.testing.assert_close(block(x, g).features, block.mix(torch.cat([x, y], 1)))

    gated = Gated(4, DIM)
    v, t = gated.project_vision(x), gated.project(g)[..., None, None].expand_as(x)
    z = torch.sigmoid(gated.gate(torch.cat([v, t], 1)))
    torch.testing.assert_close(gated(x, g).features, z * v.tanh() + (1 - z) * t.tanh())

    aff = AttentionalFusion(4, DIM, FusionConfig("aff"))
    y = aff.project(g)[..., None, None].expand_as(x)
    torch.testing.assert_close(aff(y, g).features, y)  # without a factor 2, equal inputs come out as they are
    between = aff(x, g).features
    assert ((between <= torch.maximum(x, y) + 1e-6) & (between >= torch.minimum(x, y) - 1e-6)).all()

    butd = BottomUpTopDown(4, DIM)
    wide = g[..., None, None].expand(-1, -1, 3, 5)
    joint = torch.cat([x, wide], 1)
    score = butd.score(butd.attend(joint).tanh() * butd.attend_gate(joint).sigmoid()).flatten(2).softmax(2)
    seen = (x.flatten(2) * score).sum(2)
    h = butd.question(g) * butd.answer(seen)
    torch.testing.assert_close(butd(x, g).features, x + h[..., None, None])


def test_impossible_configurations_are_refused():
    for wrong, says in (({"snr_activation": "tanh"}, "softplus"), ({"kernel_size": 4}, "odd"),
                        ({"snr_start": 0.0}, "snr_start"), ({"edge_padding": -1}, "edge_padding"),
                        ({"kernel": "big"}, "identity"), ({"snr_per": "pixel"}, "block")):
        with pytest.raises(ConfigError, match=says):
            FusionConfig(**wrong)
    with pytest.raises(ConfigError, match="butd"):
        EncoderFusion(FusionConfig("attention"), [4], DIM)
