"""Names of objects become names of files, and cells of tables that spreadsheets open."""

import pytest

from posefilter.paths import is_plain_name


@pytest.mark.parametrize("name", ["=1+1", "+1", "-1", "@x", "\uff1dHYPERLINK", ".x", "~x", "a/b"])
def test_a_name_that_does_something_is_refused(name: str) -> None:
    assert not is_plain_name(name)


@pytest.mark.parametrize("name", ["003_cracker_box", "a=b", "my-can", "a+b", "Tasse gro\u00df"])
def test_a_name_of_an_object_is_taken(name: str) -> None:
    assert is_plain_name(name)
