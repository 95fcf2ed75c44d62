"""Names of objects and options of readers, as typed: what is no name is refused in one line."""

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf
from tests.data.dataset_trees import fat_tree

from posefilter.cli.recipe import check_recipe
from posefilter.data.readers.naming import choose_objects
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.data.readers.ycb_video_files import read_class_names
from posefilter.errors import UserError
from posefilter.limits import read_lines


@pytest.mark.parametrize("typed", [10**21, 0.5, {"a": 1}, [5], ["carton", None]])
def test_what_is_no_name_is_told(typed: Any) -> None:
    with pytest.raises(UserError, match=r"^data\.object=.*must be a name, or a list of names"):
        open_meshes("builtin", None, "fat", typed)


def test_a_list_of_a_configuration_is_a_list_of_names() -> None:
    names = OmegaConf.create(["carton", "duck"])
    assert open_meshes("builtin", None, "fat", names).load("carton").name == "carton"  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("source", "option", "typed"),
    [
        ("fat", "cameras", 0),
        ("fat", "cameras", []),
        ("fat", "cameras", ["left", "middle"]),
        ("fat", "subsets", None),
        ("fat", "subsets", "sing"),
        ("ycb_video", "subsets", 5),
        ("ycb_video", "subsets", {"data": 1}),
        ("ycb_video", "frames", 0.5),
        ("bop", "split", 5),
    ],
)
def test_an_option_of_another_kind_is_named(
    source: str, option: str, typed: Any, tmp_path: Path
) -> None:
    with pytest.raises(
        UserError, match=rf"^data\.options\.{option}=.*: (choose|must be)"
    ) as caught:
        open_reader(source, tmp_path, **{option: typed})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("typed", ["left", ["left"], OmegaConf.create(["right", "left"])])
def test_one_camera_or_several_are_chosen(typed: Any, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no FAT scenes here"):  # the options are right
        open_reader("fat", tmp_path, cameras=typed)


def test_a_name_that_reads_as_a_number_is_a_name() -> None:
    assert choose_objects(7, ["7", "8"], Path("bin")) == ("7",)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="unknown class '0'"):
        choose_objects(0, ["7", "8"], Path("bin"))  # type: ignore[arg-type]


def test_an_object_may_be_called_as_ycbs_files_are(tmp_path: Path) -> None:
    """FAT's classes end in `_16k`, which nobody need type; a name may end so itself."""
    for name, typed in (("mug_16k", ["mug_16k", "mug_16k_16k"]), ("mug", ["mug", "mug_16k"])):
        root = tmp_path / name
        fat_tree(root, scenes=1, frames=1, name=name)
        for one in typed:
            assert open_reader("fat", root, one).objects == (name,)


def test_classes_of_ones_own_are_found_beside_the_frames(tmp_path: Path) -> None:
    (tmp_path / "image_sets").mkdir()
    (tmp_path / "image_sets" / "classes.txt").write_text("hex_nut\nbolt\n")
    for root in (tmp_path, tmp_path / "data"):
        assert read_class_names(root) == ("hex_nut", "bolt")


def test_a_list_that_an_editor_of_windows_marked_is_read(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_bytes(b"\xef\xbb\xbf0000/000001\r\n0002/000001\r\n")
    assert read_lines(tmp_path / "list.txt") == ["0000/000001", "0002/000001"]


@pytest.mark.parametrize("folder", ["/d/\u7bb1\u30001", "/d/a\u00a0b"])
def test_blanks_of_other_scripts_are_no_harm_in_a_recipe(folder: str) -> None:
    recipe = {"choices": {}, "settings": {"data": {"root": folder}}}
    assert check_recipe(recipe)["settings"]["data"]["root"] == folder
    recipe["settings"]["data"]["root"] = "/d/\u001b[2J"
    with pytest.raises(UserError, match="is no plain text"):
        check_recipe(recipe)
