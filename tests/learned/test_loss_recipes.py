"""The methods' losses on a scene whose depth and motion are known: least at the truth, and as published where asked."""

import dataclasses

import numpy as np
import pytest
import torch

from learned.losses import appearance_flow as af
from learned.losses import resolution_adaptive as ra
from learned.losses.consistency import (
    ENDOSFM,
    ENDOSFM_PUBLISHED,
    MEASURED,
    PAPER,
    Consistency,
    consistency_loss,
)
from learned.losses.masks import visible_from
from learned.losses.snippet import both_directions, directed_pairs
from learned.warping import project_depth
from vio.camera import Camera
from vio.errors import ConfigError

EYE = torch.eye(4, dtype=torch.float64)[None]
PAIRS = [(1, 0), (1, 2), (0, 1), (2, 1)]


@pytest.mark.parametrize("recipe", [PAPER, ENDOSFM, dataclasses.replace(MEASURED, levels=2)])
@pytest.mark.parametrize("kind", ["z", "range"])
def test_truth_beats_rest_and_wrong_depth(scene, recipe, kind):
    recipe = dataclasses.replace(recipe, depth_kind=kind)
    scene.z = scene.z.clamp(min=0.05)  # a network's depth is positive everywhere
    true = consistency_loss(scene.snippet(kind), recipe)
    still = consistency_loss(scene.snippet(kind, dict.fromkeys(PAIRS, EYE)), recipe)
    assert true.parts["photometric"] < 0.2 * still.parts["photometric"]
    sideways = kind == "z" and scene.camera.model == "equidistant"  # z changes by its own size from pixel to pixel
    limit = (0.012 if sideways else 0.004) * (1 if recipe.reduction == "mean" else 4)
    assert true.parts["geometry"] < limit < still.parts["geometry"]
    assert true.parts["valid"] > 0.8
    snippet = scene.snippet(kind)
    far = dataclasses.replace(snippet, depth=1.5 * snippet.depth)
    assert consistency_loss(far, recipe).parts["photometric"] > 1.5 * true.parts["photometric"]
    lopsided = dataclasses.replace(snippet, depth=snippet.depth * torch.tensor([1, 1.3, 1]).view(1, 3, 1, 1, 1))
    assert consistency_loss(lopsided, recipe).parts["geometry"] > 6 * true.parts["geometry"]


def test_the_paper_adds_its_terms_with_its_weights(scene):
    got = consistency_loss(scene.snippet("range"), dataclasses.replace(PAPER, depth_kind="range"))
    p = got.parts
    expected = p["photometric"] + 0.1 * p["smoothness"] + 0.5 * p["geometry"]
    assert float(got.total) == pytest.approx(float(expected), rel=1e-12)
    summed = consistency_loss(scene.snippet("range"), dataclasses.replace(
        PAPER, depth_kind="range", reduction="sum"))
    assert float(summed.parts["photometric"]) == pytest.approx(4 * float(p["photometric"]), rel=1e-9)
    assert float(summed.parts["smoothness"]) == pytest.approx(3 * float(p["smoothness"]), rel=1e-9)


def test_pixels_whose_depths_disagree_count_less(scene):
    snippet = scene.snippet("range", {(1, 2): scene.T(1, 2)})
    apart = dataclasses.replace(snippet, depth=snippet.depth * torch.tensor([1, 1, 1.3]).view(1, 3, 1, 1, 1))
    weighed, plain = (float(consistency_loss(apart, Consistency(depth_kind="range", weigh_by_agreement=weigh))
                            .parts["photometric"]) for weigh in (True, False))
    assert weighed == pytest.approx(plain * (1 - 0.3 / 2.3), rel=1e-3)


def test_a_change_of_light_costs_nothing_once_brightness_is_matched(scene):
    snippet = scene.snippet("range")
    recipe = Consistency(depth_kind="range")
    darker = torch.tensor([1.0, 0.6, 0.8], dtype=torch.float64).view(1, 3, 1, 1, 1)
    relit = dataclasses.replace(snippet, images=snippet.images * darker)
    before, after = (float(consistency_loss(s, recipe).parts["photometric"]) for s in (snippet, relit))
    assert after < 1.5 * before + 1e-3
    blind = dataclasses.replace(recipe, photometric=dataclasses.replace(recipe.photometric, match_brightness=False))
    assert float(consistency_loss(relit, blind).parts["photometric"]) > 4 * after
    published = dataclasses.replace(recipe, photometric=dataclasses.replace(recipe.photometric, inverted_gain=True))
    assert float(consistency_loss(relit, published).parts["photometric"]) > 4 * after


def test_published_code_gives_small_images_no_gradient(scene):
    snippet = scene.snippet("z")
    depth = scene.z.clamp(min=0.05)[None, :3].requires_grad_()
    for recipe, dead in ((ENDOSFM_PUBLISHED, True), (ENDOSFM, False)):
        recipe = dataclasses.replace(recipe, smoothness_weight=0.0)
        total = consistency_loss(dataclasses.replace(snippet, depth=depth), recipe).total
        (grad,) = torch.autograd.grad(total, depth)
        assert bool((grad == 0).all()) is dead and bool(total.detach() == 0) is dead


def test_masks_reach_the_loss(scene):
    recipe = Consistency(depth_kind="range", mask_highlights=True)
    snippet = scene.snippet("range")
    spoiled = snippet.images.clone()
    spoiled[..., 20:28, 20:28] = 1.0  # a highlight that stays where it is
    clean = float(consistency_loss(snippet, recipe).parts["photometric"])
    masked = float(consistency_loss(dataclasses.replace(snippet, images=spoiled), recipe).parts["photometric"])
    seen = float(consistency_loss(dataclasses.replace(snippet, images=spoiled),
                                  dataclasses.replace(recipe, mask_highlights=False)).parts["photometric"])
    assert masked < 2 * clean < seen
    usable = torch.ones_like(snippet.depth, dtype=torch.bool)
    usable[..., 20:28, 20:28] = False
    vignetted = consistency_loss(dataclasses.replace(snippet, images=spoiled, usable=usable), Consistency(
        depth_kind="range", auto_mask=True))
    assert float(vignetted.parts["photometric"]) < 2 * clean


def test_pyramids_stop_where_the_minimum_goes_wrong(scene):
    with pytest.raises(ConfigError, match="3 pyramid levels of 64 x 64 pixels"):
        consistency_loss(scene.snippet("range"), MEASURED)
    with pytest.raises(ConfigError, match="pairs \\[\\(0, 3\\)\\]"):
        consistency_loss(scene.snippet("range", {(0, 3): EYE}), PAPER)
    odd = dataclasses.replace(scene.snippet("range"), images=torch.zeros(1, 3, 3, 63, 64))
    with pytest.raises(ConfigError, match="cannot be halved"):
        odd.halved()


def test_directed_pairs_keep_frames_and_motions_together(scene):
    snippet = scene.snippet("range", both_directions({(0, 1): scene.T(0, 1), (1, 2): scene.T(1, 2)}))
    pairs = directed_pairs(snippet)
    order = list(snippet.motions)
    assert sorted(order) == sorted(PAIRS) and pairs.count == 4
    for k, (i, j) in enumerate(order):
        torch.testing.assert_close(pairs.T_target_source[[k]], scene.T(i, j))
        assert (pairs.target[k] == scene.images[i]).all() and (pairs.source[k] == scene.images[j]).all()
        assert (pairs.source_depth[k] == scene.range[j]).all()


# ---------------------------------------------------------------- AF-SfMLearner, EndoDAC


def true_flow(scene, target, source):
    where = project_depth(scene.range[[target]], scene.T(target, source), scene.cameras, "range")
    return torch.where(where.valid, where.pixels - scene.cameras.pixel_grid, 0.0)


def test_flow_stage_is_least_at_the_true_flow(scene):
    target, sources = scene.images[[1]], scene.images[None, [0, 2]]
    flow = torch.stack([true_flow(scene, 1, 0), true_flow(scene, 1, 2)], 1)
    coarse = torch.nn.functional.avg_pool2d(flow[0], 2)[None]
    true, still, wrong = (af.flow_loss(target, sources, [k * flow, k * coarse]) for k in (1, 0, -1))
    assert true.parts["photometric"] < 0.3 * still.parts["photometric"] < 0.3 * wrong.parts["photometric"]
    assert still.parts["flow_smoothness"] == 0 < true.parts["flow_smoothness"]
    alone = af.flow_loss(target, sources[:, :1], [flow[:, :1]])
    both = af.flow_loss(target, torch.cat([sources[:, :1], torch.rand_like(sources[:, :1])], 1), [flow])
    assert float(both.parts["photometric"]) <= float(alone.parts["photometric"])  # the better source counts


def appearance_inputs(scene, change=0.0):
    sources, kept = scene.images[None, [0, 2]], scene.images[[1]]
    flows = torch.stack([true_flow(scene, 1, k) for k in (0, 2)], 1)
    back = torch.stack([true_flow(scene, k, 1) for k in (0, 2)], 1)
    T = torch.stack([scene.T(1, 0), scene.T(1, 2)], 1)
    visible = visible_from(back.flatten(0, 1))[None]
    registered = af.Registered(af.register(sources, flows), visible)
    return {"target": kept, "sources": sources, "depths": [scene.range[[1]]] * 2,
            "disparities": [1 / scene.range[[1]], torch.nn.functional.avg_pool2d(1 / scene.range[[1]], 2)],
            "T_target_source": T, "cameras": scene.cameras, "registered": registered,
            "appearance": [torch.full_like(sources, change)] * 2}


RANGE = dataclasses.replace(af.AF_SFM, depth_kind="range")


def test_appearance_stage_is_least_at_truth_and_explains_a_change_of_light(scene):
    inputs = appearance_inputs(scene)
    true = af.appearance_loss(**inputs, settings=RANGE)
    still = af.appearance_loss(**inputs | {"T_target_source": EYE[None].expand(1, 2, 4, 4)}, settings=RANGE)
    assert true.parts["photometric"] < 0.25 * still.parts["photometric"]
    assert true.parts["residue"] < 0.01 and true.parts["appearance_smoothness"] == 0
    lit = dict(inputs, sources=inputs["sources"] + 0.1,
               registered=dataclasses.replace(inputs["registered"], image=inputs["registered"].image + 0.1))
    unexplained = af.appearance_loss(**lit, settings=RANGE)
    explained = af.appearance_loss(**lit | {"appearance": appearance_inputs(scene, 0.1)["appearance"]}, settings=RANGE)
    assert explained.parts["residue"] < 0.3 * unexplained.parts["residue"]
    assert explained.parts["photometric"] < 0.5 * unexplained.parts["photometric"]


def test_appearance_terms_add_with_the_weights_of_the_method(scene):
    inputs = appearance_inputs(scene, 0.05)
    inputs["appearance"] = [a + 0.1 * torch.rand_like(a) for a in inputs["appearance"]]
    one = {key: value[:1] if key in ("depths", "disparities", "appearance") else value for key, value in inputs.items()}
    for recipe, weight in ((af.AF_SFM, 1e-4), (af.ENDODAC, 1e-3)):
        got = af.appearance_loss(**one, settings=dataclasses.replace(recipe, depth_kind="range"))
        p = got.parts
        expected = (p["photometric"] + 0.01 * p["residue"] + 0.01 * p["appearance_smoothness"]
                    + weight * p["disparity_smoothness"])
        assert float(got.total) == pytest.approx(float(expected), rel=1e-9)
    nowhere = dataclasses.replace(inputs["registered"], visible=torch.zeros_like(inputs["registered"].visible))
    assert float(af.appearance_loss(**inputs | {"registered": nowhere}, settings=RANGE).parts["photometric"]) == 0


# ---------------------------------------------------------------- RA-Depth


def ra_inputs(scene, seed=0):
    target, sources = scene.images[[1]], scene.images[None, [0, 2]]
    views = ra.scale_views(target, sources, scene.cameras, torch.Generator().manual_seed(seed))
    depths = [ra.align_disparity(scene.range[[1]], scene.cameras, view.cameras) for view in views]
    return views, tuple(1 / depth for depth in depths), tuple(depths), torch.stack([scene.T(1, 0), scene.T(1, 2)], 1)


def test_scaled_views_are_what_their_cameras_see(scene, rendered):
    views, _, _, _ = ra_inputs(scene)
    again, other = ra_inputs(scene)[0], ra_inputs(scene, seed=1)[0]
    for k, view in enumerate(views):
        fx, fy, cx, cy = view.cameras.intrinsics[0].tolist()
        camera = Camera(scene.camera.model, 64, 64, fx, fy, cx, cy, scene.camera.distortion)
        assert (fx / scene.camera.fx > 1.1, fx == scene.camera.fx, fx / scene.camera.fx < 0.9)[k]
        seen = torch.from_numpy(rendered(camera, scene.T_world_camera[1])[0])
        inner = view.usable[0, 0]
        assert inner.double().mean() > 0.4 and ((seen - view.target[0]).abs().amax(0)[inner]).quantile(0.98) < 0.02
        np.testing.assert_array_equal(view.sources, again[k].sources)
        assert k == 1 or not torch.equal(view.sources, other[k].sources)
    low = views[2]
    rows, columns = low.usable[0, 0].any(1).sum(), low.usable[0, 0].any(0).sum()
    torch.testing.assert_close(low.target[..., rows:, :columns], low.target[..., :64 - rows, :columns])


def test_resolution_adaptive_loss_is_least_at_truth(scene):
    recipe = ra.ResolutionAdaptive(depth_kind="range")
    views, disparities, depths, T = ra_inputs(scene)
    true = ra.resolution_adaptive_loss(views, disparities, depths, T, recipe)
    still = ra.resolution_adaptive_loss(views, disparities, depths, EYE[None].expand(1, 2, 4, 4), recipe)
    for name in ("high", "middle", "low"):
        assert true.parts[name] < 0.35 * still.parts[name]
        assert true.parts[f"consistency_{name}"] < 1e-3 if name != "middle" else True
    torn = (disparities[0] * 1.2, disparities[1], disparities[2] * 0.8)
    apart = ra.resolution_adaptive_loss(views, torn, depths, T, recipe)
    assert apart.parts["consistency_high"] > 0.02 and apart.parts["consistency_low"] > 0.02
    expected = sum(true.parts[n] + 1e-3 * true.parts[f"smoothness_{n}"] for n in ("high", "middle", "low"))
    expected = expected + true.parts["consistency_high"] + true.parts["consistency_low"]
    assert float(true.total) == pytest.approx(float(expected), rel=1e-9)


def test_the_better_source_counts_and_a_still_one_gives_no_gradient(scene):
    views, disparities, depths, T = ra_inputs(scene)
    recipe = ra.ResolutionAdaptive(depth_kind="range")
    junk = tuple(dataclasses.replace(view, sources=torch.stack([view.sources[:, 1], torch.rand_like(view.target)], 1))
                 for view in views)
    twice = torch.stack([T[:, 1], T[:, 1]], 1)
    spoiled = ra.resolution_adaptive_loss(junk, disparities, depths, twice, recipe)
    alone = tuple(dataclasses.replace(view, sources=view.sources[:, 1:]) for view in views)
    single = ra.resolution_adaptive_loss(alone, disparities, depths, T[:, 1:], recipe)
    assert float(spoiled.parts["middle"]) <= float(single.parts["middle"]) < 1.3 * float(spoiled.parts["middle"])
    frozen = tuple(dataclasses.replace(view, sources=torch.stack([view.target] * 2, 1)) for view in views)
    guess = tuple(depth.clone().requires_grad_() for depth in depths)
    loss = ra.resolution_adaptive_loss(frozen, disparities, guess, T, recipe)
    loss.total.backward()  # a capsule at rest: nothing to learn, and nothing but the auto-mask says so
    assert all((g.grad == 0).all() for g in guess) and float(loss.parts["middle"]) == 0


def test_what_is_not_usable_is_seen_neither_in_target_nor_in_sources(scene):
    recipe = ra.ResolutionAdaptive(depth_kind="range")
    usable = torch.ones(1, 1, 64, 64, dtype=torch.bool)
    usable[..., 25:40, 25:40] = False
    noise = torch.rand(3, 3, 64, 64, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    images = torch.where(usable, scene.images, noise)
    depths, T = (scene.range[[1]],) * 3, torch.stack([scene.T(1, 0), scene.T(1, 2)], 1)
    lost = {}
    for name, mask, frames in (("clean", usable, scene.images), ("masked", usable, images), ("seen", None, images)):
        views = ra.scale_views(frames[[1]], frames[None, [0, 2]], scene.cameras, torch.Generator().manual_seed(0), mask)
        terms = ra.resolution_adaptive_loss((views[1],) * 3, (1 / depths[0],) * 3, depths, T, recipe)
        lost[name] = float(terms.parts["middle"])
        if mask is not None:
            assert not views[0].usable.all() and views[2].usable.float().mean() < usable.float().mean()
    assert lost["masked"] == pytest.approx(lost["clean"], rel=1e-4) and lost["seen"] > 3 * lost["masked"]
    inputs = appearance_inputs(scene)
    still = inputs["registered"].image
    for name, frames in (("clean", scene.images), ("masked", images)):
        spoiled = inputs | {"target": frames[[1]], "sources": frames[None, [0, 2]]}
        terms = af.appearance_loss(**spoiled | {"registered": dataclasses.replace(inputs["registered"], image=still)},
                                   usable=usable, settings=RANGE)
        lost[name] = float(terms.parts["photometric"])
    assert lost["masked"] == pytest.approx(lost["clean"], rel=1e-4)


def test_parity_mixes_the_masks_of_a_batch(scene, scene_of):
    other = scene_of(scene.camera, seed=5)
    views, disparities, depths, T = _joined(ra_inputs(scene), ra_inputs(other, 3))
    got = [ra.resolution_adaptive_loss(views, (disparities[0], disparities[1], 1.3 * disparities[2]), depths, T,
                                       ra.ResolutionAdaptive(depth_kind="range", masks_of_whole_batch=whole))
           for whole in (False, True)]
    assert got[0].parts["consistency_high"] == got[1].parts["consistency_high"]
    assert got[0].parts["consistency_low"] != got[1].parts["consistency_low"]


def _joined(one, two):
    """Two batches of one as a batch of two."""
    cat = torch.cat
    views = tuple(ra.View(cat([a.target, b.target]), cat([a.sources, b.sources]), a.cameras.select([0, 0])
                          .with_intrinsics(cat([a.cameras.intrinsics, b.cameras.intrinsics])),
                          cat([a.usable, b.usable])) for a, b in zip(one[0], two[0], strict=True))
    disparities, depths = (tuple(cat(p) for p in zip(one[k], two[k], strict=True)) for k in (1, 2))
    return views, disparities, depths, cat([one[3], two[3]])
