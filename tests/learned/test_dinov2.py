"""The adapted transformer: what it starts as, what of it trains, where its weights come from."""

import sys

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from learned.errors import NetworkInputError, WeightsError
from learned.methods import build_method
from learned.networks.dinov2 import DinoEncoder, DinoShape
from learned.networks.dv_lora import DvLoraLinear
from vio.errors import ConfigError

pytest.importorskip("transformers", reason="the extra `foundation` is not installed")
TINY = DinoShape(heads=1)


@pytest.fixture(autouse=True)
def seeded():
    torch.manual_seed(2)


def test_the_small_variant_has_the_published_size():
    with torch.device("meta"):
        depth = build_method("endodac", vibration=False, transformer="small", flows=False).depth
    parameters = list(depth.parameters())
    assert sum(p.numel() for p in parameters) == 25_310_020
    assert sum(p.numel() for p in parameters if p.requires_grad) == 529_540


def test_an_update_is_low_rank_and_starts_at_nothing():
    frozen = nn.Linear(7, 5)
    layer, x = DvLoraLinear(frozen, 2), torch.randn(3, 7)
    assert torch.equal(layer(x), frozen(x))
    nn.init.normal_(layer.lora_B)
    update = (layer.lora_B * layer.lora_V) @ (layer.lora_A * layer.lora_U)
    torch.testing.assert_close(layer(x), frozen(x) + x @ update.T)


def test_it_starts_as_the_transformer_it_adapts():
    encoder = DinoEncoder(TINY).eval()
    images = torch.rand(2, 3, 64, 96)
    maps = encoder(images)
    assert [tuple(x.shape) for x in maps] == [(2, 64, 4, 6)] * 4
    seen = nn.functional.interpolate(images, (56, 84), mode="bilinear", align_corners=True)
    tokens = encoder.vit(seen).last_hidden_state[:, 1:]
    torch.testing.assert_close(maps[3].flatten(2).transpose(1, 2), tokens)
    with pytest.raises(NetworkInputError, match="divisible by 16"):
        encoder(images[..., :90])


def test_fusion_of_a_block_feeds_the_later_blocks_only():
    encoder, images = DinoEncoder(TINY).eval(), torch.rand(1, 3, 64, 64)
    plain = encoder(images)
    changed = encoder(images, lambda block, x: x.roll(1, 3) if block == 1 else x)
    assert [torch.equal(a, b) for a, b in zip(plain, changed, strict=True)] == [True, False, False, False]


def test_phases_switch_directions_and_magnitudes_and_nothing_else():
    encoder = DinoEncoder(TINY)

    def trained():
        return {n.split(".")[-1] if "lora" in n else n.split(".")[0] for n, p in encoder.named_parameters()
                if p.requires_grad}

    assert trained() == {"lora_A", "lora_B", "necks"}
    encoder.set_phase("magnitudes")
    assert trained() == {"lora_U", "lora_V", "necks"}
    with pytest.raises(ConfigError, match="magnitudes"):
        encoder.set_phase("warm")


def test_local_weights_are_taken_and_others_refused(tmp_path):
    source = DinoEncoder(TINY)
    plain = source.vit.__class__(source.vit.config)
    plain.save_pretrained(tmp_path / "tiny")
    loaded = DinoEncoder(TINY, tmp_path / "tiny")
    assert torch.equal(loaded.vit.encoder.layer[3].mlp.fc1.weight, plain.encoder.layer[3].mlp.fc1.weight)
    with pytest.raises(WeightsError, match="expected"):
        DinoEncoder(DinoShape(heads=2), tmp_path / "tiny")
    with pytest.raises(WeightsError, match="nowhere"):
        DinoEncoder(TINY, tmp_path / "nowhere")
    file = tmp_path / "tiny" / "model.safetensors"
    tensors = load_file(file)
    save_file({n: x for n, x in tensors.items() if "layer.7" not in n}, file, {"format": "pt"})
    with pytest.raises(WeightsError, match=r"layer\.7.* missing"):
        DinoEncoder(TINY, tmp_path / "tiny")
    file.write_bytes(b"\x00" * 64)
    with pytest.raises(WeightsError, match="cannot be read"):
        DinoEncoder(TINY, tmp_path / "tiny")


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(ConfigError, match=r"capsule-vio\[foundation\]"):
        build_method("endodac")


def test_taps_can_be_the_last_four_blocks():
    method = build_method("endodac", width=1 / 12, vibration=False, taps=(8, 9, 10, 11), intrinsics_from="decoder")
    out = method(torch.rand(1, 3, 3, 64, 64))
    assert out.depth[1].depth[0].shape == (1, 1, 64, 64) and out.intrinsics[0, 1].shape == (1, 3, 3)
    assert method.intrinsics.squeeze is None
