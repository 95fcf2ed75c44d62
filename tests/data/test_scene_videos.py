"""A video is what one camera sees of one place, with the truth of its own images."""

from pathlib import Path

import numpy as np
import pytest
from dataset_trees import bop_scene, fat_folder, fat_frame, fat_tree, pose, write_mesh

from posefilter.cli.command import compose_job
from posefilter.cli.track import open_videos
from posefilter.data.readers.bop import BopReader
from posefilter.data.readers.fat import FatReader
from posefilter.data.readers.registry import open_whole
from posefilter.data.sequences import SceneVideo, list_scenes
from posefilter.errors import BadData, UserError
from posefilter.meshes.store import MeshStore

CONF = Path(__file__).parents[2] / "conf"
EYES = ("left", "right")
NEAR, FAR = pose(), pose((0.1, 0.2, 0.3), (0.02, 0.01, 0.6))


def test_folders_of_one_place_and_both_cameras_are_videos_of_their_own(tmp_path: Path) -> None:
    for part, at in (("mixed", NEAR), ("single/toy_16k", FAR)):
        folder = fat_folder(tmp_path / part / "kitchen_0", {"toy": 24})
        for number in range(2):
            for eye in EYES:
                fat_frame(folder, number, [("toy", 24, at)], eye)
    reader = FatReader(tmp_path, cameras=EYES)
    scenes = list_scenes(reader)
    names = [f"{part}/kitchen_0.{eye}" for part in ("mixed", "single/toy_16k") for eye in EYES]
    assert sorted(scene.name for scene in scenes) == names
    assert {scene.group for scene in scenes} == {"kitchen_0"}
    for scene in scenes:
        video = SceneVideo(reader, scene, ["toy"])
        assert len(video) == 2
        assert video.several == ()
        assert video.scene_id == scene.scene_id
        shift = np.array([0.06 if "right" in scene.name else 0.0, 0, 0])
        wanted = (NEAR if "mixed" in scene.name else FAR)[:3, 3] - shift
        for number, frame in enumerate(video):
            assert (
                frame.name
                == f"{scene.name[: scene.name.index('.')]}/00000{number}"
                + (scene.name[scene.name.index(".") :])
            )
            np.testing.assert_allclose(frame.truth["toy"][:3, 3], wanted, atol=1e-5)


def test_a_place_of_one_video_gives_it_its_name(tmp_path: Path) -> None:
    reader = FatReader(fat_tree(tmp_path, scenes=2))
    assert [scene.name for scene in list_scenes(reader)] == ["kitchen_0", "kitchen_1"]


def test_a_bop_dataset_of_ycb_objects_is_called_as_the_objects_that_are_asked_for(
    tmp_path: Path,
) -> None:
    name = "006_mustard_bottle"
    bop_scene(tmp_path / "data" / "000048", [[(5, NEAR), (2, FAR)]])
    meshes = MeshStore(write_mesh(tmp_path / "meshes", name))
    reader = open_whole("bop", tmp_path / "data", [name, "011_banana"], meshes, mesh_frame=None)
    assert reader.objects == ("003_cracker_box", name)
    (scene,) = list_scenes(reader)
    video = SceneVideo(reader, scene, [name, "011_banana"])
    assert video.objects == (name,)
    (frame,) = video
    assert set(frame.truth) == {name}
    own = open_whole("bop", tmp_path / "data", ["obj_000005"], meshes, mesh_frame=None)
    assert own.objects == ("obj_000002", "obj_000005")


def test_objects_that_a_dataset_does_not_show_are_told_with_its_own(tmp_path: Path) -> None:
    bop_scene(tmp_path / "data" / "000048", [[(5, NEAR), (2, FAR)]])
    write_mesh(tmp_path / "meshes", "drill")
    places = [f"data.root={tmp_path / 'data'}", f"data.meshes={tmp_path / 'meshes'}"]
    cfg = compose_job("track", CONF, ["data=bop", *places], tmp_path).cfg
    told = r"^data\.root=.* \(drill\); its own are obj_000002, obj_000005$"
    with pytest.raises(UserError, match=told):
        open_videos(cfg, ["drill"])


def test_an_object_of_no_known_frame_ends_no_track_of_another(tmp_path: Path) -> None:
    """The public mesh of the wood block is another scan than BOP's."""
    bop_scene(tmp_path / "data" / "000048", [[(2, NEAR), (16, FAR)]])
    meshes = MeshStore(write_mesh(tmp_path / "meshes", "003_cracker_box"))
    reader = open_whole("bop", tmp_path / "data", ["003_cracker_box"], meshes, mesh_frame=None)
    assert reader.objects == ("003_cracker_box",)
    with pytest.raises(UserError, match="036_wood_block: no relation"):
        BopReader(tmp_path / "data", ["036_wood_block"], meshes, mesh_frame="original")


def test_an_object_that_was_not_asked_for_spoils_no_frame(tmp_path: Path) -> None:
    """Such as two instances of it, and no mesh to tell them apart: its picture is not needed."""
    folder = fat_folder(tmp_path / "mixed" / "kitchen_0", {"other": 12, "toy": 24})
    fat_frame(folder, 0, [("other", 12, FAR), ("toy", 24, NEAR)], "left")
    reader = FatReader(tmp_path)
    read = reader.read

    def refuse(number: int) -> object:
        if reader.records()[number].object == "other":
            raise BadData("two instances of one class")
        return read(number)

    assert reader.records()[0].object == "other"
    reader.read = refuse  # type: ignore[method-assign,assignment]
    (scene,) = list_scenes(reader)
    frame = SceneVideo(reader, scene, ["toy"]).read(0)
    assert frame is not None
    assert set(frame.truth) == {"toy"}


def test_a_part_is_read_by_itself(tmp_path: Path) -> None:
    meshes = MeshStore(write_mesh(tmp_path / "meshes", "toy"))
    (tmp_path / "meshes" / "toy" / "google_16k" / "parts.json").write_text(
        '{"foot": {"box": [[-1, -1, -1], [1, 1, 1]]}}'
    )
    fat_tree(tmp_path / "data", scenes=1)
    reader = open_whole("fat", tmp_path / "data", ["toy.foot"], meshes)
    assert reader.objects == ("toy.foot",)
    with pytest.raises(UserError, match="is a part, which is read by itself"):
        open_whole("fat", tmp_path / "data", ["toy.foot", "toy"], meshes)
