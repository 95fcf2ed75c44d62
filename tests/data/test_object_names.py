"""Names of objects, as they are typed: a number is refused in one line."""

from typing import Any

import pytest
from omegaconf import OmegaConf

from posefilter.data.readers.registry import open_meshes
from posefilter.errors import UserError


@pytest.mark.parametrize("typed", [10**21, 0.5, {"a": 1}, [5], ["carton", None]])
def test_what_is_no_name_is_told(typed: Any) -> None:
    with pytest.raises(UserError, match=r"^data\.object=.*must be a name, or a list of names"):
        open_meshes("builtin", None, "fat", typed)


def test_a_list_of_a_configuration_is_a_list_of_names() -> None:
    names = OmegaConf.create(["carton", "duck"])
    assert open_meshes("builtin", None, "fat", names).load("carton").name == "carton"  # type: ignore[arg-type]
