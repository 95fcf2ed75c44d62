"""The data module: splits by scene, resizing with the camera, caches, epochs, broken files."""

import dataclasses
import json
import multiprocessing
import os
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
import trimesh
from dataset_trees import (
    HIGH,
    LOW,
    K,
    bop_scene,
    fat_folder,
    fat_frame,
    fat_tree,
    pose,
    truth,
    write_mesh,
)
from torch.utils.data import default_collate

from posefilter.data.augmentation import PasteOccluder, RandomCrop
from posefilter.data.cache import DiskCache
from posefilter.data.dataset import EpochShuffle, FrameDataset
from posefilter.data.frames import FrameRecord
from posefilter.data.loaders import make_loader, spare_cores
from posefilter.data.module import PoseDataModule
from posefilter.errors import BadData, UserError
from posefilter.geometry.camera import resize_intrinsics
from posefilter.meshes.store import MeshStore
from posefilter.synthetic.generate import generate
from posefilter.types import Batch


class Refusing(FrameDataset):
    """Two frames that cannot be read."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def __len__(self) -> int:
        return 2

    def sizes(self) -> dict:
        return {}

    def __getitem__(self, i: int) -> Batch:
        raise self.error


@pytest.fixture
def ended() -> Iterator[None]:
    """See that the loader's processes end with the test: they hold all of this process's pipes."""
    yield
    assert not multiprocessing.active_children()


@pytest.mark.usefixtures("ended")
@pytest.mark.parametrize(
    ("error", "told"),
    [
        (UserError("a.npy: changed while it was in use"), "a.npy: changed while it was in use"),
        (BadData(Path("a.png"), "is cut", "12 bytes"), "a.png: is cut (12 bytes)"),
        (FileNotFoundError(2, "No such file", "a.npy"), "[Errno 2] No such file: 'a.npy'"),
    ],
)
def test_a_mistake_in_a_loaders_process_is_told_in_one_line(error: Exception, told: str) -> None:
    with pytest.raises(UserError) as caught:
        next(iter(make_loader(Refusing(error), 1, 1)))
    assert str(caught.value) == told


@pytest.mark.usefixtures("ended")
@pytest.mark.parametrize("kind", [RuntimeError, IndexError])
def test_another_error_there_keeps_its_traceback(kind: type[Exception]) -> None:
    with pytest.raises(kind, match=rf"(?s)^Caught {kind.__name__} in .*__getitem__"):
        next(iter(make_loader(Refusing(kind("mine")), 1, 1)))


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("fat")
    write_mesh(root / "meshes", "toy")
    return fat_tree(root / "data", scenes=6, frames=3).parent


def module(root, **how):
    settings = {
        "source": "fat",
        "root": root / "data",
        "object": "toy",
        "meshes": root / "meshes",
        "progress": False,
    }
    return PoseDataModule(**{**settings, **how})


def test_scenes_are_never_cut_and_the_seed_decides(root):
    splits = {}
    for seed in (0, 0, 1, 2):
        dm = module(root, split={"train": 0.5, "val": 0.2, "test": 0.3}, split_seed=seed)
        parts = {name: {r.group for r in dm.records(name)} for name in ("train", "val", "test")}
        assert sum(len(p) for p in parts.values()) == len(set().union(*parts.values())) == 6
        assert [len(parts[name]) for name in ("train", "val", "test")] == [3, 1, 2]
        recorded = dm.split_record()
        assert {name: set(scenes) for name, scenes in recorded.items()} == parts
        assert all(frames == 3 for scenes in recorded.values() for frames in scenes.values())
        splits.setdefault(seed, []).append(json.dumps(recorded))
    assert splits[0][0] == splits[0][1]
    assert len({splits[seed][0] for seed in splits}) > 1


def test_scenes_by_name_lists_and_the_rest(root, tmp_path):
    (root / "data" / "list.txt").write_text("mixed/kitchen_5/000001.left\n")
    dm = module(root, split={"test": "list.txt", "val": ["kitchen_4"], "train": 1.0})
    assert [r.name for r in dm.records("test")] == ["mixed/kitchen_5/000001.left"]
    assert {r.group for r in dm.records("val")} == {"kitchen_4"}
    # not the rest of kitchen_5
    assert {r.group for r in dm.records("train")} == {f"kitchen_{i}" for i in range(4)}
    assert len(module(root, split={"test": 1.0}).records("test")) == 18
    for split, words in (
        ({"train": 0.9, "test": 0.3}, "sum to 1"),
        ({"test": ["attic_*"]}, "no scene 'attic_"),
        ({"test": "nolist.txt"}, "no such list"),
        ({"testing": 0.5}, "unknown part 'testing'"),
        ({"train": ["kitchen_1"], "test": ["kitchen_?"]}, "in both"),
    ):
        with pytest.raises(UserError, match=words):
            module(root, split=split).setup()


@pytest.mark.parametrize(("scenes", "frames"), [(1, 10), (2, 5)])
def test_few_scenes_are_split_by_frames_with_a_warning(tmp_path, caplog, scenes, frames):
    fat_tree(tmp_path, scenes=scenes, frames=frames)
    dm = PoseDataModule("fat", tmp_path, "toy", progress=False)
    dm.setup()
    parts = {name: [r.name for r in dm.records(name)] for name in ("train", "val", "test")}
    assert [len(parts[name]) for name in ("train", "val", "test")] == [8, 1, 1]
    # each image once, in blocks of neighbors
    assert [*parts["train"], *parts["val"], *parts["test"]] == [r.name for r in dm.reader.records()]
    assert f"{scenes} scene" in caplog.text
    assert "scores will flatter" in caplog.text


def test_an_image_is_never_cut_and_too_few_images_say_so(tmp_path):
    folder = fat_folder(tmp_path / "mixed" / "kitchen_0", {"toy": 24})
    for number in range(2):
        for camera in ("left", "right"):
            fat_frame(folder, number, [("toy", 24, pose())], camera)
    dm = PoseDataModule("fat", tmp_path, "toy", split={"train": 0.5, "val": 0.5}, progress=False)
    dm.setup("fit")
    assert {r.im_id for r in dm.records("train")} == {0}  # both cameras'
    assert {r.im_id for r in dm.records("val")} == {1}
    with pytest.raises(UserError, match=r"2 images .* cannot be divided into train, val, test"):
        PoseDataModule("fat", tmp_path, "toy").setup()


def test_no_frames_to_validate_on_say_so(root):
    with pytest.raises(UserError, match=r"data\.split: no frames for val"):
        _ = module(root, split={"train": 1.0}).val_dataset


def test_bops_own_models_are_in_millimeters(tmp_path):
    path = (
        write_mesh(tmp_path / "meshes", "obj_000002") / "obj_000002" / "google_16k" / "textured.obj"
    )
    lines = [line.split() for line in path.read_text().splitlines()]
    path.write_text(
        "\n".join(
            " ".join([x[0], *(str(float(n) * 1000) for n in x[1:])] if x[0] == "v" else x)
            for x in lines
        )
    )
    bop_scene(tmp_path / "000048", [[(2, pose())]])
    dm = PoseDataModule("bop", tmp_path, "obj_000002", tmp_path / "meshes", split={"test": 1.0})
    np.testing.assert_allclose(dm.meshes.load("obj_000002").bounds, [LOW, HIGH], atol=1e-9)
    assert float(dm.test_dataset[0].visibility) == pytest.approx(1.0, abs=0.01)


def test_bop_targets_choose_frames(tmp_path):
    bop_scene(tmp_path / "000048", [[(2, pose())], [(2, pose())]])
    (tmp_path / "targets.json").write_text(
        json.dumps([{"scene_id": 48, "im_id": 1, "obj_id": 2, "inst_count": 1}])
    )
    dm = PoseDataModule("bop", tmp_path, "obj_000002", split={"test": "targets.json"})
    assert [r.im_id for r in dm.records("test")] == [1]


def test_a_batch_is_the_truth_at_network_size(root):
    dm = module(root, image_width=80, split={"test": 1.0}, batch_size=4)
    batch = next(iter(dm.test_dataloader()))
    assert isinstance(batch, Batch)
    assert batch.rgb.shape == (4, 3, 60, 80)
    assert batch.rgb.dtype == torch.float32
    assert 0.3 < float(batch.rgb.max()) <= 1
    assert batch.frame_id.tolist() == [0, 1, 2, 3]
    small = resize_intrinsics(torch.from_numpy(K), 0.5, 0.5)
    for k in range(4):
        record = dm.records("test")[int(batch.frame_id[k])]
        native = dm.reader.read(next(i for i, r in enumerate(dm.reader.records()) if r == record))
        np.testing.assert_allclose(batch.camera_from_object[k], native.camera_from_object)
        np.testing.assert_allclose(batch.intrinsics[k], small, atol=1e-4)
        expected = truth(native.camera_from_object.astype(float), small.numpy(), 60, 80)
        mask = batch.mask[k, 0].numpy()
        assert (mask & (expected > 0)).sum() / (mask | (expected > 0)).sum() > 0.97
        inner = mask & (expected > 0)
        assert np.median(np.abs(batch.depth[k, 0].numpy() - expected)[inner]) < 1.2e-4
        slipped = truth(native.camera_from_object.astype(float), K * [[0.5], [0.5], [1.0]], 60, 80)
        both = inner & (slipped > 0)
        if k > 0:  # canary: half a pixel would show (the first face is frontal)
            assert np.median(np.abs(batch.depth[k, 0].numpy() - slipped)[both]) > 2e-4
    torch.testing.assert_close(batch.visibility, torch.ones(4), atol=0.02, rtol=0)


def test_caches_agree_and_disk_notices_change(root, tmp_path):
    def batch(kind):
        dm = module(
            root,
            image_width=80,
            split={"test": 1.0},
            batch_size=18,
            cache=kind,
            cache_dir=tmp_path / "cache",
        )
        return next(iter(dm.test_dataloader()))

    first = batch("memory")
    for kind in ("none", "disk", "disk"):
        for a, b in zip(first, batch(kind), strict=True):
            torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True)


def test_disk_cache_is_used_and_renewed(tmp_path, monkeypatch):
    fat_tree(tmp_path / "data", scenes=1, frames=2)
    how = {
        "source": "fat",
        "root": tmp_path / "data",
        "object": "toy",
        "split": {"test": 1.0},
        "cache": "disk",
    }
    first = PoseDataModule(**how).test_dataset[0]
    fresh = PoseDataModule(**how)
    monkeypatch.setattr(
        type(fresh.reader), "read", lambda self, i: pytest.fail("decoded although cached")
    )
    torch.testing.assert_close(fresh.test_dataset[0].rgb, first.rgb)
    monkeypatch.undo()
    other = pose((0.9, 0.1, 0.2), (0.02, 0.01, 0.5))
    fat_frame(tmp_path / "data" / "mixed" / "kitchen_0", 0, [("toy", 24, other)])
    renewed = PoseDataModule(**how).test_dataset[0]
    np.testing.assert_allclose(renewed.camera_from_object, other, atol=1e-6)
    np.testing.assert_array_equal(renewed.mask[0].numpy(), truth(other) > 0)


def test_the_disk_cache_is_renewed_when_the_camera_the_meshes_or_their_unit_change(tmp_path):
    fat_tree(tmp_path / "data", scenes=1, frames=1)
    mesh = write_mesh(tmp_path / "meshes", "toy") / "toy" / "google_16k" / "textured.obj"

    def read(scale=None):
        one = PoseDataModule(
            "fat",
            tmp_path / "data",
            "toy",
            tmp_path / "meshes",
            mesh_scale=scale,
            split={"test": 1.0},
            cache="disk",
            progress=False,
        ).test_dataset[0]
        return float(one.visibility), float(one.intrinsics[0, 0])

    first = read()
    assert read() == first
    assert read(scale=3.0)[0] < 0.5 * first[0]
    assert read() == first
    camera = tmp_path / "data" / "mixed" / "kitchen_0" / "_camera_settings.json"
    camera.write_text(camera.read_text().replace(f'"fx": {K[0, 0]}', f'"fx": {1.5 * K[0, 0]}'))
    assert read()[1] == pytest.approx(1.5 * first[1])
    lines = [line.split() for line in mesh.read_text().splitlines()]
    bigger = (" ".join([x, *(str(3 * float(y)) for y in z)]) for x, *z in lines if x == "v")
    faces = (" ".join(line) for line in lines if line[0] == "f")
    mesh.write_text("\n".join([*bigger, *faces]) + "\n")
    assert read()[0] < 0.5 * first[0]


def test_the_disk_cache_knows_which_object_a_record_is_of(tmp_path: Path) -> None:
    """A record keeps its name and its files where only the names of the classes were mended."""
    (tmp_path / "a.png").touch()
    one = FrameRecord("a", "scene", 0, 0, 1, "can", 0, (tmp_path / "a.png",))
    cache = DiskCache(tmp_path / "cache", "1")
    other = dataclasses.replace(one, object="box")
    assert cache._record_path(one) == cache._record_path(one)
    assert cache._record_path(one) != cache._record_path(other)


def test_the_disk_cache_is_renewed_when_the_unit_of_the_depth_changes(tmp_path):
    """A depth scale that was mended would else have no effect."""
    bop_scene(tmp_path / "data" / "000000", [[(2, pose())]], depth_scale=0.25)
    camera = tmp_path / "data" / "000000" / "scene_camera.json"
    before, kept = camera.read_text(), camera.stat()

    def read():
        split = {"test": 1.0}
        data = PoseDataModule("bop", tmp_path / "data", "obj_000002", split=split, cache="disk")
        return data.test_dataset.sample(0).depth

    first = read()
    camera.write_text(before.replace("0.25", "0.125"))
    np.testing.assert_allclose(read(), first / 2, atol=1e-4)
    camera.write_text(before)
    os.utime(camera, ns=(kept.st_atime_ns, kept.st_mtime_ns))  # as a file that is put back has it
    np.testing.assert_array_equal(read(), first)


def test_visibility_filters_training_and_test_apart(tmp_path):
    write_mesh(tmp_path / "meshes", "toy")
    front = pose((0.1, 0.2, 0.3), (0.04, -0.02, 0.33))
    for s in range(4):
        folder = fat_folder(tmp_path / "data" / "mixed" / f"kitchen_{s}", {"toy": 24, "other": 36})
        fat_frame(folder, 0, [("toy", 24, pose())])
        fat_frame(folder, 1, [("toy", 24, pose()), ("other", 36, front)])
    dm = PoseDataModule(
        "fat",
        tmp_path / "data",
        "toy",
        tmp_path / "meshes",
        split={"train": 0.5, "test": 0.5},
        min_visibility=0.9,
        progress=False,
    )
    assert [r.name[-11:] for r in dm.records("train")] == ["000000.left"] * 2
    assert len(dm.records("test")) == 4
    assert dm.describe()["splits"]["train"]["left_out"] == {"visibility below 0.9": 2}


def test_objects_whose_depth_is_not_kept_are_left_out_and_counted(tmp_path):
    """The depth of each of their pixels would be unknown."""
    near, far = pose(position=(0, 0, 0.5)), pose(position=(0, 0, 7.0))
    camera = K * [[12.0], [12.0], [1.0]]
    camera[:2, 2] = K[:2, 2]
    folder = tmp_path / "data" / "000000"
    bop_scene(folder, [[(2, near)], [(2, far)]])
    mask = (truth(far, camera) > 0).astype(np.uint8) * 255
    assert cv2.imwrite(str(folder / "mask_visib" / "000001_000000.png"), mask)
    data = PoseDataModule("bop", tmp_path / "data", "obj_000002", split={"test": 1.0})
    assert [record.im_id for record in data.records("test")] == [0]
    (left_out,) = data.describe()["splits"]["test"]["left_out"].items()
    assert left_out == ("the object is beyond 6.55 m, where depth is not kept", 1)


def test_smaller_limits_take_a_part_of_larger_ones(root):
    names = {}
    for limit in (2, 5, 9):
        dm = module(root, split={"train": 0.7, "test": 0.3}, limit_train=limit)
        names[limit] = [r.key for r in dm.records("train")]
        assert len(names[limit]) == limit
        assert len(dm.records("test")) == 6
    assert names[9][:5] == names[5]
    assert names[5][:2] == names[2]


def shade(sample, draw, rng):
    other = draw(rng)
    return dataclasses.replace(
        sample, rgb=np.full_like(sample.rgb, rng.integers(256)), visibility=float(other.frame_id)
    )


def epoch_of(dm, epoch):
    loader = dm.train_dataloader()
    loader.sampler.set_epoch(epoch)  # as Lightning does
    return default_collate(
        [item for batch in loader for item in map(Batch._make, zip(*batch, strict=True))]
    )


def test_augmentation_depends_on_seed_epoch_and_frame_alone(root):
    def run(workers, seed, epoch):
        how = {
            "split": {"train": 0.7, "test": 0.3},
            "augment": shade,
            "batch_size": 3,
            "workers": workers,
            "seed": seed,
        }
        dm = module(root, image_width=80, **how)
        batch = epoch_of(dm, epoch)
        order = batch.frame_id.argsort()
        return batch.frame_id.tolist(), [
            f[order][:, 0, 0, 0].tolist() if f.ndim == 4 else f[order].tolist()
            for f in (batch.rgb, batch.visibility)
        ]

    order, values = run(0, 0, 3)
    assert run(2, 0, 3) == (order, values)
    assert sorted(order) == list(range(12))
    assert run(0, 0, 4)[0] != order
    assert run(0, 0, 4)[1] != values
    assert run(0, 1, 3)[1] != values


def test_workers_that_persist_see_the_epoch_change(root):
    dm = module(root, image_width=80, split={"train": 1.0}, augment=shade, batch_size=18, workers=1)
    loader = dm.train_dataloader()
    shades = []
    for epoch in (0, 1, 0):
        loader.sampler.set_epoch(epoch)
        (batch,) = list(loader)
        shades.append(batch.rgb[batch.frame_id.argsort()][:, 0, 0, 0])
    assert not torch.equal(shades[0], shades[1])
    assert torch.equal(shades[0], shades[2])


@pytest.mark.parametrize(("limit", "batches"), [(2, 2), (0.5, 2), (9, 4), (1.0, 4)])
def test_after_a_whole_epoch_a_run_goes_on_with_the_start_of_the_next(root, limit, batches):
    """Also where the trainer takes a part of an epoch's batches."""
    dm = module(root, image_width=80, split={"train": 1.0}, batch_size=4)
    device = SimpleNamespace(root_device=torch.device("cpu"))
    dm.trainer = SimpleNamespace(
        global_rank=0, world_size=1, limit_train_batches=limit, strategy=device
    )
    loader = dm.train_dataloader()
    for _ in zip(range(batches), loader, strict=False):
        pass
    again, uncut = dm.train_dataloader(), dm.train_dataloader()
    again.load_state_dict(loader.state_dict())
    first, second = (next(iter(one)).frame_id.tolist() for one in (again, uncut))
    assert first == second


@pytest.mark.slow
def test_a_script_ends_that_still_refers_to_its_loaders_batches(root):
    script = f"""
        from posefilter.data.module import PoseDataModule
        data = PoseDataModule("fat", r"{root / "data"}", "toy", r"{root / "meshes"}", workers=1)
        batches = iter(data.test_dataloader())
        next(batches)
    """
    command = [sys.executable, "-c", textwrap.dedent(script)]
    subprocess.run(command, check=True, timeout=180)  # it would wait for ever


def test_images_of_several_sizes_are_taken_one_by_one(root, tmp_path):
    frame = [(2, pose())]
    bop_scene(tmp_path / "000001", [frame, frame])
    for name in ("rgb", "depth", "mask_visib"):
        for path in (tmp_path / "000001" / name).glob("000001*"):
            cv2.imwrite(str(path), cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[:90])
    how = {"source": "bop", "root": tmp_path, "object": "obj_000002", "image_width": 80}
    for split in ("train", "test"):
        dm = PoseDataModule(**how, split={split: 1.0}, batch_size=2)
        loader = dm.train_dataloader if split == "train" else dm.test_dataloader
        with pytest.raises(UserError, match=r"000001/00000\d is 80x\d+ and .*data\.batch_size=1"):
            loader()
    dm = PoseDataModule(**how, split={"test": 1.0}, batch_size=1, workers=0)
    assert [batch.rgb.shape[2] for batch in dm.test_dataloader()] == [60, 45]
    cut = partial(PoseDataModule, **how, split={"train": 1.0}, augment=RandomCrop((32, 32)))
    (batch,) = cut(batch_size=2, workers=0).train_dataloader()
    assert batch.rgb.shape == (2, 3, 32, 32)
    paste = PasteOccluder(probability=1, keep=0)
    for seed in range(8):  # it draws from one of the other size in some
        dm = PoseDataModule(**how, split={"train": 1.0}, augment=paste, batch_size=2, seed=seed)
        with pytest.raises(UserError, match="of one size"):
            dm.train_dataloader()


def test_validation_and_test_are_not_augmented(root):
    dm = module(root, split={"train": 0.5, "val": 0.2, "test": 0.3}, augment=shade)
    assert float(dm.train_dataset[0].rgb.std()) < 1e-6
    assert float(dm.val_dataset[0].rgb.std()) > 0.01
    assert float(dm.test_dataset[0].rgb.std()) > 0.01


def test_broken_frames_raise_or_are_counted(tmp_path):
    fat_tree(tmp_path, scenes=1, frames=4)
    victim = tmp_path / "mixed" / "kitchen_0" / "000002.left.depth.png"
    victim.write_bytes(victim.read_bytes()[:300])
    how = {"source": "fat", "root": tmp_path, "object": "toy", "split": {"test": 1.0}}
    with pytest.raises(UserError, match=r"000002\.left\.depth\.png: truncated.*on_error=skip"):
        PoseDataModule(**how).setup("test")
    dm = PoseDataModule(**how, on_error="skip")
    assert [r.im_id for r in dm.records("test")] == [0, 1, 3]
    assert dm.describe()["splits"]["test"] == {
        "frames": 3,
        "images": 3,
        "scenes": 1,
        "left_out": {"truncated or corrupt image": 1},
    }


def test_scenes_are_rendered_where_they_are_missing(tmp_path):
    calls = []

    def generate(out):
        calls.append(out)
        fat_tree(out, scenes=3)

    dm = PoseDataModule("scenes", tmp_path / "new", "toy", generate=generate)
    for _ in range(2):
        dm.prepare_data()
    assert calls == [tmp_path / "new"]
    # nine are there: it was cut short
    (tmp_path / "new" / "_generator.json").write_text(json.dumps({"frames": 10}))
    dm.prepare_data()
    assert len(calls) == 2
    with pytest.raises(UserError, match=r"no scenes here .* Nothing is rendered unless asked"):
        PoseDataModule("scenes", tmp_path / "none", "toy").prepare_data()
    with pytest.raises(UserError, match="only 9 of 10 scenes' frames are here"):
        PoseDataModule("scenes", tmp_path / "new", "toy").prepare_data()


def test_object_models_and_published_points(root, tmp_path):
    dm = module(root, split={"test": 1.0}, num_model_points=500)
    assert dm.object_model(0).points.shape == (500, 3)
    native = dm.reader.native_from_mesh("toy")
    points = np.random.default_rng(0).uniform(*dm.meshes.load("toy").bounds, (200, 3))
    (tmp_path / "toy").mkdir()
    np.savetxt(tmp_path / "toy" / "points.xyz", points @ native[:3, :3].T + native[:3, 3])
    published = module(root, split={"test": 1.0}, model_points_dir=tmp_path).object_model(0).points
    np.testing.assert_allclose(published, points, atol=1e-6)
    np.savetxt(tmp_path / "toy" / "points.xyz", 1000 * points)
    with pytest.raises(UserError, match=r"\d\d\d m across, .* 0\.182 m; they should be in meters"):
        module(root, model_points_dir=tmp_path).object_model(0)
    np.savetxt(tmp_path / "toy" / "points.xyz", points + 0.05)
    with pytest.raises(UserError, match=r"off that of the mesh of toy; .* in another frame"):
        module(root, model_points_dir=tmp_path).object_model(0)
    with pytest.raises(UserError, match=r"no toy/points\.xyz"):
        module(root, model_points_dir=tmp_path / "none").object_model(0)


def test_wrong_settings_are_named(root):
    with pytest.raises(UserError, match=r"data\.source=fats"):
        module(root, source="fats").setup()
    with pytest.raises(UserError, match=r"data\.cache=ram"):
        module(root, cache="ram")
    with pytest.raises(UserError, match=r"data\.root is not set"):
        PoseDataModule("fat", None)
    with pytest.raises(UserError, match="'flavour'"):
        module(root, options={"flavour": 1}).setup()
    with pytest.raises(UserError, match=r"data\.on_error=ignore"):
        module(root, on_error="ignore").setup()


def test_an_open_mesh_store_may_be_given(root):
    dm = module(root, meshes=MeshStore(root / "meshes"), split={"test": 1.0})
    assert dm.objects == ("toy",)
    assert dm.object_model(0).name == "toy"


@pytest.mark.parametrize(
    ("cores", "threads", "workers"), [(2, 2, 0), (4, 3, 1), (16, 8, 4), (1, 2, 0)]
)
def test_loader_processes_take_the_cores_that_are_spare(monkeypatch, cores, threads, workers):
    monkeypatch.setattr(
        "posefilter.data.loaders.os.sched_getaffinity", lambda _: set(range(cores)), raising=False
    )
    monkeypatch.setattr("posefilter.data.loaders.torch.get_num_threads", lambda: threads)
    monkeypatch.setattr("posefilter.data.loaders.torch.cuda.is_available", lambda: False)
    assert spare_cores() == workers


def test_a_gpu_leaves_the_cores_to_the_loader(monkeypatch):
    monkeypatch.setattr(
        "posefilter.data.loaders.os.sched_getaffinity", lambda _: set(range(4)), raising=False
    )
    monkeypatch.setattr("posefilter.data.loaders.torch.cuda.is_available", lambda: True)
    assert spare_cores() == 3


@pytest.mark.parametrize("processes", [2, 3])
def test_processes_that_train_together_share_an_epochs_frames(processes: int) -> None:
    alone = list(EpochShuffle(20, 5, lambda epoch: None))
    shares = [
        list(EpochShuffle(20, 5, lambda epoch: None, rank, processes)) for rank in range(processes)
    ]
    each = 20 // processes
    assert [len(share) for share in shares] == [each] * processes
    assert len(EpochShuffle(20, 5, lambda epoch: None, 0, processes)) == each
    # together, step by step, the frames that one process would have seen
    together = [frame for step in zip(*shares, strict=True) for frame in step]
    assert together == alone[: each * processes]


def test_a_process_goes_on_in_its_own_share() -> None:
    order = EpochShuffle(20, 5, lambda epoch: None, 1, 2)
    whole = list(order)
    order.skip(4)
    assert list(order) == whole[4:]
    assert list(order) == whole


def test_fewer_frames_than_processes_are_refused() -> None:
    with pytest.raises(UserError, match=r"^trainer.devices=3: there are only 2 training frames"):
        EpochShuffle(2, 5, lambda epoch: None, 0, 3)


@pytest.mark.parametrize(
    "split",
    [
        {"train": 0.8, "val": "test", "test": "train"},
        {"val": "test", "test": "train", "train": 0.8},
        {"test": "train", "train": 0.8, "val": "test"},
    ],
)
def test_parts_may_name_each_other_in_any_order(root, split):
    dm = module(root, split=split)
    assert dm.records("val") == dm.records("test") == dm.records("train") != []


def test_parts_that_name_each_other_in_a_circle_are_told(root):
    split = {"train": 0.8, "val": "test", "test": "val"}
    with pytest.raises(UserError, match=r"data.split: val and test name each other"):
        module(root, split=split).records("val")


def test_points_beside_another_dataset_than_ycb_videos_are_not_taken(tmp_path):
    """They are of YCB-Video's frame, and FAT and rendered scenes have another."""
    write_mesh(tmp_path / "meshes", "toy")
    fat_tree(tmp_path / "data", scenes=2, frames=2)
    (tmp_path / "models" / "toy").mkdir(parents=True)
    np.savetxt(tmp_path / "models" / "toy" / "points.xyz", np.eye(3).repeat(9, 0))
    own = module(tmp_path, split={"test": 1.0}, num_model_points=123).object_model(0)
    assert own.points.shape == (123, 3)


def test_an_object_whose_origin_is_far_from_it_is_judged_by_where_it_is(tmp_path):
    box = trimesh.creation.box((0.1, 0.2, 0.15))
    box.apply_translation((8.0, 5.0, 6.0))
    (tmp_path / "meshes").mkdir()
    box.export(tmp_path / "meshes" / "bracket.obj")
    size = {"workers": 1, "progress": False, "size": (160, 120), "distractors": (1, 2)}
    generate(tmp_path / "data", 8, object="bracket", meshes=tmp_path / "meshes", **size)
    data = module(tmp_path, object="bracket", split={"test": 1.0})
    data.setup("test")
    assert len(data.test_dataset) == 8


def test_a_dataset_that_does_not_fit_into_memory_is_told(root, monkeypatch, caplog):
    pages = {"SC_AVPHYS_PAGES": 1, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr("posefilter.data.module.os.sysconf", pages.__getitem__)
    module(root, split={"test": 1.0}).setup("test")
    assert "data.cache=disk keeps them in files" in caplog.text
    caplog.clear()
    module(root, split={"test": 1.0}, cache="none").setup("test")
    assert "data.cache" not in caplog.text
