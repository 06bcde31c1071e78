"""The organ itself: seamless, closed, moving as documented; and how the capsule meets it."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vio.errors import SimulationError
from vio.simulation import DRIVING, ORGANS, simulate
from vio.simulation.anatomy import make_anatomy
from vio.simulation.contact import find_contacts, free_radius
from vio.simulation.noise_fields import BandNoise
from vio.simulation.path import moving_path
from vio.simulation.wall import NARROWEST_M, ROW_M, Wall
from vio.simulation.wall_motion import exit_radius


@pytest.fixture(scope="module", params=ORGANS)
def anatomy(request):
    return make_anatomy(request.param, 3)


def test_noise_has_unit_variance_its_band_and_no_seams():
    pixel_m = (0.5e-3, 0.4e-3)
    field = BandNoise((1, 2), 300, pixel_m, 4e-3, 20e-3).rows(-700, 2300)
    assert field.std() == pytest.approx(1.0, abs=0.03)
    assert abs(field.mean()) < 0.05
    power = np.abs(np.fft.rfft2(field)) ** 2
    f = np.hypot(np.fft.fftfreq(len(field), pixel_m[0])[:, None], np.fft.rfftfreq(300, pixel_m[1])[None])
    assert power[(f > 1 / 30e-3) & (f < 1 / 2.5e-3)].sum() > 0.97 * power.sum()
    bend = np.abs(np.diff(field, 2, axis=0)).mean(axis=1)  # a seam would stand out in its row
    assert bend.max() < 2.0 * np.median(bend)
    wrap = np.abs(field[:, 0] - field[:, -1]).mean()
    assert wrap < 1.5 * np.abs(np.diff(field, axis=1)).mean()


@given(first=st.integers(-2000, 2000), count=st.integers(1, 600))
def test_noise_does_not_depend_on_what_was_asked_for_before(first, count):
    used, fresh = (BandNoise((7,), 40, (1e-3, 1e-3), 5e-3, 40e-3) for _ in range(2))
    used.rows(-300, 900)
    np.testing.assert_array_equal(used.rows(first, first + count), fresh.rows(first, first + count))


def test_sections_of_the_wall_fit_together(anatomy):
    wall = anatomy.wall
    last = min(wall.rows, 1600)
    maps = wall.maps(0, last).astype(float)
    for channel, name in ((0, "radius"), (1, "texture shift")):
        step = np.abs(np.diff(maps[..., channel], axis=0)).mean(axis=1)
        for seam in range(256, last - 4, 256):
            around = np.r_[step[seam - 8: seam - 2], step[seam + 2: seam + 8]]
            assert step[seam - 1] < 1.6 * around.max() + 2e-6, (name, seam)
    fresh = Wall(anatomy.organ, anatomy.seed)
    np.testing.assert_array_equal(fresh.maps(300, 520), wall.maps(300, 520))


def test_both_ends_are_closed_and_the_lumen_between_lets_the_capsule_pass(anatomy):
    wall = anatomy.wall
    assert wall.radius_m(0, 1).max() < 1e-3 and wall.radius_m(wall.rows - 1, wall.rows).max() < 1e-3
    cap = int(2.2 * anatomy.organ.radius_m / ROW_M)
    middle = wall.radius_m(cap, wall.rows - cap)
    assert middle.min() > 0.9 * NARROWEST_M
    np.testing.assert_allclose(np.median(middle), anatomy.organ.radius_m, rtol=0.25)
    assert wall.arc_m[0] == 0 and wall.arc_m[-1] == pytest.approx(anatomy.organ.length_m)
    assert (np.diff(wall.arc_m) >= 0).all()


def test_contractions_have_their_rate_speed_and_depth(anatomy):
    waves, length = anatomy.organ.waves, anatomy.organ.length_m
    t = np.arange(0, 300, 0.1)
    share, _ = anatomy.motion.contraction(np.full_like(t, 0.5 * length), t)
    narrow = (share[1:-1] < share[:-2]) & (share[1:-1] <= share[2:]) & (share[1:-1] < 1 - 0.5 * waves.amplitude)
    assert narrow.sum() == pytest.approx(5 * waves.per_minute, abs=1)
    assert 0.8 * waves.amplitude < 1 - share.min() <= waves.amplitude
    arc = np.linspace(0.3, 0.7, 40) * length
    now = anatomy.motion.contraction(arc, 10.0)[0]
    later = anatomy.motion.contraction(arc + 2 * waves.speed_m_s, 12.0)[0]
    np.testing.assert_allclose(now, later, atol=1e-3)
    fine = np.linspace(0, length, 20_000)
    slide = anatomy.motion.contraction(fine, 4.0)[1]
    assert (np.diff(fine + slide) > 0).all()  # the wall never folds over itself along the lumen
    assert np.abs(anatomy.motion.contraction(np.array([0.0, length]), 4.0)[1]).max() < 1e-9


@given(st.tuples(*[st.floats(-8e-3, 8e-3)] * 3), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0, 6.28))
def test_exit_from_a_capsule_is_where_a_fine_search_finds_it(offset, axis, angle):
    axis = np.array(axis) + np.array([0, 0, 1.5])
    axis /= np.linalg.norm(axis)
    middle, reach, radius_m = np.array(offset), 7.5e-3, 5.5e-3
    rear, front = middle - reach * axis, middle + reach * axis
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    found = exit_radius(np.zeros(3), np.eye(3)[:2], np.array([angle]), rear, front, radius_m)[0]
    at = np.linspace(-30e-3, 30e-3, 60_001)
    points = at[:, None] * direction
    along = np.clip((points - rear) @ axis, 0, 2 * reach)
    inside = np.linalg.norm(points - rear - along[:, None] * axis, axis=1) <= radius_m
    if inside.any():
        assert found == pytest.approx(at[inside].max(), abs=2e-6)
    else:
        assert not at[0] < found < at[-1]


@pytest.mark.parametrize("driving", DRIVING)
def test_the_capsule_stays_between_the_ends_and_drives_as_it_is_told(driving):
    organ = make_anatomy("small-bowel", 5)
    path = moving_path(organ, driving, 1200.0, np.random.default_rng(2), start=0.2)
    t = np.arange(0, 1200, 0.1)
    arc = path.arc_m(t)
    assert arc.min() > 0 and arc.max() < organ.organ.length_m
    assert arc[0] == pytest.approx(0.2 * organ.organ.length_m, abs=0.05)
    speed = np.abs(np.diff(arc)) / 0.1
    if driving == "transit":  # 0.16 to 0.6 mm/s in the mean; bursts in a few percent of the time cover most of the way
        assert 0.1e-3 < speed.mean() < 0.8e-3
        fast = np.sort(speed)[::-1]
        assert fast[: len(fast) // 10].sum() > 0.5 * fast.sum()
    else:
        assert 1e-3 < speed.mean() < 10e-3
    if driving in ("natural", "brisk"):
        assert (np.diff(arc) < 0).mean() > 0.1  # true revisits


def test_a_short_organ_is_driven_to_and_fro():
    stomach = make_anatomy("stomach", 1)
    arc = moving_path(stomach, "operated", 600.0, np.random.default_rng(0)).arc_m(np.arange(0, 600, 0.5))
    assert arc.min() > 0.02 and arc.max() < stomach.organ.length_m - 0.02
    assert np.ptp(arc) > 0.08


def test_contacts_happen_where_there_is_no_room(anatomy):
    path = moving_path(anatomy, "natural", 120.0, np.random.default_rng(1))
    contacts = find_contacts(anatomy, path, 120.0)
    assert 10 < len(contacts.t_s) < 400
    assert (np.diff(contacts.t_s) > 0).all() and (contacts.strength > 0).all() and (contacts.strength <= 1).all()
    np.testing.assert_allclose(np.linalg.norm(contacts.push, axis=1), 1, atol=1e-9)
    arc = path.arc_m(np.arange(0, 120, 0.5))
    for theta in (0.0, 2.0, 4.0):
        room = free_radius(anatomy, arc, np.full_like(arc, theta))
        assert (room >= 0).all() and room.max() < anatomy.organ.radius_m


def test_contacts_make_the_collisions_of_a_recording():
    bumped = simulate("small-bowel", "collision", 5, 60.0, 2)
    contacts = find_contacts(bumped.anatomy, bumped.motion.nominal, 59.0)
    assert len(contacts.t_s) > 10
    assert np.isin(contacts.t_s, bumped.motion.vibration.kinks_s).mean() > 0.95


@pytest.mark.parametrize(("changes", "words"), [
    ({"start": 1.5}, "start is 1.5"), ({"start": float("nan")}, "start is nan"),
    ({"wall_motion": -1.0}, "wall_motion is -1.0"),
])
def test_an_impossible_place_is_refused(changes, words):
    with pytest.raises(SimulationError, match=words):
        simulate("colon", "none", 0, 5.0, 1, **changes)
