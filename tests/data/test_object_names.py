"""Names of objects and options of readers, as typed: what is no name is refused in one line."""

from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

from posefilter.data.readers.naming import choose_objects
from posefilter.data.readers.registry import open_meshes, open_reader
from posefilter.errors import UserError


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
