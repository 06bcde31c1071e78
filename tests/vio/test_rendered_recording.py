"""Rendered recordings on disk: whole or not there, read back as they were made, with the truth about lesions."""

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip("numba", reason="images need the extra 'sim'")

from vio.errors import OutputError, SimulationError
from vio.formats import open_recording
from vio.simulation import dataset, images, preset_camera, simulate
from vio.simulation.dataset import Sequence, plan, write_dataset
from vio.simulation.images import DEPTH_UNIT_M, PRODUCTS, write_rendered
from vio.simulation.rendering.renderer import Renderer
from vio.simulation.sightings import known_marks

CAMERA = preset_camera("fisheye-140", 96)


def bytes_of(folder: Path) -> dict[str, bytes]:
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A stomach of 10 s with everything, and the simulation it comes from."""
    folder = tmp_path_factory.mktemp("rendered") / "REC"
    simulation = simulate("stomach", "collision", 2, 10.0, 4, camera=CAMERA)
    heard = []
    write_rendered(simulation, folder, products=tuple(PRODUCTS), progress=lambda *counts: heard.append(counts))
    assert heard == [(k + 1, 30) for k in range(30)]
    return folder, simulation


def test_frames_and_depth_are_read_back_as_rendered(made):
    folder, simulation = made
    recording, renderer = open_recording(folder), Renderer(simulation)
    assert recording.has_images and recording.has_depth and recording.depth_unit_m == DEPTH_UNIT_M
    assert recording.provenance == simulation.recording.provenance
    np.testing.assert_array_equal(recording.imu.accel_m_s2.round(6), simulation.recording.imu.accel_m_s2.round(6))
    for k in (0, 17, 29):
        frame = renderer.render(float(recording.frame_t_s[k]), k)
        np.testing.assert_array_equal(recording.frame(k), frame.rgb)
        depth = recording.depth_m(k)
        np.testing.assert_allclose(depth, frame.z_depth_m, atol=0.51 * DEPTH_UNIT_M)
        assert (depth[~frame.valid] == 0).all()
        T = recording.truth.T_world_body[k] @ recording.calibration.T_body_camera
        np.testing.assert_allclose(frame.T_world_camera, T, atol=1e-9)  # frames and truth come from one motion


def test_products_are_what_they_say(made):
    folder, simulation = made
    mav0, recording = folder / "mav0", open_recording(folder)
    frame = Renderer(simulation).render(float(recording.frame_t_s[17]), 17)
    stamp = recording.frame_t_ns[17]
    normals, albedo = (cv2.imread(str(mav0 / f"{name}0" / "data" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)[..., ::-1]
                       for name in ("normals", "albedo"))
    np.testing.assert_allclose(normals / 32767.5 - 1, frame.normal, atol=2e-5)
    np.testing.assert_allclose(albedo / 65535, frame.albedo, atol=1e-5)
    mask = cv2.imread(str(mav0 / "mask0" / "data" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(mask == 255, frame.valid)
    flow = np.load(mav0 / "flow0" / "data" / f"{stamp}.npy")
    np.testing.assert_array_equal(flow, Renderer(simulation).scene_flow(frame, float(recording.frame_t_s[18])))
    last = np.load(mav0 / "flow0" / "data" / f"{recording.frame_t_ns[-1]}.npy")
    assert not last.any()  # there is no next frame
    gains = np.genfromtxt(mav0 / "cam0" / "exposure.csv", delimiter=",")
    assert gains[17, 1] == pytest.approx(frame.gain, rel=1e-5)


def test_lesions_are_where_the_truth_says(made):
    folder, simulation = made
    truth, sightings = rows_of(folder / "lesions.csv"), rows_of(folder / "lesion_sightings.csv")
    assert truth and sightings
    marks, recording = known_marks(simulation.anatomy), open_recording(folder)
    camera = recording.calibration.camera
    for row in sightings:
        k, pixel = int(row["frame"]), np.array([float(row["u"]), float(row["v"])])
        depth = recording.depth_m(k)[int(pixel[1]), int(pixel[0])]
        ray = camera.unproject(pixel)
        T = recording.truth.T_world_body[k] @ recording.calibration.T_body_camera
        point = T[:3, :3] @ (ray * depth / ray[2]) + T[:3, 3]
        there = np.array([float(row[f"{axis}_mm"]) for axis in "xyz"]) * 1e-3
        np.testing.assert_allclose(point, there, atol=3e-5)
    for row in truth:
        mark, seen = marks[int(row["id"])], [s for s in sightings if s["mark"] == row["id"]]
        assert row["label"] == mark.label and int(row["frames_seen"]) == len(seen)
        at = np.array([float(row[f"{axis}_mm"]) for axis in "xyz"])
        near = [np.linalg.norm(at - [float(s[f"{axis}_mm"]) for axis in "xyz"]) for s in seen]
        assert min(near) < 1e3 * mark.radius_m + 6  # the wall moves by millimetres
        assert 0 <= float(row["arc_length_mm"]) <= 1e3 * simulation.anatomy.organ.length_m


def test_two_runs_give_the_same_bytes(made, tmp_path):
    folder, _ = made
    again = simulate("stomach", "collision", 2, 10.0, 4, camera=CAMERA)
    write_rendered(again, tmp_path / "REC", products=tuple(PRODUCTS))
    assert bytes_of(tmp_path / "REC") == bytes_of(folder)


@pytest.fixture
def short():
    return simulate("small-bowel", "none", 0, 1.0, 1, camera=CAMERA)


def test_a_foreign_folder_is_never_replaced_but_ours_is(short, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("mine")
    with pytest.raises(OutputError, match="choose another --out"):
        write_rendered(short, tmp_path / "mine")
    assert [p.name for p in tmp_path.rglob("*")] == ["mine", "thesis.txt"]
    write_rendered(short, tmp_path / "REC")
    write_rendered(short, tmp_path / "REC")
    assert open_recording(tmp_path / "REC").has_images


def test_a_full_disk_leaves_nothing_behind(short, tmp_path, monkeypatch):
    written, write_bytes = [], Path.write_bytes

    def full_after_three(path, content):
        if path.suffix == ".png":
            written.append(path)
            if len(written) > 3:
                raise OSError(28, "No space left on device")
        return write_bytes(path, content)

    monkeypatch.setattr(Path, "write_bytes", full_after_three)
    with pytest.raises(OutputError, match="No space left on device; choose a writable place with space"):
        write_rendered(short, tmp_path / "REC")
    assert list(tmp_path.iterdir()) == []


def test_without_numba_the_extra_is_named(short, tmp_path, monkeypatch):
    monkeypatch.setattr(images, "find_spec", lambda name: None)
    with pytest.raises(SimulationError, match=r"pip install 'capsule-vio\[sim\]'"):
        write_rendered(short, tmp_path / "REC")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_product_is_refused(short, tmp_path):
    with pytest.raises(SimulationError, match="unknown product 'smell'; choose from normals"):
        write_rendered(short, tmp_path / "REC", products=("smell",))


# ---- data sets -------------------------------------------------------------------------------

def test_the_papers_set_up():
    sequences = plan("mm-wce", 1, 60.0, "mirocam", 320)
    count = {}
    for s in sequences:
        count.setdefault("/".join(s.path.split("/")[:-1]), []).append(s)
    for name in ("mm-wce-1", "mm-wce-2"):
        train, test = count[f"{name}/train"], count[f"{name}/test"]
        assert (len(train), len(test)) == (6, 5)
        assert {s.level for s in train} == {s.level for s in test} == {1, 2, 3, 4, 5}
        assert {s.vibration for s in train + test} == {"gaussian"} and {s.organ for s in train} == {
            "colon", "small-bowel", "stomach"}
    assert {s.driving for s in count["mm-wce-1/train"]} != {s.driving for s in count["mm-wce-2/train"]}
    pair = [[(s.organ, s.seed, s.level, s.driving) for s in count[f"vibration-types/{kind}/{part}"]]
            for part in ("train", "test") for kind in ("peristalsis", "collision")]
    assert pair[0] == pair[1] and pair[2] == pair[3]  # the same route
    train_seeds, test_seeds = ({s.seed for s in sequences if f"/{part}/" in s.path} for part in ("train", "test"))
    assert not train_seeds & test_seeds
    with pytest.raises(SimulationError, match="unknown data set 'kitti'; choose one of mm-wce"):
        plan("kitti", 1, 60.0, "mirocam", 320)


@pytest.fixture(scope="module")
def small_plan():
    return tuple(Sequence(f"set/{k:02d}", organ, "gaussian", 2, "operated", 10 + k, 1.0, "pinhole-110", 48)
                 for k, organ in enumerate(("colon", "small-bowel", "small-bowel")))


def test_a_data_set_is_the_same_from_one_process_or_two_and_goes_on_where_it_stopped(small_plan, tmp_path, monkeypatch):
    manifest = write_dataset(small_plan, tmp_path / "A", workers=2)
    entries = json.loads(manifest.read_text())["sequences"]
    assert [e["path"] for e in entries] == [s.path for s in small_plan]
    rendered, render = [], dataset._render

    def counted(sequence, out):
        rendered.append(sequence.path)
        if len(rendered) == 2:
            raise KeyboardInterrupt
        return render(sequence, out)

    monkeypatch.setattr(dataset, "_render", counted)
    with pytest.raises(KeyboardInterrupt):
        write_dataset(small_plan, tmp_path / "B")
    assert not (tmp_path / "B" / "manifest.json").exists()
    write_dataset(small_plan, tmp_path / "B")
    assert rendered == ["set/00", "set/01", "set/01", "set/02"]  # the one that was stopped is done again, the first not
    assert bytes_of(tmp_path / "A") == bytes_of(tmp_path / "B")
    write_dataset(small_plan, tmp_path / "B")
    assert len(rendered) == 4


def test_a_sequence_of_other_arguments_is_rendered_again(small_plan, tmp_path):
    one = small_plan[1:2]
    write_dataset(one, tmp_path)
    before = bytes_of(tmp_path)
    shutil.copytree(tmp_path / "set" / "01", tmp_path / "kept")
    louder = (Sequence(**{**one[0].__dict__, "level": 4}),)
    write_dataset(louder, tmp_path)
    assert bytes_of(tmp_path)["set/01/recording.yaml"] != before["set/01/recording.yaml"]
    (tmp_path / "foreign").mkdir()
    (tmp_path / "foreign" / "x").write_text("mine")
    with pytest.raises(OutputError, match="foreign exists and was not written by"):
        write_dataset((Sequence(**{**one[0].__dict__, "path": "foreign"}),), tmp_path)
    with pytest.raises(SimulationError, match="workers is 0"):
        write_dataset(one, tmp_path, workers=0)
